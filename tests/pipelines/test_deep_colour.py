"""Video of more than 8 bits through `render`: decoded and encoded with all its bits, tagged as it is coloured."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Colorspace
from PIL import Image

from pipelines.archive import write_camera_csv, write_run
from pipelines.decode import open_clip
from pipelines.errors import OutputError
from pipelines.hdr import bt709_table
from pipelines.pixels import deep_rgb_picture, rgb_picture
from pipelines.render.encode import EncodeOptions, clock_of, shown_colour, video_frame, video_writer
from pipelines.render.job import to_8_bits
from pipelines.render.opened import open_run
from pipelines.render.overlay import OverlayOptions, overlay
from pipelines.render.stabilise import StabiliseOptions, stabilise
from tests.pipelines.tables import camera_table, run_record, shot_record

SIZE = (320, 180)
BT709 = {"rgb_matrix": "ITU709", "primaries": 1, "transfer": 1}
HLG = {"rgb_matrix": "BT2020", "primaries": 9, "transfer": 18}


def codes(frame: av.VideoFrame) -> list[np.ndarray]:
    """10-bit planes of a picture."""
    return [
        np.frombuffer(bytes(p), "<u2").reshape(p.height, p.line_size // 2)[:, : p.width] for p in frame.planes
    ]


def ramp(h: int = 180, w: int = 320) -> np.ndarray:
    """(h, w, 3) of 0..65535: fine ramps that 8 bits would show in steps; greenish, not saturated."""
    x, y = np.meshgrid(np.linspace(0, 1, w), np.linspace(0, 1, h))
    rgb = np.stack([0.2 + 0.3 * x, 0.3 + 0.4 * (x + y) / 2, 0.25 + 0.2 * y], axis=-1)
    return (rgb * 65535 + 0.5).astype(np.uint16)


@pytest.mark.parametrize("matrix", [Colorspace.ITU709, Colorspace.ITU601, Colorspace.BT2020])
@pytest.mark.parametrize("form", ["yuv420p10le", "yuv422p10le"])
def test_codes_survive_there_and_back(matrix: Colorspace, form: str) -> None:
    """Decoded to RGB and encoded again: the same codes to one step of 10 bits, and none of them lost on average."""
    first = video_frame(ramp(), matrix, form)
    first.colorspace = {"ITU709": 1, "ITU601": 6, "BT2020": 9}[matrix.name]
    first.color_range = 1
    rgb = deep_rgb_picture(first, 0)
    assert rgb.dtype == np.uint16 and np.abs(rgb.astype(float) - ramp()).max() < 65535 / 1023 * 2.5
    again = video_frame(rgb, matrix, form)
    for a, b in zip(codes(first), codes(again), strict=True):
        away = b.astype(int) - a
        assert np.abs(away[2:-2, 2:-2]).max() <= 1 and abs(away.mean()) < 0.1
    assert len(np.unique(codes(first)[0])) > 256 * 219 / 255 * 0.5  # finer than 8 bits can be over this range
    # The 8-bit path cuts where this one rounds, and dithers: darker by a grey level or two.
    darker = to_8_bits(rgb).astype(float) - rgb_picture(first, 0)
    assert 0 <= darker.mean() < 2 and np.abs(darker).max() <= 5


def test_white_black_and_full_range_are_where_they_belong() -> None:
    for full, black, white in ((False, 64, 940), (True, 0, 1023)):
        for luma, wanted in ((black, 0), (white, 65535)):
            frame = av.VideoFrame(64, 32, "yuv420p10le")
            for plane, value in zip(frame.planes, (luma, 512, 512), strict=True):
                plane.update(np.full(plane.buffer_size // 2, value, "<u2").tobytes())
            frame.colorspace, frame.color_range = 1, 2 if full else 1
            np.testing.assert_array_equal(deep_rgb_picture(frame, 0), wanted)
    frame = av.VideoFrame.from_ndarray(np.full((32, 64, 3), (255, 128, 0), np.uint8), format="rgb24")
    np.testing.assert_array_equal(deep_rgb_picture(frame, 1)[0, 0], (65535, 128 * 257, 0))


@pytest.mark.parametrize(
    ("codec", "suffix", "named", "form"),
    [("hevc10", ".mp4", "hevc", "yuv420p10le"), ("hevc10", ".mkv", "hevc", "yuv420p10le"),
     ("prores", ".mov", "prores", "yuv422p10le")],
)  # fmt: skip
@pytest.mark.parametrize("colour", [BT709, HLG])
def test_ten_bits_are_written_with_their_tags(
    tmp_path: Path, codec: Any, suffix: str, named: str, form: str, colour: dict[str, Any]
) -> None:
    path = tmp_path / f"deep{suffix}"
    with video_writer(
        path,
        size_px=SIZE,
        clock=clock_of(np.arange(4) / 25, 25.0),
        colour=colour,
        options=EncodeOptions(codec=codec, crf=4),
    ) as writer:
        for _ in range(4):
            writer.write(ramp())
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (named, form)
        frames = list(container.decode(stream))
    assert len(frames) == 4
    frame = frames[2]
    assert int(frame.colorspace) == (9 if colour is HLG else 1)
    assert (int(frame.color_primaries), int(frame.color_trc)) == (colour["primaries"], colour["transfer"])
    away = deep_rgb_picture(frame, 0, mapped=False).astype(float) - ramp()
    assert np.abs(away.mean(axis=(0, 1))).max() < 65535 / 1023 * 0.5  # half a step of 10 bits
    assert np.sqrt(np.mean(away**2)) < 65535 / 255 * 0.6  # finer than 8 bits


def test_a_codec_and_a_name_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=r"prores does not go into it; end it in \.mov or \.mkv"),
        video_writer(
            tmp_path / "x.mp4", size_px=SIZE, clock=clock_of([0.0], 25.0), colour={},
            options=EncodeOptions(codec="prores"),
        ),
    ):  # fmt: skip
        pass


@pytest.fixture(scope="module")
def hlg_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, made up, on an HLG clip whose camera stands still."""
    folder = tmp_path_factory.mktemp("hlg")
    with video_writer(
        folder / "hlg.mov", size_px=SIZE, clock=clock_of(np.arange(5) / 25, 25.0), colour=HLG,
        options=EncodeOptions(codec="prores"),
    ) as writer:  # fmt: skip
        for _ in range(5):
            writer.write(ramp())
    n = 5
    values = {"f_px": 400.0, "aspect": 1.0, "cx_px": 159.5, "cy_px": 89.5, "k1": 0.0, "pan_deg": 0.0}
    table = camera_table(
        n, pts_s=np.arange(n) / 25, status=("ok",) * n, tilt_deg=np.zeros(n), roll_deg=np.zeros(n),
        **{name: np.full(n, value) for name, value in values.items()},
    )  # fmt: skip
    clip = open_clip(folder / "hlg.mov")
    facts = {"path": str(folder / "hlg.mov"), "size_px": list(SIZE), "picture_fps": 25.0}
    record = run_record((shot_record(last_frame=n - 1, reference_frame=2, calibration={}),), clip=facts)
    clip.close()
    write_run(folder / "run.json", record)
    write_camera_csv(folder / "camera.csv", table)
    return folder


@pytest.mark.slow
def test_a_stabilised_hlg_clip_stays_hlg_in_ten_bits_and_is_bt709_in_eight(hlg_run: Path) -> None:
    run = open_run(hlg_run)
    table = bt709_table(18, 9)
    for codec, suffix, tags in (("prores", ".mov", (9, 9, 18)), ("h264", ".mp4", (1, 1, 1))):
        path = hlg_run / f"still-{codec}{suffix}"
        stabilise(run, path, StabiliseOptions(), encode=EncodeOptions(codec=codec))  # type: ignore[arg-type]
        with av.open(str(path)) as container:
            frame = next(container.decode(container.streams.video[0]))
        assert (int(frame.colorspace), int(frame.color_primaries), int(frame.color_trc)) == tags
        seen = deep_rgb_picture(frame, 0, mapped=False)[90, 160] / 65535
        wanted = ramp()[90, 160] / 65535
        if codec == "h264":
            assert np.abs(seen - wanted).max() > 0.03  # it was mapped
            i = np.round(wanted * 32).astype(int)
            wanted = table[i[2], i[1], i[0]]  # the nearest node of the table
            np.testing.assert_allclose(seen, wanted, atol=0.06)
        else:
            np.testing.assert_allclose(seen, wanted, atol=0.003)


def test_an_inlay_in_an_hlg_clip_is_bt709_in_ten_bits_too(hlg_run: Path) -> None:
    """The board's colours are those of a screen: the clip is mapped to them, and the tags say so."""
    Image.new("RGBA", (60, 40), (200, 30, 20, 255)).save(hlg_run / "board.png")
    corners = np.array([[100.0, 60.0], [220.0, 60.0], [220.0, 120.0], [100.0, 120.0]])
    path = hlg_run / "over.mov"
    options = OverlayOptions(picture=hlg_run / "board.png", corners=corners, at=2, in_front=True)
    overlay(open_run(hlg_run), path, options, encode=EncodeOptions(codec="prores"))
    with av.open(str(path)) as container:
        frame = next(container.decode(container.streams.video[0]))
    assert (int(frame.colorspace), int(frame.color_primaries), int(frame.color_trc)) == (1, 1, 1)
    seen = deep_rgb_picture(frame, 0)
    np.testing.assert_allclose(seen[90, 160] / 257, (200, 30, 20), atol=2.5)
    assert len(np.unique(seen[150, :, 1])) > 100  # the ground beside it has more than 8 bits


def test_only_hdr_and_wide_gamuts_change_their_tags() -> None:
    assert shown_colour(HLG) == BT709 and shown_colour(BT709) == BT709
    odd = {"rgb_matrix": "ITU601", "primaries": 5, "transfer": 6}
    assert shown_colour(odd) == odd and shown_colour({}) == {}
    assert dataclasses.asdict(EncodeOptions())["codec"] == "h264" and not EncodeOptions().deep
