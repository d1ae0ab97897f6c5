"""One generator shot in the shapes that broadcasters give it: same scene, same camera, so that focal errors compare.

`python -m tests.pipelines.variants` runs the whole program on each and prints the second table of docs/footage.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from tests.pipelines.end_to_end import SIZE, Finished, run, small_spec
from tests.synth.clip import read_truth, truth_path, write_clip
from tests.synth.paths import PathSpec

FPS = 25
N_FINE = 96  # pictures at twice the rate: fields of an interlaced clip
Pictures = list[tuple[NDArray[np.uint8], float]]  # RGB and time in frames


def fine_clip(folder: Path) -> Path:
    """The shot at field rate: a pan of 18 degrees that zooms in by 1.3; the truth lies beside it."""
    path = folder / "fine.mp4"
    write_clip(path, small_spec(4, N_FINE, PathSpec(pan_deg=18, zoom=1.3, zoom_style="in"), crf=12))
    return path


def read_pictures(path: Path) -> list[NDArray[np.uint8]]:
    """RGB of all pictures of a file."""
    with av.open(str(path)) as container:
        return [np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in container.decode(video=0)]


def plain(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Every second picture: frames."""
    return [(picture, float(i)) for i, picture in enumerate(fine[::2])]


def woven(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Frames of two fields, top first."""
    found: Pictures = []
    for i in range(0, len(fine) - 1, 2):
        frame = fine[i].copy()
        frame[1::2] = fine[i + 1][1::2]
        found.append((frame, i / 2))
    return found


def telecine(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Every fourth frame twice in a row, as conversions from 24 to 30 frames/s do; times go on evenly."""
    found: Pictures = []
    for i, (picture, _) in enumerate(plain(fine)):
        found.append((picture, float(len(found))))
        if i % 4 == 3:
            found.append((picture, float(len(found))))
    return found


def uneven(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Variable frame rate: a fifth of the frames left out, the others at their own times."""
    return [(picture, t) for picture, t in plain(fine) if int(t) % 5 != 3]


def black_and_frozen(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Three black frames, and five that repeat the one before."""
    found = plain(fine)
    for i in (14, 15, 16):
        found[i] = (np.zeros_like(found[i][0]), found[i][1])
    for i in range(30, 35):
        found[i] = (found[29][0], found[i][1])
    return found


def squeezed(fine: list[NDArray[np.uint8]]) -> Pictures:
    """Anamorphic: 3/4 of the width, pixels 4/3 as wide."""
    size = (SIZE[0] * 3 // 4, SIZE[1])
    return [(cv2.resize(p, size, interpolation=cv2.INTER_AREA), t) for p, t in plain(fine)]  # type: ignore[misc]


HEVC = {"x265-params": "log-level=none:crf=18"}
# name: pictures, encoder, pixel format, container, options, pixel aspect, interlaced
VARIANTS: dict[str, tuple[Callable[..., Pictures], str, str, str, dict[str, str], Fraction | None, bool]] = {
    "clean (H.264 4:2:0, 8 bits, mp4)": (plain, "libx264", "yuv420p", "mp4", {"crf": "18"}, None, False),
    "HEVC 4:2:0, 10 bits, ts": (plain, "libx265", "yuv420p10le", "ts", HEVC, None, False),
    "ProRes 4:2:2, 10 bits, mov": (plain, "prores_ks", "yuv422p10le", "mov", {"profile": "hq"}, None, False),
    "DNxHR 4:2:2, 8 bits, mxf": (plain, "dnxhd", "yuv422p", "mxf", {"profile": "dnxhr_sq"}, None, False),
    "interlaced (H.264, top field first, ts)": (woven, "libx264", "yuv420p", "ts", {"crf": "16"}, None, True),
    "anamorphic (480x360, pixels 4:3)": (squeezed, "libx264", "yuv420p", "mp4", {"crf": "18"}, Fraction(4, 3), False),
    "variable frame rate (mkv)": (uneven, "libx264", "yuv420p", "mkv", {"crf": "18"}, None, False),
    "repeated frames (4 become 5)": (telecine, "libx264", "yuv420p", "mp4", {"crf": "18"}, None, False),
    "3 black, 5 frozen frames": (black_and_frozen, "libx264", "yuv420p", "mp4", {"crf": "18"}, None, False),
}  # fmt: skip
CLEAN = next(iter(VARIANTS))


def write_variant(name: str, fine: list[NDArray[np.uint8]], folder: Path) -> Path:
    """Encode one variant."""
    make, codec, pix_fmt, suffix, options, aspect, interlaced = VARIANTS[name]
    path = folder / f"variant-{list(VARIANTS).index(name)}.{suffix}"
    if interlaced:
        options = {**options, "x264-params": "tff=1:log-level=none"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options=options)
        assert isinstance(stream, VideoStream)
        pictures = make(fine)
        stream.height, stream.width = pictures[0][0].shape[:2]
        stream.pix_fmt = pix_fmt
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        for picture, time in pictures:
            # 4:2:0 mixes the colours of the two fields; grey, which is all that is used here, does not see it.
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pix_fmt)
            frame.pts, frame.time_base = round(time), Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def true_focal_px(name: str, done: Finished, truth: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """(n,) fx in pixels as decoded of each row of camera.csv, by its place in the fine clip."""
    make = VARIANTS[name][0]
    table = done.table
    f_px = np.asarray(truth["f_px"], float)
    if make is telecine:
        source = 4 * (table.frame // 5) + np.minimum(table.frame % 5, 3)
        return f_px[2 * source]
    half: NDArray[np.int64] = np.rint((table.pts_s - table.pts_s[0]) * 2 * FPS).astype(int)
    if make is black_and_frozen:  # a frozen picture shows the camera as it was then
        half[30:35] = half[29]
    return f_px[half] * (0.75 if make is squeezed else 1.0)


def relative_errors(name: str, done: Finished, truth: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """(n,) signed relative focal error, NaN where no focal is claimed."""
    true = true_focal_px(name, done, truth)
    return np.asarray(done.table.f_px / true - 1)


def main() -> None:
    """Run all variants; print the table of docs/footage.md."""
    print(
        "| variant | pictures | status | median focal error % | largest | stated sigma % |\n|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = fine_clip(folder)
        fine, truth = read_pictures(path), read_truth(truth_path(path))
        for variant in VARIANTS:
            done = run(
                write_variant(variant, fine, folder), folder / "out", "--panorama.enabled", "false", "-q"
            )
            table = done.table
            errors = np.abs(relative_errors(variant, done, truth))
            counts = ", ".join(f"{table.status.count(s)} {s}" for s in sorted(set(table.status)))
            known = np.isfinite(errors).any()
            cells = (
                (np.nanmedian(errors), np.nanmax(errors), np.nanmedian(table.f_std_px / table.f_px))
                if known
                else ()
            )
            shown = " | ".join(f"{100 * value:.2f}" for value in cells) or "- | - | -"
            print(f"| {variant} | {len(table)} | {counts} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
