"""Levelling: the pan axis of the tripod head from the track, so that tilt and panorama are level with the head.

Head model: R_cam_head = Rz(-rho) Rx(-tilt) Ry(-pan), rho the camera's constant roll on the head. It finds the head's
axis, not gravity; tilts alone do not reveal the reference tilt. Source: calibration.md 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import rotation
from calib.records import Level, Solution

Array = NDArray[np.float64]

SENTENCES = {
    "ok": "The pan axis of the head is known.",
    "head_axis_unobservable": "The camera did not pan enough to reveal the head's axis.",
    "not_a_pan_tilt_head": "The camera rolled by more than a pan-tilt head does.",
    "no_rotations": "There are no rotations to level.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelOptions:
    """Gate and weights of the levelling, radians.

    max_std_rad: of tilt and rho. rho_prior_rad: about 0. roll_floor_rad: a frame's roll error beyond its covariance
    (rolling shutter, parallax). max_residual_ratio: left-over roll over its sigma that no pan-tilt head shows.
    """

    max_std_rad: float = float(np.deg2rad(0.5))
    rho_prior_rad: float = float(np.deg2rad(3.0))
    roll_floor_rad: float = float(np.deg2rad(0.05))
    max_residual_ratio: float = 3.0


def _rx(t: Array | float) -> Array:
    return rotation.from_pan_tilt_roll(0.0, -np.asarray(t), 0.0)


def _rz(t: Array | float) -> Array:
    return rotation.from_pan_tilt_roll(0.0, 0.0, -np.asarray(t))


def _roll_residuals(R: Array, tau0: Array | float, rho: Array | float) -> Array:
    """Left-over roll (..., n) rad of R (n, 3, 3) relative to the reference, for head parameters (...)."""
    tau0, rho = np.asarray(tau0, float)[..., None], np.asarray(rho, float)[..., None]
    Q = _rz(rho) @ R @ _rz(-rho) @ _rx(-tau0)
    return np.arctan2(Q[..., 0, 1], Q[..., 1, 1])


def level(solution: Solution, options: LevelOptions | None = None) -> Level:
    """Tilt of the reference frame and the camera's roll on the head, with errors; NaN and a reason if not observable.

    solution: keyframes (many frames that share one keyframe's error would make the bars too small).
    """
    options = options or LevelOptions()
    row = solution.index(solution.reference)
    R = solution.R @ solution.R[row].T
    fine = np.isfinite(R).all((-1, -2)) & np.isfinite(solution.cov_rot).all((-1, -2))
    fine[row] = False
    if fine.sum() < 1:
        return _nothing("no_rotations")
    R, cov = R[fine], solution.cov_rot[fine]
    eps = 1e-6
    # Roll error of a frame: its rotation covariance along the roll direction, and a floor.
    turns = rotation.exp(eps * np.concatenate([np.eye(3), -np.eye(3)]))[:, None]
    shaken = _roll_residuals(turns @ R, 0.0, 0.0)
    gradient = (shaken[:3] - shaken[3:]).T / (2 * eps)
    variance = np.einsum("ni,nij,nj->n", gradient, cov, gradient) + options.roll_floor_rad**2
    weight = 1 / variance
    around = eps * np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    best: tuple[float, Array, Array] | None = None
    for start in np.deg2rad(np.arange(-60, 31, 15)):
        x = np.array([start, 0.0])
        normal = np.eye(2)
        for _ in range(30):
            e, up_0, up_1, down_0, down_1 = _roll_residuals(R, *(x + around).T)
            J = np.stack([up_0 - down_0, up_1 - down_1], -1) / (2 * eps)
            normal = (J * weight[:, None]).T @ J + np.diag([1e-6, 1 / options.rho_prior_rad**2])
            right = -(J * weight[:, None]).T @ e - np.array([0.0, x[1] / options.rho_prior_rad**2])
            step = np.linalg.solve(normal, right)
            step = step / max(1.0, float(np.abs(step).max()) / 0.3)
            x = x + step
            if step @ normal @ step < 1e-8:
                break
        e = _roll_residuals(R, x[0], x[1])
        cost = float(np.sum(weight * e**2) + (x[1] / options.rho_prior_rad) ** 2)
        if abs(x[0]) < np.pi / 2 and (best is None or cost < best[0] - 1e-9):
            best = (cost, x, normal)
    if best is None:
        return _nothing("head_axis_unobservable")
    _, x, normal = best
    e = _roll_residuals(R, x[0], x[1])
    ratio = float(np.sqrt(np.mean(e**2 * weight)))
    std = np.sqrt(np.diagonal(np.linalg.inv(normal))) * max(1.0, ratio)
    if std[0] > options.max_std_rad:
        return _nothing(
            "head_axis_unobservable", x, std, ratio, rho_known=bool(std[1] <= options.max_std_rad)
        )
    if ratio > options.max_residual_ratio:
        return _nothing("not_a_pan_tilt_head", x, std, ratio)
    head_world = (_rz(-x[1]) @ _rx(-x[0])).T @ solution.R[row]
    return Level(
        tilt0_rad=float(x[0]), rho_rad=float(x[1]), tilt0_std_rad=float(std[0]), rho_std_rad=float(std[1]),
        observable=True, reason="ok", sentence=SENTENCES["ok"], R_head_world=head_world, residual_ratio=ratio,
    )  # fmt: skip


def _nothing(
    reason: str,
    x: Array | None = None,
    std: Array | None = None,
    ratio: float = float("nan"),
    rho_known: bool = False,
) -> Level:
    nan = float("nan")
    return Level(
        tilt0_rad=nan, rho_rad=float(x[1]) if rho_known and x is not None else nan,
        tilt0_std_rad=nan if std is None else float(std[0]), rho_std_rad=nan if std is None else float(std[1]),
        observable=False, reason=reason, sentence=SENTENCES[reason], R_head_world=np.full((3, 3), nan),
        residual_ratio=ratio,
    )  # fmt: skip
