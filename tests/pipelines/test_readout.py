"""The warp of two cameras that turn while their rows are read, against rows that are each taken at their own moment."""

from __future__ import annotations

import numpy as np

from calib import rotation
from calib.records import Lens
from pipelines.bridge import CameraPose, Rolling, RollingFamily, RotationZoomFamily, pair_state

SIZE = (1280, 720)
LENS = Lens(size_px=SIZE, pp_px=np.array([641.0, 357.0]), c0=0.04, c1=-0.015)
RATE_A = np.array([0.004, 0.001, 0.012, -0.0005])  # change of log f and left rotation a frame: 20 px
RATE_B = np.array([-0.002, -0.002, -0.006, 0.0])
SHARE = 0.6


def _pose(start: CameraPose, rate: np.ndarray, rows: np.ndarray) -> CameraPose:
    """The camera when a row is read, frames being 1 apart; the middle row's is `start`."""
    late = SHARE * ((rows + 0.5) / SIZE[1] - 0.5)
    return CameraPose(log_f=start.log_f + late * rate[0], R=rotation.exp(late[:, None] * rate[1:]) @ start.R)


def _exact(a: CameraPose, b: CameraPose, points: np.ndarray) -> np.ndarray:
    at = _pose(a, RATE_A, points[:, 1])
    ideal = LENS.undistort(points, at.log_f)
    rays = np.linalg.inv(LENS.K(at.log_f)) @ np.concatenate([ideal, np.ones((len(ideal), 1))], 1)[..., None]
    world = np.swapaxes(at.R, 1, 2) @ rays
    there = points
    for _ in range(10):
        seen = _pose(b, RATE_B, there[:, 1])
        w = (LENS.K(seen.log_f) @ seen.R @ world)[..., 0]
        there = LENS.distort(w[:, :2] / w[:, 2:], seen.log_f)
    return there


def test_the_warp_puts_points_where_their_rows_see_them():
    a = CameraPose(log_f=float(np.log(1700)), R=rotation.from_pan_tilt_roll(0.0, -0.1, 0.0))
    b = CameraPose(log_f=float(np.log(1800)), R=rotation.from_pan_tilt_roll(0.08, -0.12, 0.005))
    x, y = np.meshgrid(np.linspace(150, 1270, 8), np.linspace(10, 700, 7))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    plain = RotationZoomFamily(lens=LENS, log_f_src=a.log_f)
    rolling = RollingFamily(base=plain, share=SHARE, rate_src=RATE_A, rate_dst=RATE_B)
    truth = _exact(a, b, points)
    errors = []
    for family in (plain, rolling):
        where, J, A = family.warp(pair_state(a, b), family.prepare(points))
        assert J.shape == (len(points), 2, 4) and A.shape == (len(points), 2, 2)
        errors.append(np.linalg.norm(where - truth, axis=1))
    assert errors[0].max() > 4.0
    assert errors[1].max() < 0.15 and np.median(errors[1]) < 0.05


def test_frames_without_known_motion_are_taken_to_stand_still():
    rolling = Rolling(share=SHARE, rates={3: RATE_A})
    plain = RotationZoomFamily(lens=LENS, log_f_src=7.4)
    known, unknown = rolling.family(plain, 3), rolling.family(plain, 4)
    assert isinstance(known, RollingFamily) and isinstance(unknown, RollingFamily)
    np.testing.assert_array_equal(known.rate_src, RATE_A)
    points = np.array([[100.0, 50.0], [900.0, 650.0]])
    np.testing.assert_allclose(unknown.prepare(points)[0], plain.prepare(points)[0], atol=1e-12)
