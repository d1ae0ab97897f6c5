"""What a container holds beside the pictures, or lacks of them: edit lists, other streams, a start that is missing."""

from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pipelines.decode import open_clip
from tests.pipelines.clips import ramp, video_frame, write_clip

RATE = Fraction(25)


def decoded(path: Path) -> tuple[list[int], list[float], list[str]]:
    """Grey of the first pixel and time of every picture, and the warnings; read twice, as a run does."""
    with open_clip(path) as clip:
        frames = list(clip)
        assert len(list(clip)) == len(frames)
        return [int(f.gray[0, 0]) for f in frames], [f.pts_s for f in frames], clip.facts.warnings


def remuxed(source: Path, target: Path, moved: Callable[[int, int], int]) -> Path:
    """The packets of `source` with other time stamps: moved(ticks, ticks a frame)."""
    with av.open(str(source)) as a, av.open(str(target), "w", options={"avoid_negative_ts": "disabled"}) as b:
        video = a.streams.video[0]
        assert video.time_base is not None
        stream, frame = b.add_stream_from_template(video), int(1 / (RATE * video.time_base))
        for packet in a.demux(video):
            if packet.dts is not None and packet.pts is not None:
                packet.pts, packet.dts = moved(packet.pts, frame), moved(packet.dts, frame)
                packet.stream = stream
                b.mux(packet)
    return target


@pytest.mark.parametrize("n_cut", [3, 7])
def test_pictures_that_an_edit_list_leaves_out_are_not_missed(tmp_path: Path, n_cut: int) -> None:
    """A player's trim writes negative times and an edit list: those pictures are only decoded for what follows."""
    whole = write_clip(tmp_path / "whole.mp4", 24, codec="libx264", options={"bf": "2", "g": "12"})
    trimmed = remuxed(whole, tmp_path / "trimmed.mp4", lambda t, frame: t - n_cut * frame)
    grey, times, warnings = decoded(trimmed)
    assert (len(grey), warnings) == (24 - n_cut, [])
    assert grey == decoded(whole)[0][n_cut:] and times[0] == 0.0
    # And at the end: half the length of the list's one segment.
    data = bytearray(trimmed.read_bytes())
    at = data.index(b"elst") + 12
    (length,) = struct.unpack_from(">I", data, at)
    struct.pack_into(">I", data, at, length // 2)
    trimmed.write_bytes(data)
    shorter, _, warnings = decoded(trimmed)
    assert warnings == [] and shorter == grey[: len(shorter)] and abs(len(shorter) - len(grey) / 2) <= 1


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts"])
@pytest.mark.parametrize(
    "sizes", [((32, 24), (64, 48)), ((64, 48), (32, 24))], ids=["small_first", "large_first"]
)
def test_of_several_video_streams_the_largest_is_used_and_said_once(
    tmp_path: Path, name: str, sizes: tuple[tuple[int, int], ...]
) -> None:
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        streams: list[Any] = []
        for width, height in sizes:
            stream: Any = container.add_stream("libx264", rate=RATE)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for i in range(12):
            for stream in streams:
                container.mux(stream.encode(timed(i, (stream.width, stream.height))))
        for stream in streams:
            container.mux(stream.encode(None))
    with open_clip(path) as clip:
        assert len(list(clip)) == 12 and clip.facts.size_px == (64, 48)
        used = sizes.index((64, 48))
        assert clip.facts.warnings == [f"2 video streams; only stream {used} (64x48) is used"]


def timed(index: int, size: tuple[int, int] = (64, 48)) -> av.VideoFrame:
    frame = video_frame(ramp(index, size), "yuv420p")
    frame.pts, frame.time_base = index, 1 / RATE
    return frame


def test_a_cover_larger_than_the_pictures_is_not_taken_for_them(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        cover: Any = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 400, 400, "yuvj420p"
        video: Any = container.add_stream("libx264", rate=RATE)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        still = av.VideoFrame.from_ndarray(np.full((400, 400, 3), 80, np.uint8)).reformat(format="yuvj420p")
        still.pts = 0
        container.mux(cover.encode(still))
        for i in range(12):
            container.mux(video.encode(timed(i)))
        container.mux([*cover.encode(None), *video.encode(None)])
    with open_clip(path) as clip:
        assert len(list(clip)) == 12 and clip.facts.size_px == (64, 48)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.mov"])
def test_sound_that_goes_on_after_the_pictures_is_no_truncation(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        video: Any = container.add_stream("libx264", rate=RATE)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        audio: Any = container.add_stream("aac", rate=48000)
        for i in range(25):
            container.mux(video.encode(timed(i)))
        container.mux(video.encode(None))
        for k in range(0, 6 * 48000, 1024):
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            sound.sample_rate, sound.pts, sound.time_base = 48000, k, Fraction(1, 48000)
            container.mux(audio.encode(sound))
        container.mux(audio.encode(None))
    grey, _, warnings = decoded(path)
    assert (len(grey), warnings) == (25, [])


def test_data_beside_the_pictures_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.ts"
    with av.open(str(path), "w") as container:
        video: Any = container.add_stream("libx264", rate=RATE)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        data: Any = container.add_data_stream("bin_data")
        for i in range(12):
            container.mux(video.encode(timed(i)))
            packet = av.Packet(b"where the ball is: %d" % i)
            packet.stream, packet.pts, packet.dts, packet.time_base = data, i, i, 1 / RATE
            container.mux(packet)
        container.mux(video.encode(None))
    grey, _, warnings = decoded(path)
    assert (len(grey), warnings) == (12, [])


@pytest.mark.parametrize("codec", ["libx264", "mpeg2video"])
def test_a_recording_that_begins_between_key_pictures_says_that_its_start_is_missing(
    tmp_path: Path, codec: str
) -> None:
    whole = write_clip(tmp_path / "whole.ts", 60, codec=codec, options={"g": "12", "bf": "2"})
    data = whole.read_bytes()
    n = len(data) // 188
    late = tmp_path / "late.ts"
    late.write_bytes(
        data[: 3 * 188] + data[n // 3 * 188 :]
    )  # the tables, then from within the second group on
    grey, times, warnings = decoded(late)
    known = decoded(whole)
    assert grey == known[0][-len(grey) :] and times[-1] == pytest.approx(known[1][-1])
    assert len(grey) in (36, 48)
    assert [w.split(" s ")[1] for w in warnings] == ["are damaged, or lack the picture that they build on"]


@pytest.mark.parametrize("name", ["a.ts", "a.mkv"])
def test_a_clock_that_leaps_ahead_or_begins_below_zero_loses_no_picture(tmp_path: Path, name: str) -> None:
    whole = write_clip(tmp_path / "whole.mp4", 24, codec="libx264", options={"bf": "2", "g": "12"})
    expected = decoded(whole)[0]
    leap = remuxed(whole, tmp_path / f"leap-{name}", lambda t, frame: t + 90_000 * frame * (t >= 12 * frame))
    grey, times, warnings = decoded(leap)
    assert grey == expected and (np.diff(times) > 0).all()
    assert len(warnings) == 1 and warnings[0].startswith("1 gaps in the time stamps, the longest 3600.0")
    below = remuxed(whole, tmp_path / f"below-{name}", lambda t, frame: t - 5 * frame)
    grey, times, _ = decoded(below)
    assert grey == expected and (np.diff(times) > 0).all()
