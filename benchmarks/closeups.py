"""Close-ups and crowds on their feet: refused, or tracked by the ground that shows; a track of the person is wrong.

    python -m benchmarks.closeups [--seeds 1 2 ...] [--width 480] [--frames 60]

Generated shots (tests/synth/closeups.py) through the main job without panorama. The truth is where the camera looks on
the ground. Per found shot: refused with not_a_rotation; no camera at all; or how far its homographies put the picture's
middle from where the ground went, the median and the largest, px at W = 1280.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from mosaic.coords import transfer
from pipelines.archive import read_camera_csv
from pipelines.config import Config
from pipelines.records import CameraTable, ShotRecord
from pipelines.run import process
from tests.synth.closeups import CloseUpSpec, ground_px, random_closeup, write_closeup

WRONG_PX = 20.0  # median, at W = 1280: what follows a person is off by a part of his way


def outcome(spec: CloseUpSpec, shot: ShotRecord, table: CameraTable) -> tuple[str, float, float]:
    """'refused', 'no camera', 'ground' or 'wrong', and the median and largest error, px at W = 1280."""
    rows = np.flatnonzero(table.shot == shot.index)
    if shot.status == "failed":
        return ("refused" if shot.reason == "not_a_rotation" else "no camera"), np.nan, np.nan
    truth = ground_px(spec)
    middle = np.array([[(spec.width - 1) / 2, (spec.height - 1) / 2]])
    errors = []
    for row in rows:
        if np.isfinite(table.homography[row]).all():
            moved = transfer(table.homography[row], middle)[0] - middle[0]
            errors.append(np.linalg.norm(moved - truth[table.frame[row]] + truth[shot.reference_frame]))
    scaled = np.array(errors) * 1280 / spec.width
    median = float(np.median(scaled))
    return ("wrong" if median > WRONG_PX else "ground"), median, float(scaled.max())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(1, 13)))
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    config = Config.model_validate({"panorama": {"enabled": False}})
    print(
        "| seed | shows | frames | outcome | median px | largest px | chi2/dof | residual px |\n|"
        + "---|" * 8
    )
    for seed in arguments.seeds:
        spec = random_closeup(seed, width=arguments.width, n_frames=arguments.frames)
        with tempfile.TemporaryDirectory() as name:
            write_closeup(Path(name) / "clip.mp4", spec)
            record = process(Path(name) / "clip.mp4", Path(name) / "out", config)
            table = read_camera_csv(Path(name) / "out" / "camera.csv")
        for shot in record.shots:
            what, median, largest = outcome(spec, shot, table)
            fit = shot.calibration["rotation_fit"]
            residual = (fit["residual_px"] or np.nan) * 1280 / spec.width
            chi2 = shot.calibration["chi2_dof"] or np.nan
            frames = f"{shot.first_frame} to {shot.last_frame}, {shot.status_counts.get('lost', 0)} lost"
            print(
                f"| {seed} | {spec.kind} | {frames} | {what} | {median:.1f} | {largest:.1f} | {chi2:.1f} | "
                f"{residual:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
