"""Pictures out: H.264, or HEVC and ProRes of 10 bits, with the clip's own times and colour tags, its sound beside them.

A file has its name only when it is whole. Colours are the decoder's RGB turned back by the same matrix; output is
always of limited range.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import cv2
import numpy as np
from av.video.reformatter import Colorspace
from numpy.typing import NDArray

from pipelines.errors import OutputError
from pipelines.exports.whole_file import whole_file
from pipelines.hdr import TRANSFERS, WIDE_PRIMARIES
from pipelines.pixels import LUMA_WEIGHTS

Codec = Literal["h264", "hevc10", "prores"]
SUFFIXES = (".mp4", ".mov", ".mkv")
# FFmpeg's AVColorSpace numbers of the matrices that decoding may have used.
MATRIX_TAG = {"ITU709": 1, "FCC": 4, "ITU601": 6, "SMPTE240M": 7, "BT2020": 9}
# What codec gives which pixels, through which of FFmpeg's encoders, in which containers.
CODECS = {
    "h264": ("libx264", "yuv420p", 8, (".mp4", ".mov", ".mkv")),
    "hevc10": ("libx265", "yuv420p10le", 10, (".mp4", ".mov", ".mkv")),
    "prores": ("prores_ks", "yuv422p10le", 10, (".mov", ".mkv")),
}
DEEP = 257  # from 0..255 to 0..65535
AT_LEFT, BETWEEN = np.array([0.25, 0.5, 0.25]), np.array([0.0, 0.5, 0.5])
UNSPECIFIED, LIMITED_RANGE = 2, 1
REGULAR = 0.1  # of a frame: an even rate in a container of milliseconds is off by .03 at 60 pictures/s
FINE_TICKS = 90_000  # per second, for clips of variable rate


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeOptions:
    """codec: 'h264' (8 bits, 4:2:0), 'hevc10' (10 bits, 4:2:0) or 'prores' (422 HQ, 10 bits; .mov or .mkv).

    crf: quality of the first two, 18 is hard to tell from the source. preset: theirs; 'fast' H.264 is about real time
    at 720p.
    """

    codec: Codec = "h264"
    crf: float = 18.0
    preset: str = "fast"

    @property
    def deep(self) -> bool:
        """Whether it keeps more than 8 bits, and so wants pictures of uint16."""
        return CODECS[self.codec][2] > 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """How pictures are stamped: ticks of 1 / ticks_per_s, and the rate that the header states."""

    rate: Fraction
    time_base: Fraction
    ticks: tuple[int, ...]


def clock_of(pts_s: Sequence[float] | NDArray[np.float64], fps: float) -> Clock:
    """Stamps for pictures at pts_s (s, rising), from 0. Whole frames where the rate is even, else 1/90000 s."""
    times = np.asarray(pts_s, np.float64)
    rate = nominal_rate(fps)
    frames = (times - times[0]) * float(rate)
    if np.isfinite(frames).all() and np.abs(frames - np.arange(len(frames))).max() < REGULAR:
        return Clock(rate=rate, time_base=1 / rate, ticks=tuple(range(len(frames))))
    exact = np.round((times - times[0]) * FINE_TICKS).astype(np.int64)
    return Clock(rate=rate, time_base=Fraction(1, FINE_TICKS), ticks=tuple(exact.tolist()))


def nominal_rate(fps: float) -> Fraction:
    """The rate as a fraction: n or n * 1000 / 1001 where it is one of television's, else to six digits."""
    for rate in (Fraction(round(fps)), Fraction(round(fps * 1.001) * 1000, 1001)):
        if rate > 0 and abs(float(rate) - fps) < 1e-3:
            return rate
    return Fraction(fps).limit_denominator(10_000)


@dataclass(slots=True, kw_only=True, eq=False)
class VideoWriter:
    """Takes pictures (h, w, 3) RGB in order, uint8, or uint16 of 0..65535, of which the codec keeps what it can.

    n_written counts them; sound says in words what became of it.
    """

    clock: Clock
    matrix: Colorspace
    tags: Mapping[str, int]
    size_px: tuple[int, int]
    pix_fmt: str
    _container: Any
    _stream: Any
    _sound: _Sound | None
    sound: str
    n_written: int = field(default=0)

    def write(self, picture: NDArray[Any]) -> None:
        """One more picture. Raises ValueError: too many, of another size, or of another kind of number."""
        w, h = self.size_px
        if picture.shape != (h, w, 3):
            raise ValueError(f"picture is {picture.shape}, the video ({h}, {w}, 3)")
        tick = self.clock.ticks[self.n_written]
        # 4:2:0 needs even sides: an odd last row or column goes.
        even = np.ascontiguousarray(picture[: h - h % 2, : w - w % 2])
        frame = video_frame(even, self.matrix, self.pix_fmt)
        for name, value in self.tags.items():
            setattr(frame, name, value)
        frame.pts, frame.time_base = tick, self.clock.time_base
        self._container.mux(self._stream.encode(frame))
        if self._sound is not None:
            self._sound.copy_until(float(tick * self.clock.time_base), self._container)
        self.n_written += 1


@contextmanager
def video_writer(
    path: Path,
    *,
    size_px: tuple[int, int],
    clock: Clock,
    colour: Mapping[str, Any],
    pixel_aspect: float = 1.0,
    sound_of: Path | None = None,
    sound_from_s: float = 0.0,
    options: EncodeOptions | None = None,
) -> Iterator[VideoWriter]:
    """A video at `path` (.mp4, .mov, .mkv), whole or not at all.

    colour: ClipFacts.colour of the source. sound_of: file whose first sound stream is copied, from sound_from_s on.
    Raises OutputError: another suffix, no such folder, disk full.
    """
    options = options or EncodeOptions()
    encoder, pix_fmt, _, suffixes = CODECS[options.codec]
    if path.suffix.lower() not in SUFFIXES:
        raise OutputError(path, "the name does not say which container", f"end it in {', '.join(SUFFIXES)}")
    if path.suffix.lower() not in suffixes:
        raise OutputError(path, f"{options.codec} does not go into it", f"end it in {' or '.join(suffixes)}")
    matrix = (
        Colorspace[str(colour.get("rgb_matrix", "none"))] if colour.get("rgb_matrix") in MATRIX_TAG else None
    )
    matrix = matrix or (Colorspace.ITU709 if size_px[1] >= 720 else Colorspace.ITU601)
    tags = {
        "colorspace": MATRIX_TAG.get(matrix.name, 1),
        "color_range": LIMITED_RANGE,
        "color_primaries": int(colour.get("primaries", UNSPECIFIED)),
        "color_trc": int(colour.get("transfer", UNSPECIFIED)),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary, av.open(str(temporary), "w") as container:
            stream: Any = container.add_stream(encoder, rate=clock.rate, options=_encoder_options(options))
            stream.width, stream.height = size_px[0] - size_px[0] % 2, size_px[1] - size_px[1] % 2
            stream.pix_fmt, stream.time_base = pix_fmt, clock.time_base
            stream.codec_context.time_base = clock.time_base
            if options.codec == "hevc10" and path.suffix.lower() != ".mkv":
                stream.codec_context.codec_tag = "hvc1"  # what Apple's players ask for
            for name, value in tags.items():
                setattr(stream.codec_context, name, value)
            if abs(pixel_aspect - 1) > 1e-6:
                ratio = Fraction(pixel_aspect).limit_denominator(1000)
                stream.codec_context.sample_aspect_ratio = ratio
            with _sound_source(sound_of, sound_from_s, container) as (sound, words):
                writer = VideoWriter(
                    clock=clock, matrix=matrix, tags=tags, size_px=size_px, pix_fmt=pix_fmt, _container=container,
                    _stream=stream, _sound=sound, sound=words,
                )  # fmt: skip
                yield writer
                container.mux(stream.encode(None))
                if sound is not None and writer.n_written:
                    last = clock.ticks[writer.n_written - 1] * clock.time_base
                    sound.copy_until(float(last + 1 / clock.rate), container)
    except OSError as error:
        raise OutputError(
            path, f"cannot be written ({error.strerror or error})", "choose another place with -o"
        ) from None


def _encoder_options(options: EncodeOptions) -> dict[str, str]:
    if options.codec == "prores":
        return {"profile": "3", "vendor": "apl0"}
    words = {"crf": f"{options.crf:g}", "preset": options.preset}
    return words if options.codec == "h264" else {**words, "x265-params": "log-level=error"}


def shown_colour(colour: Mapping[str, Any]) -> dict[str, Any]:
    """ClipFacts.colour of pictures that were mapped to BT.709 if they were HDR or of a wide gamut (hdr.py)."""
    if int(colour.get("transfer", 0)) in TRANSFERS or int(colour.get("primaries", 0)) in WIDE_PRIMARIES:
        return {**colour, "rgb_matrix": "ITU709", "primaries": 1, "transfer": 1}
    return dict(colour)


def video_frame(rgb: NDArray[Any], matrix: Colorspace, pix_fmt: str) -> av.VideoFrame:
    """RGB (h, w, 3), sides even, uint8 or uint16 of 0..65535, as limited-range YCbCr of a format in CODECS.

    Chroma is sited left (H.264, HEVC, ProRes). Not FFmpeg's converter: that cuts instead of rounding, and the picture
    comes back darker by a grey level or more. Raises ValueError: another kind of number.
    """
    if rgb.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"pictures are uint8 or uint16, not {rgb.dtype}")
    bits = 10 if pix_fmt.endswith("10le") else 8
    red, blue = LUMA_WEIGHTS[matrix.name]
    y = np.array([red, 1 - red - blue, blue])
    cb, cr = (np.array([0, 0, 1.0]) - y) / (2 * (1 - blue)), (np.array([1.0, 0, 0]) - y) / (2 * (1 - red))
    gain, top = 2.0 ** (bits - 8), 255 if rgb.dtype == np.uint8 else 65535
    M = np.column_stack(
        [np.stack([219 * y, 224 * cb, 224 * cr]) * gain / top, np.array([16, 128, 128]) * gain]
    )
    # 8 bits stay 8 bits (cv2 rounds); deeper ones are mixed as floats and rounded at the end.
    plain = bits == 8 and rgb.dtype == np.uint8
    yuv = cv2.transform(rgb if plain else rgb.astype(np.float32), M)
    half_height = pix_fmt.startswith("yuv420p")
    down = BETWEEN if half_height else np.array([0.0, 1.0, 0.0])
    # A chroma sample lies on every second column; in 4:2:0 half-way between two rows.
    chroma = cv2.sepFilter2D(yuv[..., 1:], -1, AT_LEFT, down, borderType=cv2.BORDER_REPLICATE)
    chroma = chroma[:: 2 if half_height else 1, ::2]
    kind: Any = np.uint8 if bits == 8 else np.dtype("<u2")
    frame = av.VideoFrame(rgb.shape[1], rgb.shape[0], pix_fmt)
    for plane, values in zip(frame.planes, (yuv[..., 0], chroma[..., 0], chroma[..., 1]), strict=True):
        codes = values if plain else np.clip(values + 0.5, 0, (1 << bits) - 1)
        padded = np.zeros((plane.height, plane.line_size // np.dtype(kind).itemsize), kind)
        padded[:, : plane.width] = codes.astype(kind)
        plane.update(padded.tobytes())
    return frame


# ---- sound


@dataclass(slots=True, kw_only=True, eq=False)
class _Sound:
    """Packets of one sound stream, handed on in step with the pictures."""

    packets: Iterator[Any]
    stream: Any
    start_s: float
    waiting: Any = None

    def copy_until(self, time_s: float, container: Any) -> None:
        """Every packet up to a time of the new video."""
        while True:
            packet = self.waiting or self._next()
            self.waiting = None
            if packet is None:
                return
            at = float(packet.pts * packet.time_base) - self.start_s
            if at > time_s:
                self.waiting = packet
                return
            shift = round(self.start_s / packet.time_base)
            if packet.pts < shift:
                continue  # before the first picture
            packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
            packet.stream = self.stream
            container.mux(packet)

    def _next(self) -> Any:
        for packet in self.packets:
            if packet.pts is not None and packet.dts is not None:
                return packet
        return None


@contextmanager
def _sound_source(path: Path | None, start_s: float, container: Any) -> Iterator[tuple[_Sound | None, str]]:
    """The first sound stream of a file, copied into `container`; None with the reason where that cannot be."""
    if path is None or not path.is_file():
        yield None, "none"
        return
    try:
        source = av.open(f"file:{path}", metadata_errors="replace")
    except (av.error.FFmpegError, OSError):
        yield None, "none"
        return
    with source:
        streams = [s for s in source.streams.audio if s.codec_context is not None]
        if not streams:
            yield None, "none"
            return
        name = streams[0].codec_context.name
        if name not in container.supported_codecs:
            yield None, f"left out: {name} does not fit into {container.format.name}"
            return
        stream = container.add_stream_from_template(streams[0])
        yield _Sound(packets=source.demux(streams[0]), stream=stream, start_s=start_s), f"{name}, copied"
