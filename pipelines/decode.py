"""A file or a folder of images to pictures with their times: `open_clip`, `Clip`, `Frame`, `ClipFacts`.

Gray is the Y plane as it lies in the decoder's memory: no colour conversion (which costs three times the copy),
limited range left as it is. The header's count of frames is never believed, and a damaged packet does not end
a clip. Overlays, duplicates and shots are found elsewhere.
"""

from __future__ import annotations

import hashlib
import queue
import threading
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import Colorspace
from numpy.typing import NDArray

from pipelines.config import DecodeOptions
from pipelines.errors import InputError
from pipelines.hdr import TRANSFERS, WIDE_PRIMARIES, needs_mapping
from pipelines.picture import Picture
from pipelines.pixels import deep_rgb_picture, gray_plane, quarter_turns, rgb_picture, yuv_matrix
from pipelines.scan import LOOK, STEP, judge_opening, judge_scan, shows_fields
from pipelines.sources import Source, open_source
from pipelines.stdin import shown_path
from pipelines.stills import IMAGE_SUFFIXES, list_images
from pipelines.timing import PtsRepair, Timecode

TELECINE = "telecine_"  # of scan.judge_scan: film in 60i
LATER = (0.2, 0.4, 0.6, 0.8)  # of a clip whose first ten seconds show no fields: where they are looked for
UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One picture.

    index: output picture from 0. source_frame: decoded frame it comes from; field: 0 or 1 in order of time where that
    frame was interlaced, else None. pts_s: s, strictly increasing. timecode: 'hh:mm:ss:ff' or ''.
    gray: (h, w) uint8 as decoded, or float32 0..255 from sources of more than 8 bits; owned, read-only.
    mask: (h, w) bool, True = usable; None = all of it. pixel_aspect: width over height of a pixel.
    picture: () -> (h, w, 3) uint8 RGB of this frame; it keeps the decoder's picture alive (3 MB at 1080p) while held.
    deep_picture: (mapped) -> the same as uint16 of 0..65535, with all bits; HDR mapped to BT.709 or as it is.
    """

    index: int
    pts_s: float
    timecode: str
    source_frame: int
    field: int | None
    gray: NDArray[Any]
    mask: NDArray[np.bool_] | None
    pixel_aspect: float
    picture: Callable[[], NDArray[np.uint8]]
    deep_picture: Callable[[bool], NDArray[np.uint16]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClipFacts:
    """What the container and the first picture say. `warnings` grows while the clip is decoded; the rest is fixed.

    size_px: (w, h) of the pictures handed out, after rotation. fps: decoded frames/s by the header, NaN unknown;
    picture_fps: pictures handed out per s (twice fps where fields are). n_frames_header: as the header claims, or None.
    colour: space, range, primaries, transfer as FFmpeg's numbers and the matrix used for RGB. rotation_deg: applied,
    counter-clockwise. scan_seen: 'tff', 'bff', 'progressive', 'telecine_tff', 'telecine_bff', 'unknown' by the first
    pictures' content; scan_flagged: 'interlaced' or 'progressive' by its first picture's flag; field_order: that of the
    content if interlaced, '' = as flagged. deinterlace: 'none', 'bwdif send_field', 'bwdif send_frame' or 'fieldmatch'
    (pull-down undone). timecode: of picture 0, or ''.
    """

    path: Path
    size_px: tuple[int, int]
    fps: float
    picture_fps: float
    n_frames_header: int | None
    duration_s: float
    container: str
    codec: str
    pix_fmt: str
    bit_depth: int
    colour: dict[str, Any]
    interlaced: bool
    field_order: str
    scan_seen: str
    scan_flagged: str
    deinterlace: str
    pixel_aspect: float
    rotation_deg: int
    timecode: str
    size_bytes: int
    mtime_ns: int
    warnings: list[str] = field(default_factory=list)

    def sha256(self) -> str:
        """Of the whole file; of all images, names and contents, for a folder. Reads everything: not for each run."""
        digest = hashlib.sha256()
        for path in _files_of(self.path):
            if path != self.path:
                digest.update(path.name.encode())
            with path.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
        return digest.hexdigest()

    def identity(self) -> str:
        """A quick digest that changes when the clip does: size, and first and last MB; not its time stamp or name."""
        digest = hashlib.sha256()
        for path in _files_of(self.path):
            size = path.stat().st_size
            digest.update(f"{path.name if path != self.path else ''}:{size};".encode())
            with path.open("rb") as stream:
                digest.update(stream.read(1 << 20))
                stream.seek(max(0, size - (1 << 20)))
                digest.update(stream.read(1 << 20))
        return digest.hexdigest()

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready, for run.json and probe; NaN becomes None."""
        values: dict[str, Any] = {}
        for name in self.__slots__:
            value = getattr(self, name)
            if isinstance(value, Path):
                value = shown_path(value)
            elif isinstance(value, float) and not np.isfinite(value):
                value = None
            elif isinstance(value, tuple | list):
                value = list(value)
            values[name] = value
        return values


class Clip:
    """An opened clip. Iterating decodes it from the start, ahead in a thread of its own; any number of times.

    `with open_clip(path) as clip: for frame in clip: ...`. `counts` (after an iteration): frames decoded, packets
    that failed, time stamps repaired, gaps. Raises InputError at the end of an iteration that found under two pictures.
    """

    def __init__(self, facts: ClipFacts, options: DecodeOptions) -> None:
        self.facts = facts
        self.options = options
        self.counts: dict[str, int] = {}
        self._readers: weakref.WeakSet[_Reader] = weakref.WeakSet()
        self._told = set(facts.warnings)

    def __enter__(self) -> Clip:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop every decoder thread of this clip and let go of the file."""
        for reader in list(self._readers):
            reader.stop()

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def frames(
        self, first: int = 0, count: int | None = None, only: Collection[int] | None = None
    ) -> Iterator[Frame]:
        """Pictures first, first + 1 ... (`count` of them), or of those only the ones in `only`.

        Always decodes from the start: seeking is inexact in transport streams. What is skipped costs no copy.
        """
        last = None if count is None else first + count - 1
        if only is not None:
            only = frozenset(only)
            last = max(only, default=-1) if last is None else min(last, max(only, default=-1))
        reader = _Reader(self.facts, self.options, first, last, only)
        self._readers.add(reader)
        try:
            yield from reader
        finally:
            reader.stop()
            self.counts = dict(reader.counts)
            for warning in reader.warnings:
                if warning not in self._told:
                    self._told.add(warning)
                    self.facts.warnings.append(warning)


def open_clip(path: str | Path, options: DecodeOptions | None = None) -> Clip:
    """Open a video file, a folder of images or a pattern like frames/%06d.png, and read its first picture.

    Raises InputError: no such file, not a video, truncated, audio only, no images, nothing decodable, too large.
    """
    options = options or DecodeOptions()
    path = Path(path)
    with open_source(path, options) as source:
        pictures = source.pictures()
        first = next(pictures, None)
        if first is None:
            raise InputError(
                path, "no picture could be decoded", "it is damaged, or its codec is not in this FFmpeg"
            )
        seen = _scan_of(source, first, pictures) if options.deinterlace != "off" else "unknown"
        return Clip(_facts(source, first, options, seen), options)


def _scan_of(source: Source, first: Picture, pictures: Iterator[Picture]) -> str:
    """What scan.py says of the clip's first second; of later ones where that shows no fields but there may be some.

    Interlaced formats have 25 or 30 frames a second. Most progressive clips say so and show it within the first."""
    videos = (picture.video for picture in (first, *islice(pictures, LOOK - 1)))
    seen = judge_scan(_lumas(videos))
    plain = seen == "progressive" and source.says_progressive and not first.video.interlaced_frame
    if shows_fields(seen) or plain or not 23 < source.fps < 31:
        return seen
    later = judge_opening(_lumas(picture.video for picture in pictures))
    for share in LATER:
        if shows_fields(later):
            return later
        later = judge_scan(_lumas(source.pictures_from(share)))
    return later if shows_fields(later) else seen


def _lumas(videos: Iterable[av.VideoFrame]) -> Iterator[NDArray[np.float32]]:
    return (gray_plane(video, 0)[:, ::STEP].astype(np.float32) for video in videos)


def _facts(source: Source, first: Picture, options: DecodeOptions, seen: str) -> ClipFacts:
    video = first.video
    turns = quarter_turns(video)
    warnings = list(source.warnings)
    width, height = (video.width, video.height) if turns % 2 == 0 else (video.height, video.width)
    # The picture's own flag decides: stream headers call plenty of progressive material interlaced.
    flagged = bool(video.interlaced_frame)
    pulled = seen.startswith(TELECINE)
    order = seen.removeprefix(TELECINE)
    field_order = order if pulled else _judge_order(flagged, source.field_order, seen, warnings)
    interlaced = flagged or bool(field_order)
    if source.says_interlaced and not interlaced:
        warnings.append(
            "the stream calls itself interlaced, its first picture is not: each is judged by itself"
        )
    mode = "none" if not interlaced or options.deinterlace == "off" else f"bwdif send_{options.deinterlace}"
    if pulled and mode != "none":
        mode = "fieldmatch"
        warnings.append(
            f"film in interlaced frames (3:2 pull-down, {order}): its pictures are put together again"
        )
    elif interlaced:
        how = {"off": "left combed", "field": "one picture a field", "frame": "one picture a frame"}
        warnings.append(f"interlaced: {how[options.deinterlace]} (deinterlacing: {mode})")
    aspect = options.pixel_aspect or source.pixel_aspect or 1.0
    if turns:
        warnings.append(f"rotated by {90 * turns} degrees counter-clockwise, as the file asks")
        aspect = aspect if turns % 2 == 0 or options.pixel_aspect else 1.0 / aspect
    if needs_mapping(video):
        known = (
            TRANSFERS.get(int(getattr(video, "color_trc", UNSPECIFIED)), ""),
            WIDE_PRIMARIES.get(int(getattr(video, "color_primaries", UNSPECIFIED)), ""),
        )
        warnings.append(
            f"{', '.join(filter(None, known))}: pictures are mapped to BT.709, highlights drawn in; grey stays as coded"
        )
    stat = source.path.stat() if source.path.exists() else None
    timecode = source.timecode or _gop_timecode(video, source.fps)
    if timecode is not None and timecode.count == 0 and not options.accept_zero_timecode:
        timecode = None
    return ClipFacts(
        path=source.path,
        size_px=(width, height),
        fps=source.fps,
        picture_fps=source.fps
        * (2.0 if mode.endswith("send_field") else 0.8 if mode == "fieldmatch" else 1.0),
        n_frames_header=source.n_frames_header,
        duration_s=source.duration_s,
        container=source.container_name,
        codec=source.codec_name,
        pix_fmt=video.format.name,
        bit_depth=video.format.components[0].bits,
        colour={
            "space": int(video.colorspace),
            "range": int(video.color_range),
            "primaries": int(getattr(video, "color_primaries", UNSPECIFIED)),
            "transfer": int(getattr(video, "color_trc", UNSPECIFIED)),
            "transfer_name": TRANSFERS.get(int(getattr(video, "color_trc", UNSPECIFIED)), ""),
            "rgb_matrix": "none" if video.format.is_rgb else Colorspace(yuv_matrix(video)).name,
        },
        interlaced=interlaced,
        field_order=field_order,
        scan_seen=seen,
        scan_flagged="interlaced" if flagged else "progressive",
        deinterlace=mode,
        pixel_aspect=float(aspect),
        rotation_deg=90 * turns,
        timecode=str(timecode) if timecode is not None else "",
        size_bytes=sum(p.stat().st_size for p in source.files),
        mtime_ns=stat.st_mtime_ns if stat is not None else 0,
        warnings=warnings,
    )


def _counted(pictures: Iterator[Picture], read: list[int]) -> Iterator[Picture]:
    """The same pictures; read[0] is how many have been asked for."""
    for picture in pictures:
        read[0] += 1
        yield picture


def _judge_order(flagged: bool, stated: str, seen: str, warnings: list[str]) -> str:
    """The field order for deinterlacing: what the pictures show; '' = as flagged. Says where the two differ."""
    if seen in ("tff", "bff"):
        first = {"tff": "top", "bff": "bottom"}[seen]
        if not flagged:
            warnings.append(
                f"flagged progressive, but its pictures are interlaced, {first} field first: so taken"
            )
        elif stated and stated != seen:
            warnings.append(f"flagged {stated}, but its pictures have the {first} field first: so taken")
        return seen
    if seen == "progressive" and flagged:
        # Not left alone for this: what follows a progressive title may be interlaced.
        warnings.append(
            "flagged interlaced, but its first pictures are progressive: each comes twice unless decode.deinterlace off"
        )
    return ""


def _gop_timecode(video: av.VideoFrame, fps: float) -> Timecode | None:
    """MPEG-2's time code of the group of pictures, where the first frame carries one."""
    try:
        data: Any = video.side_data.get("GOP_TIMECODE")
    except ValueError:  # beside it lies something that PyAV has no name for: EXIF of a photograph
        return None
    return Timecode.from_mpeg(int.from_bytes(bytes(data)[:8], "little"), fps) if data is not None else None


def _files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else list_images(path)


# ---- the thread that decodes ahead

_END = object()


class _Reader:
    """Iterates over the frames that a daemon thread puts into a bounded queue; stops it when dropped or at exit."""

    def __init__(
        self,
        facts: ClipFacts,
        options: DecodeOptions,
        first: int,
        last: int | None,
        only: frozenset[int] | Collection[int] | None,
    ) -> None:
        names = ("decoded", "pictures", "fields", "failed_packets", "repaired_pts", "gaps")
        self.counts: dict[str, int] = dict.fromkeys(names, 0)
        self.warnings: list[str] = []
        self._queue: queue.Queue[Any] = queue.Queue(maxsize=options.queue_frames)
        self._stop = threading.Event()
        what = (facts, options, first, last, only, self.counts, self.warnings)
        work = partial(_decode_into, self._queue, self._stop, *what)
        self._thread = threading.Thread(target=work, name="decode", daemon=True)
        # The thread must not outlive the interpreter inside FFmpeg: finalize also runs at exit, before modules go.
        self._finalizer = weakref.finalize(self, _shut_down, self._stop, self._queue, self._thread)
        self._thread.start()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            item = self._queue.get()
            if item is _END:
                return
            if isinstance(item, BaseException):
                raise item
            yield item

    def stop(self) -> None:
        """End the thread; harmless when it has ended."""
        self._finalizer()


def _shut_down(stop: threading.Event, frames: queue.Queue[Any], thread: threading.Thread) -> None:
    stop.set()
    while thread.is_alive():
        try:
            while True:
                frames.get_nowait()
        except queue.Empty:
            thread.join(timeout=0.05)
    # A consumer that still waits in another thread must not wait for ever.
    frames.put(_END)


def _decode_into(
    frames: queue.Queue[Any],
    stop: threading.Event,
    facts: ClipFacts,
    options: DecodeOptions,
    first: int,
    last: int | None,
    only: Collection[int] | None,
    counts: dict[str, int],
    warnings: list[str],
) -> None:
    """Body of the thread: everything, errors too, goes through the queue. Returns soon after `stop` is set."""

    def put(item: object) -> None:
        while not stop.is_set():
            try:
                frames.put(item, timeout=0.1)
                return
            except queue.Full:
                continue

    try:
        for frame in _frames(facts, options, first, last, only, counts, warnings):
            if stop.is_set():
                return
            put(frame)
        put(_END)
    except BaseException as error:  # handed to the consumer, who raises it
        put(error)


def _frames(
    facts: ClipFacts,
    options: DecodeOptions,
    first: int,
    last: int | None,
    only: Collection[int] | None,
    counts: dict[str, int],
    warnings: list[str],
) -> Iterator[Frame]:
    turns = facts.rotation_deg // 90
    timecode = Timecode.parse(facts.timecode, facts.fps) if facts.timecode else None
    start_s: float | None = None
    complete = True
    with open_source(facts.path, options) as source:
        repair = PtsRepair(facts.fps)
        everything = facts.interlaced and facts.scan_flagged == "progressive"  # by the content alone
        mode = "telecine" if facts.deinterlace == "fieldmatch" else options.deinterlace
        read = [0]
        pictures = source.fields(
            _counted(repair.apply(source.pictures()), read), mode, facts.field_order, everything
        )
        for index, picture in enumerate(pictures):
            if last is not None and index > last:
                complete = False
                break
            start_s = picture.pts_s if start_s is None else start_s
            counts["pictures"] = index + 1
            counts["decoded"] = picture.source_frame + 1
            counts["fields"] += picture.field is not None
            if index < first or (only is not None and index not in only):
                continue
            yield Frame(
                index=index,
                pts_s=picture.pts_s,
                timecode=str(timecode.after(picture.frame_start_s - start_s)) if timecode is not None else "",
                source_frame=picture.source_frame,
                field=picture.field,
                gray=gray_plane(picture.video, turns),
                mask=None,
                pixel_aspect=facts.pixel_aspect,
                picture=partial(rgb_picture, picture.video, turns),
                deep_picture=partial(deep_rgb_picture, picture.video, turns),
            )
        if complete:
            counts["decoded"] = read[0]  # the last of them may be one that repeats, and is not handed out
        counts["failed_packets"] = source.n_failed
        counts["repaired_pts"] = repair.n_repaired
        counts["gaps"] = repair.n_gaps
        if complete and counts["decoded"] < 2:
            cure = "a clip needs at least two frames"
            if facts.path.suffix.lower() in IMAGE_SUFFIXES:
                cure = "give the folder of the images, or a pattern in quotes: 'frames/*.png'"
            raise InputError(facts.path, "only one picture could be decoded", cure)
        if complete and counts["pictures"] <= first:
            raise InputError(
                facts.path, f"has only {counts['pictures']} pictures", f"start before picture {first}"
            )
        if complete and 0 < counts["fields"] < counts["pictures"] and not everything:
            warnings.append(
                f"{counts['fields'] // 2} of {counts['decoded']} frames are interlaced, the others are not"
            )
        if complete:
            warnings.extend(source.late_warnings(counts["decoded"]) + repair.warnings())
