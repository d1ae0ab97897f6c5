"""Which warp family real footage needs: eight parameters, four of a camera, or four and four weak ones, against truth.

    python -m benchmarks.registration.families [--seeds 1 2 3] [--size 720p]

Pairs 5 and 25 frames apart of a scene whose texture lies mostly in a band, in four steps towards a real camera: texture
alone, a lens, a pupil in front of the pan axis, a wrong focal length in the four-parameter warp. Error: rms over a grid
of the whole picture, and over its lowest fifth, of where the pixel's direction is seen in the other frame (far away:
parallax counts as an error of nobody's warp and is in all columns).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from benchmarks.registration.scenes import SIZES, true_homography
from calib.records import Lens
from mosaic.coords import transfer
from mosaic.estimator import align
from mosaic.pulled import PulledFamily
from mosaic.pyramid import build_pyramid
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from pipelines.bridge import CameraPose, RotationZoomFamily, pair_state
from tests.synth.camera import SynthCamera
from tests.synth.clip import ClipSpec, SynthClip
from tests.synth.paths import BROADCAST_LENS, LensSpec, PathSpec

FIRST = 45
CASES = {
    "band": (LensSpec(), 1.0),
    "band, lens": (BROADCAST_LENS, 1.0),
    "band, lens, pupil .6 m": (replace(BROADCAST_LENS, pupil_m=0.6), 1.0),
    "band, lens, focal 10 % long": (BROADCAST_LENS, 1.1),
}


def _grid(size_px: tuple[int, int]) -> np.ndarray:
    w, h = size_px
    x, y = np.meshgrid(np.linspace(0, w - 1, 17), np.linspace(0, h - 1, 11))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _errors(found: np.ndarray, truth: np.ndarray, size_px: tuple[int, int]) -> tuple[float, float]:
    """Rms px over the grid points that the second picture shows, and over those in the lowest fifth of the first."""
    w, h = size_px
    points = _grid(size_px)
    seen = np.isfinite(truth).all(axis=1) & (truth > 0).all(axis=1) & (truth < [w, h]).all(axis=1)
    d2 = np.sum((found - truth) ** 2, axis=1)
    low = seen & (points[:, 1] > 0.8 * h)
    return float(np.sqrt(d2[seen].mean())), float(np.sqrt(d2[low].mean())) if low.any() else float("nan")


def _lens_of(camera: SynthCamera, spec: LensSpec) -> Lens:
    return Lens(
        size_px=(camera.width, camera.height), pp_px=np.array([camera.cx_px, camera.cy_px]), aspect=camera.aspect,
        c0=spec.c0, c1=spec.c1,
    )  # fmt: skip


def one_pair(clip: SynthClip, gap: int, lens: LensSpec, focal: float) -> dict[str, tuple[float, float]]:
    """Errors by family, starting 3 px off the rotation and zoom that the cameras have."""
    cameras = [clip.camera(k) for k in (FIRST, FIRST + gap)]
    size_px = (clip.spec.width, clip.spec.height)
    frames = [clip.frame(k) for k in (FIRST, FIRST + gap)]
    pyramids = [
        build_pyramid(cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY), mask=~f.overlay_mask) for f in frames
    ]
    template = build_template(pyramids[0], 0)
    points = _grid(size_px)
    truth = cameras[1].ray_to_pixel(cameras[0].pixel_to_ray(points))
    poses = [CameraPose(log_f=float(np.log(focal * c.f_px)), R=c.R_cam_world) for c in cameras]
    camera_lens = _lens_of(cameras[0], lens)
    four = RotationZoomFamily(lens=camera_lens, log_f_src=poses[0].log_f)
    start = four.update(pair_state(*poses), np.array([0.0, 2.0, -2.0, 0.0]) / cameras[0].f_px)
    pulled = PulledFamily(base=four, size_px=size_px)
    eight = HomographyFamily(size_px=size_px)
    shift = np.array([[1.0, 0, 2.0], [0, 1.0, 2.0], [0, 0, 1.0]])
    families: dict[str, tuple[Any, Any]] = {
        "8": (eight, shift @ true_homography(*cameras)),
        "4": (four, start),
        "4 + weak 4": (pulled, pulled.start(start)),
    }
    found = {}
    for name, (family, state) in families.items():
        prepared = prepare(template, family)
        fit, state = align(prepared, pyramids[1], state, dst=1, levels=(2, 1, 0))
        if not fit.usable:
            found[name] = (np.inf, np.inf)
            continue
        where = transfer(state, points) if name == "8" else family.warp(state, family.prepare(points))[0]
        found[name] = _errors(where, truth, size_px)
    return found


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", default="720p", choices=list(SIZES))
    arguments = parser.parse_args(argv)
    w, h = SIZES[arguments.size]
    print(
        "| case | gap | 8: all | 8: lowest fifth | 4: all | 4: lowest | 4 + weak 4: all | 4 + weak 4: lowest |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for case, (lens, focal) in CASES.items():
        rows: dict[int, list[dict[str, tuple[float, float]]]] = {5: [], 25: []}
        for seed in arguments.seeds:
            path = PathSpec(pan_deg=24, zoom=1.4, zoom_style="in")
            clip = SynthClip(
                ClipSpec(
                    seed=seed, width=w, height=h, path=path, lens=lens, texture="band", player_share=0.05
                )
            )
            for gap in rows:
                rows[gap].append(one_pair(clip, gap, lens, focal))
        for gap, found in rows.items():
            medians = [
                np.median([f[name][k] for f in found]) for name in ("8", "4", "4 + weak 4") for k in (0, 1)
            ]
            print(f"| {case} | {gap} | " + " | ".join(f"{m:.3g}" for m in medians) + " |", flush=True)


if __name__ == "__main__":
    main()
