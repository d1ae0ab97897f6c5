"""Shots that players fill, before hoardings that scroll: what becomes of them without anybody's masks.

    python -m benchmarks.crowd --seeds 61 62 71 72 --work FOLDER

A row per shot: its frames by status, errors of focal, zoom ratio and homographies against the truth. A clip of 200
frames takes some four minutes, three of them rendering.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from pipelines.compare import compare_run
from pipelines.config import Config
from pipelines.run import process
from tests.synth.clip import ClipSpec, write_clip
from tests.synth.paths import BROADCAST_LENS, PathSpec


def spec_of(seed: int, n_frames: int) -> ClipSpec:
    """Players on 40 % of 1280x720 on average, hoardings of 5 m at 2.5 m/s."""
    return ClipSpec(
        seed=seed, width=1280, height=720, path=PathSpec(pan_deg=25, zoom=1.7, tilt_deg=2.0), lens=BROADCAST_LENS,
        n_frames=n_frames, n_players=30, player_share=0.4, board_height_m=5.0, led_scroll_m_s=2.5,
    )  # fmt: skip


def main() -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[61, 62, 71, 72])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--no-panorama", action="store_true", help="cameras alone")
    parser.add_argument("--work", type=Path, required=True, help="clips and runs are kept here")
    options = parser.parse_args()
    config = Config.model_validate({"panorama": {"enabled": not options.no_panorama}})
    for seed in options.seeds:
        folder = options.work / f"crowd-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        clip = folder / "clip.mp4"
        if not clip.exists():
            write_clip(clip, spec_of(seed, options.frames))
        process(clip, folder / "out", config)
        record = json.loads((folder / "out" / "run.json").read_text())
        compared = compare_run(folder / "out", folder / "clip-truth.csv")["shots"]
        for shot, errors in zip(record["shots"], compared, strict=True):
            shown = ("focal_bias", "focal_std_claimed", "zoom_rms", "corner_px", "transfer_px")
            row = {"seed": seed, "frames": shot["status_counts"], "warnings": shot["warnings"]}
            print(json.dumps(row | {name: errors.get(name) for name in shown}), flush=True)


if __name__ == "__main__":
    main()
