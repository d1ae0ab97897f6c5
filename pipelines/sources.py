"""Where pictures come from: a container that FFmpeg reads, or a list of image files. Opening, and refusing."""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import av
import av.error
import numpy as np

from pipelines.config import DecodeOptions
from pipelines.deinterlace import deinterlace
from pipelines.errors import InputError
from pipelines.picture import Picture
from pipelines.stills import IMAGE_SUFFIXES, is_pattern, is_there, list_images
from pipelines.telecine import undo_telecine
from pipelines.timing import Timecode

# Formats that are lists of other files or addresses: a hostile "clip" could read what the user did not name.
INDIRECT_FORMATS = frozenset(
    {"hls", "concat", "dash", "sdp", "rtsp", "rtp", "imf", "lavfi", "webm_dash_manifest"}
)

# FFmpeg plays a text file as a picture of a terminal.
TS_PACKET, TS_SYNC = 188, 0x47  # bytes, first byte of a transport packet
CUT_SHORT_S = (
    0.3  # of the duration that the header promises, where there is sound: it often runs on for a frame or two
)
TEXT_FORMATS = frozenset({"tty", "bin", "xbin", "adf", "idf"})
STILL_CODECS = frozenset({"mjpeg", "png", "bmp", "gif", "webp", "tiff", "jpeg2000"})


class Source(Protocol):
    """An opened clip as decoding needs it; facts as the header states them (NaN, None: it does not)."""

    path: Path
    files: list[Path]
    fps: float
    n_frames_header: int | None
    duration_s: float
    container_name: str
    codec_name: str
    pixel_aspect: float | None
    timecode: Timecode | None
    says_interlaced: bool
    says_progressive: bool
    field_order: str
    warnings: list[str]
    n_failed: int

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def pictures(self) -> Iterator[Picture]: ...
    def pictures_from(self, share: float) -> Iterator[av.VideoFrame]: ...
    def fields(
        self, pictures: Iterable[Picture], mode: str, order: str, everything: bool
    ) -> Iterator[Picture]: ...
    def late_warnings(self, n_decoded: int) -> list[str]: ...


def open_source(path: Path, options: DecodeOptions) -> Source:
    """A container or images, by what the path is. Raises InputError with file, cause and cure."""
    there = is_there(path)
    if (there and path.is_dir()) or is_pattern(path):
        files = list_images(path)
        if not files:
            cause = "no images in it" if path.is_dir() else "no file matches the pattern"
            raise InputError(
                path, cause, f"it must hold numbered images ({', '.join(IMAGE_SUFFIXES[:3])} ...)"
            )
        return ImageSource(path, files, options)
    return ContainerSource(path, options)


class ContainerSource:
    """A file that FFmpeg demultiplexes; its first real video stream."""

    def __init__(self, path: Path, options: DecodeOptions) -> None:
        self.path = path
        self.files = [path]
        self.n_failed = 0
        self.warnings: list[str] = []
        self._n_other_size = 0
        self._n_concealed = self._n_corrupt = 0
        # Packets that an edit list leaves out: decoded for those after them, never shown.
        self._n_discarded = 0
        self._first_s = self._last_s = math.nan
        self._container = _open(path)
        try:
            stream = _video_stream(self._container, path)
            _refuse_size(path, stream.width, stream.height, options)
        except BaseException:
            self._container.close()
            raise
        cores = os.cpu_count() or 1
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = options.threads or (1 if cores <= 2 else min(4, cores))
        self._stream = stream
        self.fps = _rate(stream)
        self.n_frames_header = int(stream.frames) or None
        self.duration_s = _duration(self._container, stream)
        self.container_name = self._container.format.name
        self.codec_name = stream.codec_context.codec.canonical_name
        ratio = stream.sample_aspect_ratio
        self.pixel_aspect = float(ratio) if ratio else None
        self.timecode = self._find_timecode()
        # FFmpeg's AVFieldOrder: 2 .. 5 are the interlaced ones; of 4 and 5 the second letter is the order of display.
        stated = int(getattr(stream.codec_context, "field_order", 0) or 0)
        self.says_interlaced, self.says_progressive = stated >= 2, stated == 1
        self.field_order = {2: "tff", 3: "bff", 4: "bff", 5: "tff"}.get(stated, "")
        n_streams = sum(s.codec_context is not None for s in _video_streams(self._container))
        if n_streams > 1:
            which = f"stream {stream.index} ({stream.width}x{stream.height})"
            self.warnings.append(f"{n_streams} video streams; only {which} is used")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._container.close()

    def pictures(self) -> Iterator[Picture]:
        """Every picture that decodes, in order of presentation. A packet that fails is counted and left out."""
        number = 0
        size: tuple[int, int] | None = None
        frame: Any
        for frame in self._decoded():
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                self._n_other_size += 1
                continue
            unknown = frame.pts is None or not frame.time_base
            pts_s = math.nan if unknown else float(frame.pts * frame.time_base)
            self._first_s, self._last_s = np.fmin(self._first_s, pts_s), np.fmax(self._last_s, pts_s)
            self._n_concealed += bool(frame.is_corrupt)
            yield Picture(video=frame, source_frame=number, pts_s=pts_s, frame_start_s=pts_s)
            number += 1

    def pictures_from(self, share: float) -> Iterator[av.VideoFrame]:
        """Pictures from about this share of the clip on, for a look; nothing is counted. None where nobody can seek."""
        if not math.isfinite(self.duration_s):
            return
        start = self._container.start_time or 0
        try:
            self._container.seek(start + round(share * self.duration_s * av.time_base))
            for packet in self._container.demux(self._stream):
                yield from packet.decode()
        except (av.error.FFmpegError, OSError):
            return

    def _decoded(self) -> Iterator[av.VideoFrame]:
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets, None)
            except (av.error.FFmpegError, OSError) as error:
                self.n_failed += 1
                self.warnings.append(f"reading stopped early: {error}")
                return
            if packet is None:
                return
            self._n_corrupt += bool(packet.is_corrupt)
            self._n_discarded += bool(packet.is_discard)
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                self.n_failed += 1
                continue
            yield from frames

    def fields(
        self, pictures: Iterable[Picture], mode: str, order: str, everything: bool
    ) -> Iterator[Picture]:
        if mode == "telecine":
            return undo_telecine(pictures, order)
        return deinterlace(pictures, mode, order, everything)

    def late_warnings(self, n_decoded: int) -> list[str]:
        """What is known only after the last picture."""
        found = list(self.warnings)
        promised = None if self.n_frames_header is None else self.n_frames_header - self._n_discarded
        if promised is not None and promised != n_decoded:
            found.append(f"the header promises {promised} frames, {n_decoded} could be decoded")
        # By time stamps where there are any: at a variable rate counting tells nothing.
        seen_s = self._last_s - self._first_s + 1 / self.fps
        if not math.isfinite(seen_s):
            seen_s = (n_decoded + self.n_failed) / self.fps
        missing_s = self.duration_s - seen_s
        alone = len(self._container.streams) == 1
        allowed_s = 0.6 / self.fps if alone else max(CUT_SHORT_S, 0.02 * self.duration_s)
        stream = self._stream
        start_s = math.nan if stream.start_time is None else float(stream.start_time * stream.time_base)
        head_s = self._first_s - start_s
        if self.n_frames_header is None and head_s > 0.6 / self.fps:
            found.append(f"the first {head_s:.2f} s are damaged, or lack the picture that they build on")
            missing_s -= head_s
        if self.n_frames_header is None and missing_s > allowed_s:
            found.append(
                f"truncated: the header promises {self.duration_s:.2f} s, the last {missing_s:.2f} s are missing"
            )
        if self.container_name == "mpegts" and _ends_within_packet(self.path):
            found.append("truncated: it does not end with a whole transport packet; what came before is used")
        if self.n_failed:
            found.append(f"{self.n_failed} damaged packets were left out")
        if damaged := max(self._n_concealed, self._n_corrupt):
            found.append(f"{damaged} pictures are damaged: what was lost of them is the decoder's guess")
        if self._n_other_size:
            found.append(f"{self._n_other_size} frames of another size were left out")
        return found

    def _find_timecode(self) -> Timecode | None:
        for tags in (
            self._stream.metadata,
            self._container.metadata,
            *(s.metadata for s in self._container.streams),
        ):
            if "timecode" in tags:
                found = Timecode.parse(tags["timecode"], self.fps)
                if found is not None:
                    return found
        return None


def _ends_within_packet(path: Path) -> bool:
    """Whether a transport stream of 188-byte packets does not end with a whole one: recorders write whole packets."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(2 * TS_PACKET)
        stream.seek(max(0, size - TS_PACKET))
        last = stream.read(1)
    aligned = len(head) == 2 * TS_PACKET and head[0] == head[TS_PACKET] == TS_SYNC
    return aligned and (size % TS_PACKET != 0 or last != bytes([TS_SYNC]))


class ImageSource:
    """Image files, one picture each; the rate is the user's, the files have none."""

    n_frames_header: int | None
    duration_s: float
    pixel_aspect: float | None
    timecode: Timecode | None

    def __init__(self, path: Path, files: list[Path], options: DecodeOptions) -> None:
        self.path = path
        self.files = files
        self.fps = options.image_fps
        self.n_frames_header = len(files)
        self.duration_s = len(files) / options.image_fps
        self.container_name = "images"
        self.codec_name = files[0].suffix[1:].lower()
        self.pixel_aspect = None
        self.timecode = None
        self.says_interlaced, self.says_progressive = False, True
        self.field_order = ""
        self.n_failed = 0
        self.warnings = [f"images carry no time: {options.image_fps:g} pictures/s taken (decode.image_fps)"]
        self._options = options
        self._other_size: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def pictures(self) -> Iterator[Picture]:
        """One picture a file, in order; a file that does not decode is counted and leaves a gap in time."""
        size: tuple[int, int] | None = None
        number = 0
        for position, file in enumerate(self.files):
            try:
                with av.open(f"file:{file}", metadata_errors="replace") as container:
                    stream = _video_stream(container, file)
                    _refuse_size(file, stream.width, stream.height, self._options)
                    frame = next(container.decode(stream), None)
            except (av.error.FFmpegError, OSError):
                frame = None
            if frame is None:
                self.n_failed += 1
                continue
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                self._other_size.append(file.name)
                continue
            pts_s = position / self.fps
            yield Picture(video=frame, source_frame=number, pts_s=pts_s, frame_start_s=pts_s)
            number += 1

    def pictures_from(self, share: float) -> Iterator[av.VideoFrame]:
        """None: images have no fields to look for."""
        return iter(())

    def fields(
        self, pictures: Iterable[Picture], mode: str, order: str, everything: bool
    ) -> Iterator[Picture]:
        yield from pictures

    def late_warnings(self, n_decoded: int) -> list[str]:
        found = [f"{self.n_failed} images could not be read"] if self.n_failed else []
        if self._other_size:
            names = ", ".join(self._other_size[:3])
            found.append(f"{len(self._other_size)} images of another size were left out ({names})")
        return found


def _open(path: Path) -> Any:
    try:
        # 'file:' so that a name with a colon is not taken for a protocol, and nothing but files is opened.
        only_files = {"protocol_whitelist": "file"}
        container = av.open(f"file:{path}", metadata_errors="replace", container_options=only_files)
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except PermissionError:
        raise InputError(path, "may not be read", "change its permissions") from None
    except (av.error.FFmpegError, OSError, ValueError) as error:
        cause, cure = _why_unreadable(path, error)
        raise InputError(path, cause, cure) from None
    name = container.format.name
    if TEXT_FORMATS & set(name.split(",")):
        container.close()
        raise InputError(path, "is not a video but text", "give the video file itself")
    if INDIRECT_FORMATS & set(name.split(",")):
        container.close()
        raise InputError(path, f"is a list of other files ({name}), not a clip", "give the clip itself")
    return container


def _video_streams(container: Any) -> list[Any]:
    """Streams of moving pictures, the likeliest first: a codec of stills beside another is a cover or a thumbnail, and
    of several the largest is the programme."""
    streams = [
        s for s in container.streams.video if "attached_pic" not in str(getattr(s, "disposition", "")).lower()
    ]

    def rank(stream: Any) -> tuple[bool, bool, int]:
        context = stream.codec_context
        if context is None:
            return True, True, 0
        return False, context.codec.canonical_name in STILL_CODECS, -stream.width * stream.height

    return sorted(streams, key=rank)


def _video_stream(container: Any, path: Path) -> Any:
    streams = _video_streams(container)
    if streams and streams[0].codec_context is None:
        raise InputError(path, "its video codec is not in this FFmpeg", "convert it to H.264 first")
    if streams:
        return streams[0]
    kinds = sorted({s.type for s in container.streams if s.type}) or ["nothing"]
    raise InputError(
        path, f"has no video stream (only {', '.join(kinds)})", "give a file with moving pictures"
    )


def _refuse_size(path: Path, width: int, height: int, options: DecodeOptions) -> None:
    if max(width, height) > options.max_side_px:
        cause = f"declares {width}x{height} px, more than {options.max_side_px} a side"
        raise InputError(path, cause, "raise decode.max_side_px if that is true")


def _why_unreadable(path: Path, error: Exception) -> tuple[str, str]:
    """Cause and cure of a file that FFmpeg does not open."""
    size = path.stat().st_size
    if size == 0:
        return "the file is empty", "copy it again"
    with path.open("rb") as stream:
        boxes = _mp4_boxes(stream, size)
        stream.seek(0)
        head = stream.read(512)
    if boxes and "moov" not in boxes:
        return (
            "truncated: its index (the moov box) is missing",
            "copy it again, or repair it from a complete copy",
        )
    if boxes:
        return f"damaged beyond reading ({error})", "copy it again"
    if all(byte in b"\t\n\r\f" or 32 <= byte < 127 or byte >= 128 for byte in head):
        return "is not a video but text", "give the video file itself"
    return "is not a video that FFmpeg can read", "check that it plays elsewhere; it may be damaged"


def _mp4_boxes(stream: Any, size: int) -> list[str]:
    """Names of the top-level boxes of an mp4 or mov file; empty when it is none."""
    names: list[str] = []
    position = 0
    while position + 8 <= size and len(names) < 1000:
        stream.seek(position)
        length, kind = struct.unpack(">I4s", stream.read(8))
        if not kind.isalnum() or (
            not names and kind not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
        ):
            break
        names.append(kind.decode("ascii"))
        if length == 1:
            length = struct.unpack(">Q", stream.read(8).ljust(8, b"\0"))[0]
        if length < 8:
            break
        position += length
    return names


def _rate(stream: Any) -> float:
    """Frames/s by the header; NaN when it gives none that can be true."""
    for rate in (stream.average_rate, stream.guessed_rate, stream.base_rate):
        if rate and 0.1 <= float(rate) <= 1000:
            return float(rate)
    return math.nan


def _duration(container: Any, stream: Any) -> float:
    if stream.duration is not None and stream.time_base:
        return float(stream.duration * stream.time_base)
    # Matroska's own length is that of its longest stream; of each one writers say it in a tag, hh:mm:ss.
    match = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", str(stream.metadata.get("DURATION", "")))
    if match is not None:
        return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3])
    return container.duration / av.time_base if container.duration is not None else math.nan
