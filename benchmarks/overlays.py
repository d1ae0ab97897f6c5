"""Share of true overlay pixels that are masked, and of scene pixels that are lost, on generator clips.

    python -m benchmarks.overlays [--seeds 1 2 ...] [--size 960x540] [--degrees 5 10 20]

Four sets of graphics (opaque scoreboard with a running clock, half-transparent logo, opaque ticker with running news,
all three) over a pan, on three textures. Gray and motion are the generator's own: the finder alone is judged. An
overlay's own rim of three pixels, which it widens itself by on purpose, counts as neither.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from pipelines.config import OverlayOptions
from pipelines.overlays import OverlayFinder
from tests.synth.clip import ClipSpec, SynthClip
from tests.synth.paths import PathSpec

SETS = {
    "opaque": (True, False, False),
    "half-transparent": (False, True, False),
    "animated": (False, False, True),
    "all three": (True, True, True),
    "none": (False, False, False),
}
RIM_PX = 3


def spec_of(name: str, seed: int, size_px: tuple[int, int], n_frames: int) -> ClipSpec:
    """A pan of 24 degrees that zooms a little; the texture goes with the seed."""
    rng = np.random.default_rng([seed, 31])
    scoreboard, logo, ticker = SETS[name]
    path = PathSpec(
        pan_deg=24.0, zoom=1.2, zoom_style="in", f0_per_width=float(rng.uniform(1.1, 1.5)), tilt_deg=2.0
    )
    return ClipSpec(
        seed=seed,
        width=size_px[0],
        height=size_px[1],
        n_frames=n_frames,
        path=path,
        texture=("full", "band", "arena")[seed % 3],
        player_share=float(rng.uniform(0.03, 0.2)),
        scoreboard=scoreboard,
        logo=logo,
        ticker=ticker,
        max_px_per_rad=2200.0,
    )


def judged(spec: ClipSpec, degrees: Sequence[float], options: OverlayOptions) -> list[tuple[float, float]]:
    """(share of overlay pixels masked, share of scene pixels lost) after each of the given pans."""
    clip = SynthClip(spec)
    finder = OverlayFinder((spec.width, spec.height), options)
    centre = np.array([spec.width / 2, spec.height / 2])
    ever = np.zeros((spec.height, spec.width), bool)
    results: list[tuple[float, float]] = []
    first, before = clip.camera(0), None
    for k in range(spec.n_frames):
        frame = clip.frame(k)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        moved = float("nan")
        if before is not None:
            moved = float(np.linalg.norm(frame.camera.ray_to_pixel(before.pixel_to_ray(centre)) - centre))
        finder.update(gray, moved)
        before = frame.camera
        ever |= frame.overlay_mask
        if (
            len(results) < len(degrees)
            and abs(np.rad2deg(before.pan_rad - first.pan_rad)) >= degrees[len(results)]
        ):
            usable = finder.mask()
            masked = np.zeros_like(ever) if usable is None else ~usable
            near = cv2.dilate(ever.astype(np.uint8), np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)) > 0
            share = float(masked[ever].mean()) if ever.any() else float("nan")
            results.append((share, float((masked & ~near).mean())))
    return results


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--frames", type=int, default=130)
    parser.add_argument("--degrees", nargs="+", type=float, default=[5.0, 10.0, 20.0])
    arguments = parser.parse_args()
    width, height = (int(v) for v in arguments.size.split("x"))
    head = " | ".join(f"{d:g} degrees: masked, lost %" for d in arguments.degrees)
    print(f"| graphics | {head} |\n|---|" + "---|" * len(arguments.degrees))
    for name in arguments.sets:
        rows = []
        for seed in arguments.seeds:
            spec = replace(spec_of(name, seed, (width, height), arguments.frames))
            rows.append(judged(spec, arguments.degrees, OverlayOptions()))
        found = 100 * np.array(rows)
        cells = [
            f"{found[:, d, 0].min():.1f} to {found[:, d, 0].max():.1f}, {found[:, d, 1].max():.2f}"
            for d in range(len(arguments.degrees))
        ]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
