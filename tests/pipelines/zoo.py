"""Every kind of file that a broadcaster sends in, made small with PyAV's own encoders. Truth is in the pixels.

`CASES` names them, `make` writes one, `luma` is the picture that was put in: texture that moves right by SHIFT_PX a
picture, so that each picture says which it is and a lost, doubled or swapped one shows. `python -m tests.pipelines.zoo`
decodes all of them and prints the table of docs/footage.md.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import av.filter
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from pipelines.decode import Clip, open_clip

SIZE = (256, 144)
SHIFT_PX = 6
N = 12
BLACK, WHITE = 16, 235  # of limited range, 8 bits

# FFmpeg's numbers: matrix, primaries, transfer.
BT709, BT601, BT2020 = (1, 1, 1), (6, 6, 6), (9, 9, 14)
PQ, HLG = (9, 9, 16), (9, 9, 18)
LIMITED, FULL = 1, 2
NTSC = Fraction(30000, 1001)
# Pictures of film whose fields make five frames out of four: of the field that comes first, and of the second.
FIRST_FIELD, SECOND_FIELD = (0, 0, 1, 2, 3), (0, 1, 2, 2, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A file: encoder, pixel format, container, tags. noise: mean grey levels that its coding may change.

    scan: what the pictures are: progressive, tff, bff, telecine_tff, telecine_bff (film in 60i), soft (film that asks
    to be shown so, by MPEG-2's repeat flags); flags: what the file says. colour: matrix, primaries, transfer.
    """

    name: str
    codec: str
    pix_fmt: str
    suffix: str
    options: dict[str, str] = field(default_factory=dict)
    size: tuple[int, int] = SIZE
    fps: Fraction = Fraction(25)
    colour: tuple[int, int, int] | None = None
    color_range: int | None = None
    noise: float = 2.0
    scan: str = "progressive"
    flags: str = "progressive"

    @property
    def n_coded(self) -> int:
        """Frames in the file: N, or with pull-down five for every four."""
        return N * 5 // 4 if self.scan.startswith("telecine") else N

    @property
    def bits(self) -> int:
        """Of one luma sample."""
        return int(av.VideoFormat(self.pix_fmt, 16, 16).components[0].bits)

    def missing(self) -> str:
        """Why this FFmpeg cannot make the case, or ''."""
        try:
            av.Codec(self.codec, "w")
        except av.codec.codec.UnknownCodecError:
            return f"no encoder {self.codec}"
        return ""


X264, X265 = (
    {"qp": "12", "preset": "ultrafast"},
    {"x265-params": "log-level=none:qp=10", "preset": "ultrafast"},
)


def _family(codec: str, options: dict[str, str], *rows: str, **values: Any) -> list[Case]:
    """Cases of one encoder: a row is 'pixel format, container[, name=value, ...]' with further encoder options."""
    found = []
    for row in rows:
        pix_fmt, suffix, *more = row.replace(" ", "").split(",")
        extra = dict(item.split("=", 1) for item in more)
        words = [codec, *(v for v in extra.values()), pix_fmt, suffix]
        case = Case(
            codec=codec, pix_fmt=pix_fmt, suffix=suffix, options={**options, **extra}, name=" ".join(words)
        )
        found.append(replace(case, **values))
    return found


def _colour(name: str, tags: tuple[int, int, int], pix_fmt: str) -> list[Case]:
    options = {**X264, "x264-params": "log-level=none"}
    return [
        Case(
            name=f"{name} {word} range", codec="libx264", pix_fmt=pix_fmt, suffix="mp4", options=options,
            colour=tags, color_range=color_range,
        )
        for word, color_range in (("limited", LIMITED), ("full", FULL))
    ]  # fmt: skip


def _scan(codec: str, pix_fmt: str, suffix: str, options: dict[str, str]) -> list[Case]:
    return [
        Case(name=f"{codec} {word} {suffix}", codec=codec, pix_fmt=pix_fmt, suffix=suffix, options=options,
             scan=scan, flags=flags)
        for word, scan, flags in (
            ("top field first", "tff", "tff"),
            ("bottom field first", "bff", "bff"),
            ("top first, flagged bottom first", "tff", "bff"),
        )
    ]  # fmt: skip


CASES = (
    *_family("libx264", X264, "yuv420p,mp4", "yuv420p,mov", "yuv420p,mkv", "yuv420p,ts", "yuv420p,mxf", "yuv422p,mp4",
             "yuv444p,mp4", "yuv420p10le,mp4", "yuv422p10le,mxf", "yuv444p10le,mkv"),
    *_family("libx265", X265, "yuv420p,mp4", "yuv420p10le,ts", "yuv422p10le,mov", "yuv420p12le,mkv", "yuv422p12le,mkv",
             "yuv444p12le,mp4"),
    *_family("mpeg2video", {"b": "8M"}, "yuv420p,ts", "yuv420p,mpg", "yuv422p,mxf", "yuv422p,mov"),
    *_family("prores_ks", {}, "yuv422p10le,mov,profile=proxy", "yuv422p10le,mxf,profile=hq",
             "yuv444p10le,mov,profile=4444", "yuva444p10le,mkv,profile=4444"),
    *_family("dnxhd", {}, "yuv422p,mov,profile=dnxhr_lb", "yuv422p,mxf,profile=dnxhr_sq",
             "yuv422p10le,mxf,profile=dnxhr_hqx", "yuv444p10le,mov,profile=dnxhr_444"),
    *_family("dnxhd", {}, "yuv422p,mxf,b=60M", size=(1280, 720)),
    *_family("libsvtav1", {"preset": "11", "crf": "15", "svtav1-params": "lp=1"}, "yuv420p,mp4", "yuv420p10le,mkv"),
    *_family("v210", {}, "yuv422p10le,mov"),
    *_family("ffv1", {}, "yuv420p16le,mkv", "gray,mkv"),
    *_family("mjpeg", {"qmin": "2", "qmax": "2"}, "yuvj422p,mov"),
    *_family("rawvideo", {}, "nv12,mkv", "uyvy422,mov"),
    *_colour("bt601", BT601, "yuv420p"),
    *_colour("bt709", BT709, "yuv420p"),
    *_colour("bt2020", BT2020, "yuv420p10le"),
    *_colour("hlg", HLG, "yuv420p10le"),
    *_colour("pq", PQ, "yuv420p10le"),
    *_scan("libx264", "yuv420p", "ts", X264),
    *_scan("mpeg2video", "yuv422p", "mxf", {"b": "8M", "flags": "+ildct+ilme"}),
    *_scan("prores_ks", "yuv422p10le", "mov", {"flags": "+ildct"}),
    Case(name="interlaced, flagged progressive", codec="libx264", pix_fmt="yuv420p", suffix="mp4", options=X264,
         scan="tff", flags="progressive"),
    Case(name="progressive, flagged interlaced", codec="libx264", pix_fmt="yuv420p", suffix="mp4", options=X264,
         flags="tff"),
    *(Case(name=f"film in 60i, {word} ({codec})", codec=codec, pix_fmt=pix_fmt, suffix=suffix, options=options,
           fps=NTSC, scan=f"telecine_{flags}", flags=flags)
      for codec, pix_fmt, suffix, options in (
          ("libx264", "yuv420p", "ts", X264),
          ("mpeg2video", "yuv422p", "mxf", {"b": "8M", "flags": "+ildct+ilme"}),
          ("prores_ks", "yuv422p10le", "mov", {"flags": "+ildct"}),
      )
      for word, flags in (("top field first", "tff"), ("bottom field first", "bff"))),
    Case(name="film in 60i, flagged progressive", codec="libx264", pix_fmt="yuv420p", suffix="mp4", options=X264,
         fps=NTSC, scan="telecine_tff"),
    Case(name="film with repeat flags", codec="mpeg2video", pix_fmt="yuv420p", suffix="m2v",
         options={"b": "8M", "bf": "0", "flags": "+ildct"}, fps=NTSC, scan="soft"),
)  # fmt: skip


@cache
def _texture(size: tuple[int, int]) -> NDArray[np.float64]:
    """(h, 3 w) grey between black and white: waves of many directions, soft enough for any codec; periodic."""
    w, h = 3 * SIZE[0], SIZE[1]
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:h, :w]
    scene = np.zeros((h, w))
    for _ in range(24):
        kx, ky = rng.integers(-w // 24, w // 24), rng.integers(-h // 24, h // 24)
        scene += np.cos(2 * np.pi * (kx * x / w + ky * y / h) + rng.uniform(0, 2 * np.pi))
    scene = (scene - scene.min()) / (scene.max() - scene.min())
    scene = BLACK + 8 + (WHITE - BLACK - 16) * scene
    return np.tile(scene, (-(-size[1] // h), -(-3 * size[0] // w)))[: size[1]]


def luma(index: float, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """(h, w) grey levels of 8 bits, at time `index` in pictures (halves are fields)."""
    scene = _texture(size)
    return np.roll(scene, -round(index * SHIFT_PX), axis=1)[:, : size[0]]


def woven(index: int, scan: str, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """One interlaced frame: its two fields are half a picture apart, or of the film's pictures that pull-down gives."""
    first, second = float(index), index + 0.5
    if scan.startswith("telecine"):
        cycle, place = divmod(index, 5)
        first, second = 4.0 * cycle + FIRST_FIELD[place], 4.0 * cycle + SECOND_FIELD[place]
    picture = luma(first, size).copy()
    later = 1 if scan.endswith("tff") else 0  # rows of the field that comes second
    picture[later::2] = luma(second, size)[later::2]
    return picture


def ask_for_repeats(path: Path) -> None:
    """Set MPEG-2's flags so that progressive pictures are shown for three and two fields in turn: 24 a second in 60i.

    ISO 13818-2: the picture coding extension (start code B5, kind 8) has top_field_first, repeat_first_field and
    progressive_frame in its fourth and fifth byte; a sequence extension (kind 1) that is progressive forbids it."""
    data = bytearray(path.read_bytes())
    n = 0
    for at in range(len(data) - 9):
        if data[at : at + 4] != b"\x00\x00\x01\xb5":
            continue
        kind = data[at + 4] >> 4
        if kind == 1:
            data[at + 5] &= ~0x08 & 0xFF  # progressive_sequence
        elif kind == 8:
            top_first = n % 4 in (0, 1)  # T B T, B T, B T B, T B: three fields turn the order round
            data[at + 7] = (
                (data[at + 7] & ~0x82 & 0xFF) | (0x80 if top_first else 0) | (0x02 if n % 2 == 0 else 0)
            )
            data[at + 8] |= 0x80  # progressive_frame
            n += 1
    path.write_bytes(bytes(data))


def video_frame(grey: NDArray[np.float64], pix_fmt: str) -> av.VideoFrame:
    """A frame whose Y plane is `grey`, in units of 8 bits, and whose colour is neutral."""
    h, w = grey.shape
    form = av.VideoFormat(pix_fmt, w, h)
    bits = form.components[0].bits
    stored = np.rint(grey * (1 << (bits - 8))).astype(np.uint16)
    if pix_fmt in (
        "nv12",
        "uyvy422",
    ):  # packed layouts: by way of a planar one
        return video_frame(grey, "yuv422p").reformat(format=pix_fmt)
    frame = av.VideoFrame(w, h, pix_fmt)
    for number, plane in enumerate(frame.planes):
        sample = np.dtype("<u2") if bits > 8 else np.dtype(np.uint8)
        neutral = (1 << bits) - 1 if number == 3 else 1 << (bits - 1)
        rows = np.full((plane.height, plane.line_size // sample.itemsize), neutral, sample)
        if number == 0:
            rows[:, :w] = stored
        plane.update(rows.tobytes())
    return frame


def make(case: Case, folder: Path) -> Path:
    """Write the case's file into a folder: N pictures."""
    path = folder / f"{case.name.replace(' ', '-')}.{case.suffix}"
    w, h = case.size
    with av.open(str(path), "w") as container:
        stream = container.add_stream(case.codec, rate=case.fps, options=dict(case.options))
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = w, h, case.pix_fmt
        stream.codec_context.thread_count = 1
        context = stream.codec_context
        if case.colour is not None:
            context.colorspace, context.color_primaries, context.color_trc = case.colour
        if case.color_range is not None:
            context.color_range = case.color_range
        if case.flags != "progressive" and case.codec == "libx264":
            context.options = {**case.options, "x264-params": f"{case.flags}=1:log-level=none"}
        mark = _field_marker(case) if case.flags != "progressive" else None
        for index in range(case.n_coded):
            whole = case.scan in ("progressive", "soft")
            grey = luma(index, case.size) if whole else woven(index, case.scan, case.size)
            if case.color_range == FULL:
                grey = (grey - BLACK) * 255 / (WHITE - BLACK)
            frame = video_frame(grey, case.pix_fmt)
            frame.pts, frame.time_base = index, 1 / case.fps
            if mark is not None:
                mark.vpush(frame)
                frame = mark.vpull()
            if case.colour is not None:
                frame.colorspace, frame.color_primaries, frame.color_trc = case.colour
            if case.color_range is not None:
                frame.color_range = case.color_range
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    if case.scan == "soft":
        ask_for_repeats(path)
    return path


def _field_marker(case: Case) -> av.filter.Graph:
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=case.size[0], height=case.size[1], format=av.VideoFormat(case.pix_fmt), time_base=1 / case.fps
    )
    mark = graph.add("setfield", case.flags)
    sink = graph.add("buffersink")
    source.link_to(mark)
    mark.link_to(sink)
    graph.configure()
    return graph


def expected(case: Case, index: int) -> NDArray[np.float64]:
    """What picture `index` of the decoded case shall be: fields are half a picture apart, full range spans 0..255."""
    if case.scan in ("tff", "bff"):
        grey = luma(index / 2, case.size)
    elif case.scan != "progressive":
        grey = luma(index, case.size)
    else:  # taken apart into fields, both show the same moment
        grey = luma(index // 2 if case.flags != "progressive" else index, case.size)
    return (grey - BLACK) * 255 / (WHITE - BLACK) if case.color_range == FULL else grey


@dataclass(frozen=True, slots=True, kw_only=True)
class Decoded:
    """What decoding a case gave. worst_grey: largest mean difference of a picture from what it shall be."""

    clip: Clip
    n_pictures: int
    pts_s: NDArray[np.float64]
    worst_grey: float
    rgb: NDArray[np.uint8]


def decode(case: Case, path: Path) -> Decoded:
    """Decode the whole file of a case."""
    errors, pts, rgb = [], [], None
    with open_clip(path) as clip:
        for frame in clip:
            errors.append(float(np.abs(frame.gray - expected(case, frame.index)).mean()))
            pts.append(frame.pts_s)
            if frame.index == 3:
                rgb = frame.picture()
    assert rgb is not None
    return Decoded(clip=clip, n_pictures=len(pts), pts_s=np.array(pts), worst_grey=max(errors), rgb=rgb)


def main() -> None:
    """Print the table of docs/footage.md."""
    print(f"| case ({N} frames) | seen as | pictures | grey levels off | said |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            if case.missing():
                print(f"| {case.name} | | | | not made here: {case.missing()} |")
                continue
            found = decode(case, make(case, Path(folder)))
            facts = found.clip.facts
            space, transfer = facts.colour["rgb_matrix"], facts.colour["transfer_name"]
            seen = f"{facts.codec} {facts.pix_fmt}, {facts.bit_depth} bits, {space}{', ' if transfer else ''}{transfer}"
            said = "; ".join(facts.warnings) or "-"
            print(f"| {case.name} | {seen} | {found.n_pictures} | {found.worst_grey:.2f} | {said} |")


if __name__ == "__main__":
    main()
