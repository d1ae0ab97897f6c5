"""Tiny clips for the tests of the shell, written with PyAV's own encoders. Truth is in the pixels: see `ramp`."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray


def ramp(index: int, size: tuple[int, int] = (64, 48)) -> NDArray[np.uint8]:
    """Gray picture (h, w): a slope right and down, brighter by 4 a frame, so that each frame says which it is."""
    w, h = size
    y, x = np.mgrid[:h, :w]
    return (40 + 4 * (index % 25) + x // 2 + y // 2).astype(np.uint8)


def write_clip(
    path: Path,
    n: int = 12,
    *,
    size: tuple[int, int] = (64, 48),
    fps: Fraction = Fraction(25),
    codec: str = "ffv1",
    pix_fmt: str = "yuv420p",
    pts: list[int] | None = None,
    metadata: dict[str, str] | None = None,
    pictures: list[NDArray[Any]] | None = None,
    sar: Fraction | None = None,
    rotation: int = 0,
    options: dict[str, str] | None = None,
    colour: dict[str, int] | None = None,
) -> Path:
    """n pictures; `pictures` are RGB (h, w, 3) or the luma (h, w) as it shall be stored; pts in frames."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps, options=options or {})
        assert isinstance(stream, VideoStream)
        w, h = size
        stream.width, stream.height, stream.pix_fmt = w, h, pix_fmt
        stream.time_base = 1 / fps
        if sar is not None:
            stream.codec_context.sample_aspect_ratio = sar
        for key, value in (colour or {}).items():
            setattr(stream.codec_context, key, value)
        for key, text in (metadata or {}).items():
            stream.metadata[key] = text
            container.metadata[key] = text
        if rotation:
            stream.set_display_rotation(rotation)
        for i in range(n):
            picture = pictures[i] if pictures is not None else ramp(i, size)
            frame = video_frame(picture, pix_fmt)
            for key, value in (colour or {}).items():
                setattr(frame, key, value)
            frame.pts = pts[i] if pts is not None else i
            frame.time_base = 1 / fps
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def video_frame(picture: NDArray[Any], pix_fmt: str) -> av.VideoFrame:
    """RGB (h, w, 3), or luma (h, w) as it shall be stored."""
    if picture.ndim == 3:
        return av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pix_fmt)
    h, w = picture.shape
    frame = av.VideoFrame(w, h, pix_fmt)
    for number, plane in enumerate(frame.planes):
        deep = "10" in pix_fmt
        sample = np.dtype("<u2") if deep else np.dtype(np.uint8)
        rows = np.zeros((plane.height, plane.line_size // sample.itemsize), sample)
        rows[:, : plane.width] = picture if number == 0 else (512 if deep else 128)
        plane.update(rows.tobytes())
    return frame


def write_audio(path: Path) -> Path:
    """A file with sound only."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
