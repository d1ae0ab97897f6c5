"""What a real clip says about its focal length when parts of it are left out (real-footage.md 3, by the whole job).

    python -m benchmarks.real_consistency CLIP [--stand-rows 0.23]

The clip as it is, its odd and its even frames, backwards, and with everything below the stand painted grey, each stored
without loss and run with the panorama off. A row a variant: mean difference of log f from the whole clip's over the
frames that both have, rms of the zoom ratio's difference, stated sigma, and the verdict. No truth is involved: what all
variants share (the lens model, a pupil) stays unseen.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from pipelines.archive import read_camera_csv
from pipelines.config import Config
from pipelines.run import process

Planes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """name; frames: numbers of the clip's frames in the variant's order; change: of a picture's yuv420p planes."""

    name: str
    frames: tuple[int, ...]
    change: Callable[[Planes], Planes]


def variants(n_frames: int, height: int, stand_rows: float) -> list[Variant]:
    """The variants of the module's docstring."""
    every = tuple(range(n_frames))

    def stand_only(planes: Planes) -> Planes:
        """Planes as PyAV stacks them: the first `height` rows are Y."""
        painted = planes.copy()
        painted[int(stand_rows * height) : height] = 110
        return painted

    def same(planes: Planes) -> Planes:
        return planes

    return [
        Variant(name="whole", frames=every, change=same),
        Variant(name="even frames", frames=every[::2], change=same),
        Variant(name="odd frames", frames=every[1::2], change=same),
        Variant(name="backwards", frames=every[::-1], change=same),
        Variant(name="stand only", frames=every, change=stand_only),
    ]


def write(path: Path, pictures: list[Planes], variant: Variant) -> None:
    """The variant as FFV1 in Matroska, 25 frames a second."""
    height, width = pictures[0].shape[0] * 2 // 3, pictures[0].shape[1]
    with av.open(str(path), "w") as out:
        stream = out.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for k, frame in enumerate(variant.frames):
            picture = av.VideoFrame.from_ndarray(variant.change(pictures[frame]), format="yuv420p")
            picture.pts, picture.time_base = k, Fraction(1, 25)
            out.mux(stream.encode(picture))
        out.mux(stream.encode(None))


def log_focals(out: Path, variant: Variant) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n_frames,) log f and log zoom ratio by the clip's own frame numbers, NaN where not known."""
    table = read_camera_csv(out / "camera.csv")
    log_f, log_zoom = np.full((2, max(variant.frames) + 2), np.nan)
    rows = np.array(variant.frames)[table.frame]
    with np.errstate(invalid="ignore"):
        log_f[rows], log_zoom[rows] = np.log(table.f_px), np.log(table.zoom_ratio)
    return log_f, log_zoom


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clip", type=Path)
    parser.add_argument("--stand-rows", type=float, default=0.23, help="share of the picture's height")
    arguments = parser.parse_args()
    with av.open(str(arguments.clip)) as source:
        pictures = [
            np.asarray(frame.to_ndarray(format="yuv420p"), np.uint8) for frame in source.decode(video=0)
        ]
    height = pictures[0].shape[0] * 2 // 3
    config = Config.model_validate({"panorama": {"enabled": False}})
    print(
        "| variant | log f against the whole, % | zoom rms, % | stated sigma % | verdict |\n|---|---|---|---|---|"
    )
    whole: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    for variant in variants(len(pictures), height, arguments.stand_rows):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "clip.mkv"
            write(path, pictures, variant)
            record = process(path, Path(folder) / "out", config)
            log_f, log_zoom = log_focals(Path(folder) / "out", variant)
        whole = whole or (log_f, log_zoom)
        n = min(len(log_f), len(whole[0]))
        difference, zoom = log_f[:n] - whole[0][:n], log_zoom[:n] - whole[1][:n]
        known, zoomed = np.isfinite(difference), np.isfinite(zoom)
        cells = [
            f"{100 * difference[known].mean():+.2f}" if known.any() else "-",
            f"{100 * (zoom[zoomed] - zoom[zoomed].mean()).std():.3f}" if zoomed.any() else "-",
            ", ".join(f"{100 * shot.calibration['sigma_relative']:.1f}" for shot in record.shots
                      if shot.calibration["sigma_relative"] is not None),
            ", ".join(f"{shot.status} {shot.reason}".strip() for shot in record.shots),
        ]  # fmt: skip
        print(f"| {variant.name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
