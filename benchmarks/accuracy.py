"""Accuracy of the whole job against known truth: generator clips through `process`, errors and error bars as a table.

    python -m benchmarks.accuracy --preset ideal --seeds 1 2 3 [--size 1280x720] [--frames 200] [--out FOLDER]

A row per clip: focal error (median and 95th percentile over frames), stated sigma, whether the truth lies inside two of
them, relative zoom error, homography corner error to the reference frame. Frames/s are of this machine and this moment.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.compare import compare_run
from pipelines.config import Config
from pipelines.run import process
from tests.synth.clip import write_clip
from tests.synth.presets import preset

COLUMNS = (
    "preset",
    "seed",
    "status",
    "f med %",
    "f p95 %",
    "sigma %",
    "in 2s %",
    "zoom rms %",
    "corner px",
    "frames/s",
)


def one(name: str, seed: int, folder: Path, changes: dict[str, Any], config: Config) -> dict[str, Any]:
    """Generate, run, compare; one row."""
    clip = folder / f"{name}-{seed}.mp4"
    if not clip.exists():
        write_clip(clip, replace(preset(name, seed=seed), **changes))
    started = time.perf_counter()
    record = process(clip, folder / f"{name}-{seed}", config)
    seconds = time.perf_counter() - started
    found = compare_run(folder / f"{name}-{seed}", clip.with_name(f"{clip.stem}-truth.csv"))
    shot = found["shots"][0]
    row = {
        "preset": name,
        "seed": seed,
        "status": record.shots[0].status if record.shots[0].status == "ok" else record.shots[0].reason,
        "shots": len(record.shots),
        "frames/s": record.clip["n_frames_decoded"] / seconds,
        "comparison": shot,
    }
    for column, key in KEYS.items():
        value = shot.get(key)
        scale = 100.0 if column.endswith("%") else 1.0
        row[column] = float("nan") if value is None else scale * float(value)
    return row


KEYS = {
    "f med %": "focal_median",
    "f p95 %": "focal_p95",
    "sigma %": "focal_std_claimed",
    "in 2s %": "inside_2_sigma",
    "zoom rms %": "zoom_rms",
    "corner px": "corner_px",
}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a Markdown table, with the medians and extremes that the targets name."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for row in rows:
        cells = [f"{row[c]:.3g}" if isinstance(row[c], float) else str(row[c]) for c in COLUMNS]
        lines.append("| " + " | ".join(cells) + " |")
    medians = np.array([row["f med %"] for row in rows])
    claimed = medians[np.isfinite(medians)]
    if len(claimed):
        inside = [row["in 2s %"] for row in rows if np.isfinite(row["in 2s %"])]
        lines.append("")
        lines.append(
            f"{len(rows)} clips, {len(claimed)} with a focal: median error {np.median(claimed):.3f} %, 95th percentile "
            f"{np.quantile(claimed, 0.95):.3f} %, inside two sigma {np.mean(np.array(inside) >= 50) * 100:.0f} % "
            f"of clips, worst corner {np.nanmax([row['corner px'] for row in rows]):.2f} px"
        )
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", nargs="+", default=["ideal", "lens"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--size", default="")
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--megapixels", type=float, default=60.0, help="of the panorama; small = faster")
    parser.add_argument("--no-panorama", action="store_true", help="cameras alone")
    parser.add_argument("--out", type=Path, default=None, help="keep clips and runs here")
    arguments = parser.parse_args()
    changes: dict[str, Any] = {}
    if arguments.size:
        changes["width"], changes["height"] = (int(v) for v in arguments.size.split("x"))
    if arguments.frames:
        changes["n_frames"] = arguments.frames
    config = Config.model_validate(
        {"panorama": {"max_megapixels": arguments.megapixels, "enabled": not arguments.no_panorama}}
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        rows = []
        for name in arguments.preset:
            for seed in arguments.seeds:
                rows.append(one(name, seed, folder, changes, config))
                print(json.dumps({c: rows[-1][c] for c in COLUMNS}), flush=True)
        print(table(rows))


if __name__ == "__main__":
    main()
