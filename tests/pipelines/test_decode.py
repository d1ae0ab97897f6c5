"""Decoding: pixels, times, time code, fields, damage and refusals, on clips made here."""

from __future__ import annotations

import math
import os
import threading
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pipelines.config import DecodeOptions
from pipelines.decode import Clip, Frame, open_clip
from pipelines.errors import InputError
from pipelines.picture import Picture
from pipelines.stills import list_images
from pipelines.timing import PtsRepair, Timecode
from tests.pipelines.clips import ramp, write_audio, write_clip


def decode(path: Path, **options: object) -> tuple[Clip, list[Frame]]:
    with open_clip(path, DecodeOptions.model_validate(options)) as clip:
        return clip, list(clip)


def test_gray_is_the_stored_luma_and_outlives_the_decoder(tmp_path: Path) -> None:
    clip, frames = decode(write_clip(tmp_path / "a.mkv", 8, size=(66, 50)))
    assert clip.facts.size_px == (66, 50)
    assert [f.index for f in frames] == list(range(8))
    for i, frame in enumerate(frames):
        assert (
            frame.gray.dtype == np.uint8 and frame.gray.flags.c_contiguous and not frame.gray.flags.writeable
        )
        np.testing.assert_array_equal(frame.gray, ramp(i, (66, 50)))
        assert frame.pts_s == pytest.approx(i / 25, abs=5e-4)  # Matroska counts in ms
        assert frame.field is None and frame.source_frame == i and frame.mask is None


def test_ten_bit_is_scaled_to_255_not_dithered(tmp_path: Path) -> None:
    deep = [(ramp(i).astype(np.uint16) * 4 + i % 4) for i in range(4)]
    _, frames = decode(write_clip(tmp_path / "a.mkv", 4, pix_fmt="yuv420p10le", pictures=deep))
    for frame, stored in zip(frames, deep, strict=True):
        assert frame.gray.dtype == np.float32
        np.testing.assert_array_equal(frame.gray, stored / np.float32(4))


@pytest.mark.parametrize(("height", "matrix"), [(48, "ITU601"), (720, "ITU709")])
def test_untagged_colour_uses_bt709_from_720_lines(tmp_path: Path, height: int, matrix: str) -> None:
    red = np.zeros((height, 64, 3), np.uint8)
    red[..., 0] = 255
    source = av.VideoFrame.from_ndarray(red, format="rgb24").reformat(
        format="yuv444p", dst_colorspace=matrix, dst_color_range="MPEG"
    )
    planes = [np.frombuffer(p, np.uint8).reshape(p.height, p.line_size)[0, 0] for p in source.planes]
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, height, "yuv444p"
        for i in range(2):
            frame = av.VideoFrame(64, height, "yuv444p")
            for plane, value in zip(frame.planes, planes, strict=True):
                plane.update(np.full((plane.height, plane.line_size), value, np.uint8))
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    clip, frames = decode(path)
    assert clip.facts.colour["space"] == 2 and clip.facts.colour["rgb_matrix"] == matrix
    picture = frames[0].picture()
    assert picture.shape == (height, 64, 3)
    assert picture[0, 0].tolist() == pytest.approx([255, 0, 0], abs=2)


def test_rotated_file_is_put_upright(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", 3, codec="libx264", rotation=90, options={"qp": "0"})
    clip, frames = decode(path)
    assert clip.facts.size_px == (48, 64) and clip.facts.rotation_deg == 90
    np.testing.assert_array_equal(frames[1].gray, np.rot90(ramp(1)))
    assert frames[1].picture().shape == (64, 48, 3)
    assert any("rotated" in w for w in clip.facts.warnings)


def test_pixel_aspect_comes_from_the_file_or_the_user(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", 2, sar=Fraction(64, 45), codec="libx264")
    assert decode(path)[1][0].pixel_aspect == pytest.approx(64 / 45, rel=1e-3)
    assert decode(path, pixel_aspect=1.0)[1][0].pixel_aspect == 1.0


def test_timecode_counts_on_from_the_stream(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mov", 4, codec="libx264", metadata={"timecode": "09:59:59:23"})
    clip, frames = decode(path)
    assert [f.timecode for f in frames] == ["09:59:59:23", "09:59:59:24", "10:00:00:00", "10:00:00:01"]
    assert clip.facts.timecode == "09:59:59:23"


def test_zero_timecode_means_nobody_set_one(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mov", 2, codec="libx264", metadata={"timecode": "00:00:00:00"})
    assert [f.timecode for f in decode(path)[1]] == ["", ""]
    assert decode(path, accept_zero_timecode=True)[1][1].timecode == "00:00:00:01"


def test_drop_frame_timecode_skips_two_numbers_a_minute_but_not_the_tenth() -> None:
    fps = 30000 / 1001
    for before, after in [
        ("00:00:59;29", "00:01:00;02"),
        ("00:09:59;29", "00:10:00;00"),
        ("23:59:59;29", "00:00:00;00"),
    ]:
        start = Timecode.parse(before, fps)
        assert start is not None and str(start) == before
        assert str(start.after(1 / fps)) == after
    assert Timecode.parse("10:00:00:25", 25.0) is None
    assert Timecode.parse("soon", 25.0) is None
    assert Timecode.parse("10:00:00:00", math.nan) is None
    # 01:02:03:04, as the 25 bits of MPEG-2
    assert str(Timecode.from_mpeg(1 << 19 | 2 << 13 | 1 << 12 | 3 << 6 | 4, 25.0)) == "01:02:03:04"


def test_mpeg2_timecode_comes_from_its_group_of_pictures(tmp_path: Path) -> None:
    options = {"gop_timecode": "01:02:03:23"}
    path = write_clip(tmp_path / "a.ts", 30, size=(320, 240), codec="mpeg2video", options=options)
    assert [f.timecode for f in decode(path)[1]][:3] == ["01:02:03:23", "01:02:03:24", "01:02:04:00"]


def repair(times: list[float], fps: float = 25.0) -> tuple[list[float], PtsRepair]:
    fixer = PtsRepair(fps)
    pictures = (Picture(video=None, source_frame=i, pts_s=t, frame_start_s=t) for i, t in enumerate(times))  # type: ignore[arg-type]
    return [p.pts_s for p in fixer.apply(pictures)], fixer


def test_good_times_are_left_alone_even_when_they_vary() -> None:
    times = [0.0, 0.04, 0.09, 0.12, 0.30, 0.33]
    fixed, fixer = repair(times)
    assert fixed == times and fixer.n_repaired == 0
    assert fixer.n_gaps == 1 and "0.180 s before frame 4" in fixer.warnings()[0]


@pytest.mark.parametrize(
    ("damaged", "at", "expected"),
    [
        ([0, 1, 2, math.nan, 4, 5], 3, 3),  # no time stamp
        ([0, 1, 2, 14, 4, 5], 3, 3),  # a spike ahead
        ([0, 1, 2, 2, 4, 5], 3, 2.25),  # repeated
        ([0, 1, 2, 3, 0, 1, 2], 6, 6),  # the clock starts anew
    ],
)
def test_damaged_times_are_repaired_and_only_those(damaged: list[float], at: int, expected: float) -> None:
    fixed, fixer = repair([t / 25 for t in damaged])
    assert all(b > a for a, b in pairwise(fixed))
    assert fixed[at] == pytest.approx(expected / 25)
    assert fixed[:3] == [0, 1 / 25, 2 / 25] and fixer.n_repaired >= 1
    if len(damaged) == 6:
        assert fixed[4:] == [4 / 25, 5 / 25] and fixer.n_repaired == 1


def test_variable_rate_goes_by_time_stamps_not_by_count(tmp_path: Path) -> None:
    pts = [0, 1, 2, 6, 7, 9]
    _, frames = decode(write_clip(tmp_path / "a.mkv", 6, pts=pts))
    assert [f.pts_s for f in frames] == pytest.approx([p / 25 for p in pts], abs=5e-4)


def interlaced_clip(path: Path, n: int, top_first: bool) -> Path:
    """A bright bar that moves 2 px a field; x264 in its lossless interlaced mode."""
    with av.open(str(path), "w") as container:
        order = "tff" if top_first else "bff"
        stream = container.add_stream("libx264", rate=25, options={"qp": "0", "x264-params": f"{order}=1"})
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        graph = av.filter.Graph()
        source = graph.add_buffer(width=128, height=96, format="yuv420p", time_base=Fraction(1, 25))
        mark = graph.add("setfield", order)
        sink = graph.add("buffersink")
        source.link_to(mark)
        mark.link_to(sink)
        graph.configure()
        for i in range(n):
            luma = np.empty((96, 128), np.uint8)
            for field in (0, 1):
                row = field if top_first else 1 - field
                luma[row::2] = bar(2 * (2 * i + field))
            frame = av.VideoFrame(128, 96, "yuv420p")
            for number, plane in enumerate(frame.planes):
                rows = np.full((plane.height, plane.line_size), 128, np.uint8)
                if number == 0:
                    rows[:, :128] = luma
                plane.update(rows)
            frame.pts, frame.time_base = i, Fraction(1, 25)
            graph.vpush(frame)
            container.mux(stream.encode(graph.vpull()))
        container.mux(stream.encode(None))
    return path


def bar(shift: float) -> np.ndarray:
    x = np.arange(128)
    return (60 + 120 * np.exp(-0.5 * ((x - 20 - shift) / 4) ** 2)).astype(np.uint8)


@pytest.mark.parametrize("top_first", [True, False])
def test_fields_become_pictures_in_order_of_time(tmp_path: Path, top_first: bool) -> None:
    path = interlaced_clip(tmp_path / "a.mkv", 8, top_first)
    clip, frames = decode(path)
    assert (
        clip.facts.interlaced
        and clip.facts.deinterlace == "bwdif send_field"
        and clip.facts.picture_fps == 50
    )
    assert len(frames) == 16 and clip.counts["decoded"] == 8
    assert [(f.source_frame, f.field) for f in frames] == [(i // 2, i % 2) for i in range(16)]
    assert [f.pts_s for f in frames] == pytest.approx([i / 50 for i in range(16)], abs=1e-3)
    centres = [float(np.average(np.arange(128), weights=f.gray[48].astype(float) - 59)) for f in frames]
    assert np.diff(centres)[1:-1] == pytest.approx(2.0, abs=0.3)  # wrong parity would give -2, 6, -2 ...
    assert any("interlaced" in w for w in clip.facts.warnings)


def test_deinterlacing_by_frame_or_not_at_all(tmp_path: Path) -> None:
    path = interlaced_clip(tmp_path / "a.mkv", 6, True)
    clip, frames = decode(path, deinterlace="frame")
    assert clip.facts.deinterlace == "bwdif send_frame" and len(frames) == 6
    assert [f.pts_s for f in frames] == pytest.approx([i / 25 for i in range(6)], abs=1e-3)
    clip, frames = decode(path, deinterlace="off")
    assert clip.facts.deinterlace == "none" and clip.facts.interlaced
    np.testing.assert_array_equal(frames[1].gray[1], bar(6))


def test_image_folder_and_pattern_in_order_of_number(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    for i in range(11):
        cv2.imwrite(str(tmp_path / f"f{i}.png"), ramp(i))
    for path in (tmp_path, tmp_path / "f%d.png"):
        clip, frames = decode(path, image_fps=50)
        assert len(frames) == 11 and clip.facts.size_px == (64, 48)
        np.testing.assert_array_equal(frames[10].gray, ramp(10))  # f10 after f9, not after f1
        assert frames[10].pts_s == pytest.approx(0.2)


def test_what_lies_in_a_folder_of_images_and_is_no_file_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "f1.png").touch()
    (tmp_path / "f2.png").mkdir()
    os.mkfifo(tmp_path / "f3.png")  # opening it would wait for ever
    for path in (tmp_path, tmp_path / "f%d.png", tmp_path / "f*.png"):
        assert [p.name for p in list_images(path)] == ["f1.png"]


def test_images_of_sixteen_bits_with_a_photographs_notes_are_read(tmp_path: Path) -> None:
    # FFmpeg puts a TIFF's EXIF beside the picture, a kind of data that PyAV has no name for.
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.tif"), np.full((48, 64, 3), 257 * (20 + k), np.uint16))
    clip, frames = decode(tmp_path)
    assert (clip.facts.bit_depth, clip.facts.timecode) == (16, "")
    assert [round(float(f.gray.mean())) for f in frames] == [20, 21, 22]


def test_digits_that_are_no_decimals_do_not_upset_the_order_of_images(tmp_path: Path) -> None:
    for name in ("1²2.png", "1²10.png", "x.png"):
        (tmp_path / name).touch()
    assert [p.name for p in list_images(tmp_path)] == ["1²2.png", "1²10.png", "x.png"]


def test_second_pass_and_ranges_give_the_same_pictures(tmp_path: Path) -> None:
    with open_clip(write_clip(tmp_path / "a.mkv", 12)) as clip:
        everything = list(clip)
        assert [f.index for f in clip.frames(3, 4)] == [3, 4, 5, 6]
        some = list(clip.frames(only=[9, 2]))
        assert [f.index for f in some] == [2, 9]
        np.testing.assert_array_equal(some[1].gray, everything[9].gray)
        with pytest.raises(InputError, match="only 12 pictures"):
            list(clip.frames(first=20))


def test_no_thread_is_left_behind(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mkv", 40)
    clip = open_clip(path)
    iterator = iter(clip)
    next(iterator)
    assert any(t.name == "decode" for t in threading.enumerate())
    clip.close()
    assert not any(t.name == "decode" for t in threading.enumerate())
    for frame in open_clip(path):
        if frame.index == 2:
            break
    del frame
    assert not any(t.name == "decode" for t in threading.enumerate())


def test_damage_in_the_middle_does_not_end_the_clip(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", 30, codec="libx264", size=(320, 240), options={"g": "5", "bf": "0"})
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 900
    rng = np.random.default_rng(5)
    for position in rng.integers(start, start + 3000, 200):
        data[position] ^= 0xFF
    path.write_bytes(data)
    clip, frames = decode(path)
    assert frames[-1].pts_s == pytest.approx(29 / 25, abs=0.05)
    lost = 30 - len(frames)
    assert lost + clip.counts["failed_packets"] > 0
    assert any("damaged packets" in w or "header promises" in w for w in clip.facts.warnings)


@pytest.mark.parametrize(("name", "codec"), [("a.mkv", "ffv1"), ("a.ts", "mpeg2video")])
def test_what_is_left_of_a_truncated_stream_is_used_and_said(tmp_path: Path, name: str, codec: str) -> None:
    path = write_clip(tmp_path / name, 60, size=(320, 240), codec=codec)
    whole = path.read_bytes()
    clip, frames = decode(path)
    assert len(frames) == 60
    assert not any("truncated" in w for w in clip.facts.warnings)
    path.write_bytes(whole[: len(whole) * 7 // 10 - 7])
    clip, frames = decode(path)
    assert 5 < len(frames) < 60
    assert any("truncated" in w for w in clip.facts.warnings)


def broken_inputs(folder: Path) -> dict[str, tuple[Path, str]]:
    text = folder / "text.mp4"
    text.write_text("this is not a video\n" * 50)
    ansi = folder / "notes.txt"
    ansi.write_text("nor is this\n" * 50)
    whole = write_clip(folder / "whole.mp4", 6, codec="libx264").read_bytes()
    (folder / "cut.mp4").write_bytes(whole[: whole.index(b"moov") - 8])
    (folder / "empty.mp4").write_bytes(b"")
    (folder / "folder").mkdir()
    (folder / "noise.mp4").write_bytes(np.random.default_rng(1).bytes(5000))
    (folder / "list.mp4").write_text("ffconcat version 1.0\nfile whole.mp4\n")
    os.mkfifo(folder / "pipe.mp4")  # with nobody at its other end: opening it would wait for ever
    return {
        "missing": (folder / "none.mp4", "no such file"),
        "text": (text, "text"),
        "ansi": (ansi, "text"),
        "truncated": (folder / "cut.mp4", "truncated"),
        "empty": (folder / "empty.mp4", "empty"),
        "noise": (folder / "noise.mp4", "not a video"),
        "audio": (write_audio(folder / "sound.m4a"), "no video stream"),
        "no images": (folder / "folder", "no images"),
        "no match": (folder / "folder" / "%04d.png", "no file matches"),
        "one frame": (write_clip(folder / "one.mkv", 1), "only one picture"),
        "indirect": (folder / "list.mp4", "list of other files"),
        "pipe": (folder / "pipe.mp4", "pipe or a device"),
        "long name": (folder / f"{'a' * 300}.mp4", "name too long"),
        "zero byte": (folder / "a\0b.mp4", "zero byte"),
    }


KINDS = (
    "missing",
    "text",
    "ansi",
    "truncated",
    "empty",
    "noise",
    "audio",
    "no images",
    "no match",
    "one frame",
    "indirect",
    "pipe",
    "long name",
    "zero byte",
)


@pytest.mark.parametrize("kind", KINDS)
def test_unusable_input_names_file_cause_and_cure_in_one_line(tmp_path: Path, kind: str) -> None:
    path, cause = broken_inputs(tmp_path)[kind]
    with pytest.raises(InputError) as caught:
        decode(path)
    assert cause in caught.value.cause.lower() and caught.value.cure
    assert path.name.replace("\0", "\\x00") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_absurd_declared_sizes_are_refused(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mkv", 2, size=(130, 16))
    with pytest.raises(InputError, match="130x16"):
        decode(path, max_side_px=128)


def test_identity_follows_the_content_not_the_name(tmp_path: Path) -> None:
    a = open_clip(write_clip(tmp_path / "a.mkv", 3)).facts
    (tmp_path / "b.mkv").write_bytes((tmp_path / "a.mkv").read_bytes())
    b = open_clip(tmp_path / "b.mkv").facts
    c = open_clip(write_clip(tmp_path / "c.mkv", 4)).facts
    assert a.identity() == b.identity() != c.identity()
    assert a.sha256() == b.sha256() != c.sha256()
