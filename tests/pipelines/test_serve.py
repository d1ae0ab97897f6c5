"""`serve`: what its addresses answer, and nothing else; the command; the viewer in a headless browser.

Rays and frames of a clicked point are compared with the API's; screenshots are for people to look at.
"""

from __future__ import annotations

import http.client
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from pipelines import cli, open_result
from pipelines.exports.panorama_json import read_surface
from pipelines.serve.answers import ServedRun, stretches
from pipelines.serve.server import RunServer, make_server
from pipelines.serve.tiles import UNSEEN, Tiles
from tests.pipelines.browser import Browser, Page, chromium
from tests.pipelines.end_to_end import SIZE, Finished, one_line
from tests.pipelines.test_export_command import finished


@contextmanager
def serving(out: Path) -> Iterator[RunServer]:
    with make_server(out, 0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def server(pan_run: Finished) -> Iterator[RunServer]:
    with serving(pan_run.out) as started:
        yield started


def fetch(
    server: RunServer, target: str, *, method: str = "GET", host: str | None = None
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers, body; the target goes out as it is written here."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    try:
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        connection.putheader("Host", host or f"127.0.0.1:{server.server_port}")
        connection.endheaders()
        reply = connection.getresponse()
        return reply.status, {k.lower(): v for k, v in reply.getheaders()}, reply.read()
    finally:
        connection.close()


def document(server: RunServer, target: str) -> Any:
    status, headers, body = fetch(server, target)
    assert status == 200 and headers["content-type"] == "application/json", (target, status)
    return json.loads(body)


# ---- addresses


def test_tiles_are_the_panorama(pan_run: Finished, server: RunServer) -> None:
    """Every tile of every level, put together, against the file as tifffile reads it."""
    path = pan_run.out / "shot-000" / "panorama.tif"
    told = document(server, "/api/run")["shots"][0]["panorama"]
    with tifffile.TiffFile(path) as tiff:
        levels = [level.asarray() for level in tiff.series[0].levels]
    assert told["levels"] == [[a.shape[1], a.shape[0]] for a in levels] and len(levels) > 1
    size = told["tile_px"]
    for number, rgba in enumerate(levels):
        h, w = rgba.shape[:2]
        whole = np.zeros((h, w, 3), np.uint8)
        for row in range(-(-h // size)):
            for column in range(-(-w // size)):
                status, headers, body = fetch(server, f"/tile/0/{number}/{column}/{row}")
                assert (status, headers["content-type"]) == (200, "image/jpeg")
                tile = np.asarray(Image.open(io.BytesIO(body)))
                whole[
                    row * size : row * size + tile.shape[0], column * size : column * size + tile.shape[1]
                ] = tile
        expected = np.where(rgba[..., 3:] > 127, rgba[..., :3], UNSEEN)
        assert np.abs(whole.astype(float) - expected).mean() < 4  # JPEG of a crowd
    assert fetch(server, f"/tile/0/{len(levels)}/0/0")[0] == fetch(server, "/tile/0/0/99/0")[0] == 404


def test_a_point_has_the_ray_and_the_frames_of_the_api(pan_run: Finished, server: RunServer) -> None:
    result = open_result(pan_run.out)
    surface = read_surface(pan_run.out / "shot-000" / "panorama.json")
    x, y = surface.width * 0.4, surface.height * 0.6
    told = document(server, f"/api/point/0?x={x}&y={y}")
    ray = surface.pixel_to_ray([x, y])
    np.testing.assert_allclose(told["ray"], ray, atol=1e-8)
    xy = result.ray_to_pixel(result.camera.frame, ray)
    inside = ((xy > -0.5) & (xy < [SIZE[0] - 0.5, SIZE[1] - 0.5])).all(axis=-1)
    assert told["n_frames"] == inside.sum() > 5
    assert told["frames"] == stretches(result.camera.frame[inside])
    best = told["best"]["frame"]
    np.testing.assert_allclose(told["best"]["pixel"], xy[best], atol=0.006)
    middle = np.linalg.norm(xy - [(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2], axis=-1)
    assert best == np.argmin(middle)
    one = document(server, f"/api/frame/0/{best}?x={x}&y={y}")
    np.testing.assert_allclose(one["pixel"], xy[best], atol=0.006)
    corner = surface.ray_to_pixel(result.pixel_to_ray(best, [[-0.5, -0.5]]))[0]
    np.testing.assert_allclose(one["outline"][0], corner, atol=0.06)
    assert one["thumbnail"] is not None
    status, headers, body = fetch(server, f"/thumbnail/{one['thumbnail']}")
    assert status == 200 and headers["content-type"].startswith("image/")
    assert Image.open(io.BytesIO(body)).size[0] == 160


def test_a_point_that_no_frame_sees_says_so(server: RunServer) -> None:
    told = document(server, "/api/point/0?x=-3000&y=0")
    assert told["n_frames"] == 0 and told["frames"] == [] and told["best"] is None


def test_stretches_of_frames() -> None:
    assert stretches(np.array([3, 4, 5, 9, 11, 12])) == [[3, 5], [9, 9], [11, 12]]
    assert stretches(np.array([], int)) == []


def test_only_the_addresses_of_the_table_answer(pan_run: Finished, server: RunServer) -> None:
    """Nothing of the disk comes out by a path, however it is written; other hosts and other methods are refused."""
    secret = pan_run.out.parent / "secret.txt"
    secret.write_text("not for the browser")
    for target in (
        "/../secret.txt", "/..%2fsecret.txt", "/%2e%2e/secret.txt", "/tile/../../secret.txt", "//secret.txt",
        f"/{secret}", "/report/../../secret.txt", "/shot-000/rows.npz", "/shot-000/",
        "/viewer.js/../viewer.html", "/etc/passwd",
        "/camera.csv/", "/camera.csv%00", "/thumbnail/../run.json", "/tile/0/0/-1/0", "/api/point/0",
        "/api/point/9?x=1&y=1",
        "/api/point/0?x=nan&y=1", "/api/point/0?x=inf&y=1", "/api/point/0?x=a&y=1", "/api/frame/0/99999",
        "/thumbnail/99999",
        "/tile/0/0/999999999/0", "/tile/" + "9" * 400 + "/0/0/0", "http://example.org/etc/passwd",
    ):  # fmt: skip
        status, _, body = fetch(server, target)
        assert status == 404 and b"not for the browser" not in body, target
    for host in ("example.org", "example.org:80", f"10.0.0.1:{server.server_port}", "127.0.0.1.example.org"):
        assert fetch(server, "/camera.csv", host=host)[0] == 403
    assert fetch(server, "/camera.csv", host=f"localhost:{server.server_port}")[0] == 200
    assert fetch(server, "/", method="POST")[0] == 501
    status, headers, body = fetch(server, "/run.json", method="HEAD")
    assert (
        status == 200
        and not body
        and int(headers["content-length"]) == (pan_run.out / "run.json").stat().st_size
    )
    for target in ("/", "/report", "/viewer.js"):
        policy = fetch(server, target)[1]["content-security-policy"]
        assert policy.startswith("default-src 'none'") and "http" not in policy
    assert fetch(server, "/camera.csv")[2] == (pan_run.out / "camera.csv").read_bytes()


def test_every_link_of_the_report_leads_somewhere(pan_run: Finished, server: RunServer) -> None:
    page = fetch(server, "/report")[2].decode()
    links = {link for link in re.findall(r'<a href="([^"#]+)"', page) if not link.startswith("data:")}
    assert {"camera.csv", "run.json", "shot-000/pairs.npz", "shot-000/panorama.jpg"} <= links
    for link in links:
        status, headers, body = fetch(server, f"/{link}")
        content = (pan_run.out / link).read_bytes()
        assert status == 200 and body == content and int(headers["content-length"]) == len(content), link
    assert fetch(server, "/shot-000/panorama.tif")[1]["content-type"] == "image/tiff"


def test_a_run_offers_no_file_outside_its_folder(tmp_path: Path) -> None:
    """Whatever its run.json claims."""
    secret = tmp_path / "secret.txt"
    secret.write_text("not for the browser")
    out = finished(tmp_path / "out")
    told = json.loads((out / "run.json").read_text())
    told["shots"][0]["files"] = ["../secret.txt", str(secret), "shot-000/gone.tif"]
    (out / "run.json").write_text(json.dumps(told))
    with serving(out) as server:
        for target in ("/../secret.txt", "/..%2Fsecret.txt", f"/{secret}", "/shot-000/gone.tif"):
            assert fetch(server, target)[0] == 404, target


def test_the_server_listens_on_loopback_alone(server: RunServer) -> None:
    assert server.socket.getsockname()[0] == "127.0.0.1"


def test_a_run_without_a_panorama_is_served_too(tmp_path: Path) -> None:
    out = finished(tmp_path / "out")
    with serving(out) as bare:
        assert [shot["panorama"] for shot in document(bare, "/api/run")["shots"]] == [None, None]
        assert (
            fetch(bare, "/tile/0/0/0/0")[0]
            == fetch(bare, "/api/point/0?x=1&y=1")[0]
            == fetch(bare, "/report")[0]
            == 404
        )


def test_tiles_of_many_threads_are_the_same(pan_run: Finished) -> None:
    path = pan_run.out / "shot-000" / "panorama.tif"
    alone = Tiles(path)
    wanted = {k: alone.jpeg(0, k, 0) for k in range(2)}
    alone.close()
    tiles = Tiles(path)
    got: list[tuple[int, bytes | None]] = []
    threads = [
        threading.Thread(target=lambda k=k % 2: got.append((k, tiles._jpeg(0, k, 0)))) for k in range(24)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    tiles.close()
    assert len(got) == 24 and all(data == wanted[k] for k, data in got)


# ---- the command


def test_what_cannot_be_served_is_said_in_one_line(
    pan_run: Finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for words, said in (
            ([tmp_path], "give the folder of a finished run"),
            ([pan_run.out, "--port", port], f"127.0.0.1:{port}: cannot be listened on"),
            ([pan_run.out, "--shots.min_frames", "5"], "serve has no settings"),
        ):
            assert cli.main(["serve", *map(str, words)]) == 2
            assert said in one_line(capsys.readouterr().err)
    damaged = finished(tmp_path / "out")
    (damaged / "shot-000").mkdir(exist_ok=True)
    (damaged / "shot-000" / "panorama.json").write_text("{}")
    (damaged / "shot-000" / "panorama.tif").write_bytes(b"no picture at all")
    assert cli.main(["serve", str(damaged), "--port", "0"]) == 2
    assert "panorama.tif: " in one_line(capsys.readouterr().err)


@pytest.mark.slow
def test_ctrl_c_ends_it_cleanly(pan_run: Finished) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "pipelines.cli", "serve", str(pan_run.out), "--port", "0", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        lines = []
        while not lines or lines[-1] != "}\n":
            lines.append(process.stdout.readline())
            assert lines[-1], "it ended"
        told = json.loads("".join(lines))
        assert told["url"] == f"http://127.0.0.1:{told['port']}/"
        connection = http.client.HTTPConnection("127.0.0.1", told["port"], timeout=20)
        connection.request("GET", "/")
        assert connection.getresponse().status == 200  # and the connection stays open
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
        connection.close()
        assert (process.returncode, out, err) == (0, "", "")
    finally:
        process.kill()
        process.wait()


# ---- the viewer


needs_browser = pytest.mark.skipif(chromium() is None, reason="chromium is not installed")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as started:
        yield started


def until(page: Page, condition: str, patience_s: float = 20.0) -> None:
    """Wait for a condition in the page. Fails when it does not come."""
    deadline = time.monotonic() + patience_s
    while not page.evaluate(f"Boolean({condition})"):
        assert time.monotonic() < deadline, condition
        page.settle()


def state(page: Page) -> dict[str, Any]:
    """Where the viewer looks and what it says."""
    said: dict[str, Any] = page.evaluate(
        """(() => { const d = document.documentElement.dataset, text = (id) => document.getElementById(id).textContent;
        return { zoom: +d.zoom, left: +d.left, top: +d.top, level: +d.level, frame: d.frame ? +d.frame : null,
                 ray: text("ray"), angles: text("angles"), seen: text("seen"), where: text("where"),
                 name: text("frame-name"), pixel: text("pixel") }; })()"""
    )
    return said


def opened(browser: Browser, server: RunServer, **kwargs: Any) -> Page:
    page = browser.open(server.url, **kwargs)
    until(page, "document.documentElement.dataset.ready === '0'")
    until(page, "document.documentElement.dataset.missing === '0'")
    return page


def plain(text: str) -> list[float]:
    return [float(part) for part in re.findall(r"-?\d+(?:\.\d+)?", text.replace("−", "-"))]


@pytest.mark.oracle
@needs_browser
def test_a_click_says_the_ray_and_jumps_to_the_frames(
    browser: Browser, server: RunServer, pan_run: Finished, tmp_path: Path
) -> None:
    page = opened(browser, server)
    surface = read_surface(pan_run.out / "shot-000" / "panorama.json")
    left, top, width, height = page.place_of("#view")
    before = state(page)
    sx, sy = 0.45 * width, 0.55 * height
    page.move(left + sx, top + sy)
    hovered = plain(state(page)["where"])
    wanted = [before["left"] + sx / before["zoom"], before["top"] + sy / before["zoom"]]
    np.testing.assert_allclose(hovered, wanted, atol=0.1)
    page.click(left + sx, top + sy)
    until(page, "document.documentElement.dataset.frame")
    said = state(page)
    np.testing.assert_allclose(plain(said["pixel"]), wanted, atol=0.6)
    np.testing.assert_allclose(plain(said["ray"]), surface.pixel_to_ray(wanted), atol=2e-3)
    told = document(server, f"/api/point/0?x={wanted[0]}&y={wanted[1]}")
    assert said["frame"] == told["best"]["frame"] and said["seen"] == f"{told['n_frames']} frames"
    # The frame's outline is on the canvas: yellow along one of its sides.
    page.screenshot(tmp_path / "viewer.png")
    picture = np.asarray(Image.open(tmp_path / "viewer.png").convert("RGB")).astype(int)
    yellow = (picture[..., 0] > 220) & (picture[..., 1] > 180) & (picture[..., 2] < 120)
    assert yellow.sum() > 300
    # The thumbnail is there, and the buttons and keys step through the frames that see the point.
    assert page.evaluate("document.getElementById('thumb').naturalWidth") == 160
    page.evaluate("document.getElementById('view').focus()")
    for key, by in ((".", 1), (".", 1), (",", -1)):
        frame = state(page)["frame"]
        page.evaluate(
            f"document.getElementById('view').dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))"
        )
        last = told["frames"][-1][-1]
        until(page, f"+document.documentElement.dataset.frame === {min(frame + by, last)}")
    page.evaluate("document.querySelector('#frames button').click()")
    until(page, "document.querySelector('#frames button').getAttribute('aria-current') === 'true'")
    # From there into the report, at that frame.
    frame = state(page)["frame"]
    assert page.evaluate("document.getElementById('open').href").endswith(f"/report#frame={frame}")
    report = browser.open(f"{server.url}report#frame={frame}")
    assert report.evaluate("document.getElementById('readout').textContent").startswith(f"frame {frame}")
    for asked in (page, report):
        assert all(url.startswith((server.url, "data:")) for url in asked.requests), asked.requests
        assert asked.errors == []


@pytest.mark.oracle
@needs_browser
def test_zoom_goes_about_the_pointer_and_loads_finer_tiles(browser: Browser, server: RunServer) -> None:
    page = opened(browser, server)
    left, top, width, height = page.place_of("#view")
    first = state(page)
    sx, sy = 0.3 * width, 0.5 * height
    under = [first["left"] + sx / first["zoom"], first["top"] + sy / first["zoom"]]
    for _ in range(6):
        wheel = {"type": "mouseWheel", "x": left + sx, "y": top + sy, "deltaX": 0, "deltaY": -120}
        page.call("Input.dispatchMouseEvent", wheel)
        page.settle()
    until(page, f"+document.documentElement.dataset.zoom > {2.5 * first['zoom']}")
    until(page, "document.documentElement.dataset.missing === '0'")
    now = state(page)
    np.testing.assert_allclose(
        [now["left"] + sx / now["zoom"], now["top"] + sy / now["zoom"]], under, atol=1.5 / now["zoom"]
    )
    assert now["level"] < first["level"] or first["level"] == 0
    assert any("/tile/0/0/" in url for url in page.requests)
    page.drag(left + 0.5 * width, top + 0.5 * height, left + 0.5 * width - 60, top + 0.5 * height)
    np.testing.assert_allclose(state(page)["left"], now["left"] + 60 / now["zoom"], atol=0.5)
    assert state(page)["frame"] is None, "a drag is no click"


@pytest.mark.oracle
@needs_browser
def test_the_keyboard_does_everything(browser: Browser, server: RunServer) -> None:
    page = opened(browser, server)
    page.evaluate("document.getElementById('view').focus()")
    first = state(page)

    def key(name: str) -> dict[str, Any]:
        event = f"new KeyboardEvent('keydown', {{key: {name!r}, bubbles: true, cancelable: true}})"
        page.evaluate(f"document.activeElement.dispatchEvent({event})")
        page.settle()
        return state(page)

    for _ in range(4):
        zoomed = key("+")
    assert zoomed["zoom"] == pytest.approx(first["zoom"] * 1.5**4, rel=1e-3)
    page.press("ArrowRight")
    assert state(page)["left"] > zoomed["left"]
    page.press("ArrowLeft")
    assert state(page)["left"] == pytest.approx(zoomed["left"], abs=0.1)
    assert key("-")["zoom"] < zoomed["zoom"]
    page.press("Enter")
    until(page, "document.documentElement.dataset.frame")
    assert "frame" in state(page)["seen"]
    assert key("Escape")["frame"] is None
    assert key("0")["zoom"] == pytest.approx(first["zoom"], rel=1e-3)
    # Everything that can be clicked has a name and can be reached.
    names = page.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas')].map(e =>"
        "e.getAttribute('aria-label') || e.textContent.trim() || (e.labels && e.labels.length ? 'label' : ''))"
    )
    assert all(names)


@pytest.mark.oracle
@needs_browser
def test_on_a_phone_nothing_runs_out_of_the_page(browser: Browser, server: RunServer, tmp_path: Path) -> None:
    page = opened(browser, server, size=(390, 844), mobile=True, dark=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    left, top, width, height = page.place_of("#view")
    assert width > 380 and height > 200
    page.call("Emulation.setTouchEmulationEnabled", {"enabled": True})
    for kind, points in (("touchStart", [{"x": left + width / 2, "y": top + height / 2}]), ("touchEnd", [])):
        page.call("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    until(page, "document.documentElement.dataset.frame")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.screenshot(tmp_path / "phone.png")
    assert page.errors == []


def test_a_served_run_knows_what_it_has(pan_run: Finished) -> None:
    run = ServedRun(pan_run.out)
    try:
        told = run.overview()
        assert told["report"] and told["name"] == pan_run.clip.name
        assert 0 in run.thumbnails
    finally:
        run.close()
