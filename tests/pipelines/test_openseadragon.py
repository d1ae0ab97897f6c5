"""The Deep Zoom tiles of a run, opened by OpenSeadragon in a headless Chromium: what is on the screen is the panorama.

`make test` installs OpenSeadragon (BSD, not part of this project) beside the interpreter, where npm is there.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.panorama_deepzoom import OVERLAP_PX, TILE_PX, n_levels
from tests.pipelines.browser import Browser, Page, chromium
from tests.pipelines.end_to_end import pan_spec, run
from tests.pipelines.test_serve import until
from tests.synth.clip import write_clip

LIBRARY = Path(sys.prefix, "node_modules", "openseadragon", "build", "openseadragon", "openseadragon.min.js")
VIEW = (600, 300)  # px of the view port: more than a tile each way, less than the panorama
PAGE = """<!doctype html><meta charset="utf-8"><title>panorama</title><link rel="icon" href="data:,">
<style>html, body, #view { margin: 0; width: 100%; height: 100%; background: #000 }</style><div id="view"></div>
<script src="openseadragon.min.js"></script><script>
const viewer = OpenSeadragon({ element: document.getElementById("view"), tileSources: "panorama.dzi",
  showNavigationControl: false, animationTime: 0 });
window.failed = [];
for (const event of ["open-failed", "tile-load-failed"]) viewer.addHandler(event, (e) => failed.push(e.message));
const loaded = () => viewer.world.getItemCount() === 1 && viewer.world.getItemAt(0).getFullyLoaded();
const look = (x, y, width, height) => {
  const picture = viewer.world.getItemAt(0);
  viewer.viewport.fitBounds(picture.imageToViewportRectangle(x, y, width, height), true);
};
</script>"""

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="chromium is not installed"),
    pytest.mark.skipif(
        not LIBRARY.is_file(), reason="OpenSeadragon is not installed (make test does it by npm)"
    ),
]


class Quiet(SimpleHTTPRequestHandler):
    """Files of a folder, nothing said."""

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder of a shot with its Deep Zoom tiles, and the page that opens them."""
    folder = tmp_path_factory.mktemp("deepzoom")
    write_clip(folder / "pan.mp4", pan_spec(n_frames=30))
    assert run(folder / "pan.mp4", folder / "out", "--output.deepzoom", "true").code == 0
    shot = folder / "out" / "shot-000"
    (shot / "index.html").write_text(PAGE, encoding="utf-8")
    (shot / "openseadragon.min.js").write_bytes(LIBRARY.read_bytes())
    return shot


@pytest.fixture(scope="module")
def panorama(shot: Path) -> NDArray[np.uint8]:
    """(h, w, 3) of panorama.tif, black where nothing was seen."""
    with tifffile.TiffFile(shot / "panorama.tif") as tif:
        rgba = tif.pages[0].asarray()
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], 0)


@pytest.fixture(scope="module")
def page(shot: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(shot))) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            with Browser(tmp_path_factory.mktemp("browser")) as browser:
                opened = browser.open(f"http://127.0.0.1:{server.server_port}/", size=VIEW)
                until(opened, "loaded()")
                yield opened
        finally:
            server.shutdown()
            thread.join()


def screen(page: Page, folder: Path) -> NDArray[np.int_]:
    """What the view port shows, (h, w, 3)."""
    until(page, "loaded()")
    page.settle()
    page.screenshot(folder / "screen.png")
    with Image.open(folder / "screen.png") as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def rms(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean((a.astype(float) - b) ** 2)))


def test_the_whole_panorama_fits_in(
    page: Page, shot: Path, panorama: NDArray[np.uint8], tmp_path: Path
) -> None:
    """As it opens: the picture reduced to the view port, where the file's size says that it lies."""
    height, width = panorama.shape[:2]
    assert page.evaluate("(({x, y}) => [x, y])(viewer.world.getItemAt(0).getContentSize())") == [
        width,
        height,
    ]
    shown = screen(page, tmp_path)
    scale = min(VIEW[0] / width, VIEW[1] / height)
    size = (round(width * scale), round(height * scale))
    left, top = (VIEW[0] - size[0]) // 2, (VIEW[1] - size[1]) // 2
    small = np.asarray(Image.fromarray(panorama).resize(size, Image.Resampling.BOX)).astype(int)
    inner = np.s_[top + 8 : top + size[1] - 8, left + 8 : left + size[0] - 8]
    here = rms(shown[inner], small[8:-8, 8:-8])
    assert here < 0.5 * min(
        rms(shown[inner], np.roll(small, by, (0, 1))[8:-8, 8:-8]) for by in ((0, 4), (4, 0))
    )


@pytest.mark.parametrize(("across", "down"), [(0.0, 0.0), (0.37, 0.5), (1.0, 1.0)])
def test_at_full_size_the_screen_shows_the_panoramas_pixels(
    page: Page, shot: Path, panorama: NDArray[np.uint8], tmp_path: Path, across: float, down: float
) -> None:
    height, width = panorama.shape[:2]
    left, top = int(across * (width - VIEW[0])), int(down * (height - VIEW[1]))
    page.requests.clear()
    page.evaluate(f"look({left}, {top}, {VIEW[0]}, {VIEW[1]})")
    shown = screen(page, tmp_path)
    expected = panorama[top : top + VIEW[1], left : left + VIEW[0]]
    # What JPEG alone takes from these pixels: the file's own tiles, put together by another reader.
    tiles = put_together(shot, left, top)
    error, codec = rms(shown, expected), rms(tiles, expected)
    assert 0 < codec < 6 and error < 1.1 * codec + 0.3
    assert rms(shown, tiles) < 0.7  # two decoders of JPEG: rounding
    by_one = min(rms(shown[2:-2, 2:-2], np.roll(tiles, by, (0, 1))[2:-2, 2:-2]) for by in ((0, 1), (1, 0)))
    assert by_one > 4 * rms(shown, tiles)  # a shift of one pixel would be seen
    level = n_levels(width, height) - 1
    columns, rows = (
        range(a // TILE_PX, (a + n - 1) // TILE_PX + 1) for a, n in ((left, VIEW[0]), (top, VIEW[1]))
    )
    assert len(columns) > 1 and len(rows) > 1
    known = page.evaluate("performance.getEntriesByType('resource').map((entry) => entry.name)")
    for name in (f"panorama_files/{level}/{column}_{row}.jpg" for column in columns for row in rows):
        assert any(url.endswith(name) for url in known), name
    assert page.errors == [] and page.evaluate("failed") == []
    assert all(url.startswith("http://127.0.0.1:") for url in page.requests + known if url[:5] != "data:")


def put_together(shot: Path, left: int, top: int) -> NDArray[np.int_]:
    """The view port's pixels from the tiles of the full level, decoded by Pillow."""
    folder = max((shot / "panorama_files").iterdir(), key=lambda level: int(level.name))
    whole = np.zeros((VIEW[1], VIEW[0], 3), int)
    for row in range(top // TILE_PX, (top + VIEW[1] - 1) // TILE_PX + 1):
        for column in range(left // TILE_PX, (left + VIEW[0] - 1) // TILE_PX + 1):
            with Image.open(BytesIO((folder / f"{column}_{row}.jpg").read_bytes())) as picture:
                tile = np.asarray(picture)
            x, y = (max(n * TILE_PX - OVERLAP_PX, 0) - start for n, start in ((column, left), (row, top)))
            x0, y0 = max(x, 0), max(y, 0)
            part = tile[y0 - y : y0 - y + VIEW[1] - y0, x0 - x : x0 - x + VIEW[0] - x0]
            whole[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]] = part
    return whole
