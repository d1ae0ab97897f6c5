"""Cameras of known parameters for the tests of exports, and where they truly see a ray. Own formulas: nothing of
pipelines or calib is used for the truth, only the generator's rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.records import CameraTable, RunRecord
from tests.pipelines.tables import camera_table, run_record, shot_record
from tests.synth.camera import rotation_cam_world

Array = NDArray[np.float64]

N = 8
LOST = 3  # row of the frame without a camera in the middle of shot 0
FIRST = 40  # frame number of row 0: numbers are not rows


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Camera columns of N frames of shot 0, camera.csv's units."""

    size_px: tuple[int, int] = (1920, 1080)
    f_px: Array
    aspect: float = 1.0
    cx_px: float = 966.25
    cy_px: float = 530.5
    k1: Array
    pan_deg: Array
    tilt_deg: Array
    roll_deg: Array

    def project(self, i: int, rays: Array) -> Array:
        """Pixels (m, 2) of directions (m, 3) in the shot world, by OpenCV's model written out."""
        angles = np.radians([self.pan_deg[i], self.tilt_deg[i], self.roll_deg[i]])
        X, Y, Z = rotation_cam_world(*angles) @ rays.T
        assert (Z > 0).all()
        x, y = X / Z, Y / Z
        g = 1 + self.k1[i] * (x * x + y * y)
        f = self.f_px[i]
        return np.stack([f * x * g + self.cx_px, f / self.aspect * y * g + self.cy_px], axis=-1)

    def rays(self, i: int, n: int = 100, seed: int = 0) -> Array:
        """n unit directions (n, 3) in the shot world, all over frame i's picture."""
        w, h = self.size_px
        at = np.random.default_rng(seed + i).uniform([0, 0], [w - 1, h - 1], (n, 2))
        f = self.f_px[i]
        cam = np.stack(
            [(at[:, 0] - self.cx_px) / f, (at[:, 1] - self.cy_px) / (f / self.aspect), np.ones(n)], axis=-1
        )
        angles = np.radians([self.pan_deg[i], self.tilt_deg[i], self.roll_deg[i]])
        world = cam @ rotation_cam_world(*angles)
        return world / np.linalg.norm(world, axis=-1, keepdims=True)

    def table(self) -> CameraTable:
        """Shot 0 with this camera (row LOST has none), two frames between the shots, shot 1 `relative`."""
        n = N + 2 + 3
        own = np.zeros(n, bool)
        own[:N] = True
        own[LOST] = False

        def column(values: Any) -> Array:
            padded = np.full(n, np.nan)
            padded[:N] = values
            return np.where(own, padded, np.nan)

        status = ["ok"] * N + ["graphic"] * 2 + ["relative"] * 3
        status[LOST] = "lost"
        reason = [""] * N + ["between_shots"] * 2 + ["zoom_only"] * 3
        reason[LOST] = "low_overlap"
        return camera_table(
            n,
            frame=np.arange(FIRST, FIRST + n),
            pts_s=np.arange(FIRST, FIRST + n) / 50.0,
            timecode=tuple(f"10:00:00:{i:02d}" for i in range(n)),
            shot=np.array([0] * N + [-1] * 2 + [1] * 3),
            status=tuple(status),
            reason=tuple(reason),
            f_px=column(self.f_px),
            f_std_px=column(self.f_px / 50),
            aspect=column(self.aspect),
            cx_px=column(self.cx_px),
            cy_px=column(self.cy_px),
            k1=column(self.k1),
            pan_deg=column(self.pan_deg),
            tilt_deg=column(self.tilt_deg),
            roll_deg=column(self.roll_deg),
        )

    def run(self, **clip: Any) -> RunRecord:
        """A run record that fits `table`."""
        shots = (
            shot_record(0, first_frame=FIRST, last_frame=FIRST + N - 1, reference_frame=FIRST + 2),
            shot_record(
                1, first_frame=FIRST + N + 2, last_frame=FIRST + N + 4, status="relative", reason="zoom_only",
                focal=None,
            ),
        )  # fmt: skip
        facts = {"path": "/clips/a b.mp4", "size_px": list(self.size_px), "fps": 25.0, "picture_fps": 50.0}
        return run_record(shots, clip={**facts, "identity": "cafe", **clip})


def truth(*, distortion: bool = True, centred: bool = False, aspect: float = 1.0) -> Truth:
    """A zooming pan across +-180 degrees. centred: principal point in the middle (formats that know no other)."""
    t = np.linspace(0, 1, N)
    f = 1500.0 * np.exp(0.9 * t)
    made = Truth(
        f_px=f,
        aspect=aspect,
        # A barrel that moves the corners by some 30 px, and a pincushion of as much at the long end.
        k1=(0.09 * (t - 0.5) * (f / 960) ** 2 * 0.35 if distortion else np.zeros(N)),
        pan_deg=171.0 + 20 * t,
        tilt_deg=-8.0 + 5 * t**2,
        roll_deg=0.7 - 1.5 * t,
    )
    w, h = made.size_px
    return replace(made, cx_px=(w - 1) / 2, cy_px=(h - 1) / 2) if centred else made
