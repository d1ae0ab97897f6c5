"""A ball's flight from its pixels: with the camera's place on the pitch known, gravity gives the depth that one camera
lacks. A parabola, no drag, no spin: a flight of a second or two; a long one is bent by the air, and chi2_dof says so.

Position and velocity at the first time, metres and seconds in the pitch frame of `calib.pitch` (Z up), and their
covariance, with the pitch camera's own error in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from calib.pitch import STEPS, PitchCamera, TrackCamera, derivative_of
from calib.rotation import skew

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
MIN_VIEWS = 4
BALL_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flight:
    """position_m, velocity_m_s (3,) at time_s; cov (6, 6) of both. camera: the pitch camera that fits best
    with the flight.

    residual_px (n, 2); chi2_dof: about 1 where the ball flew on a parabola and was seen as well as stated.
    """

    time_s: float
    position_m: Array
    velocity_m_s: Array
    cov: Array
    camera: PitchCamera
    residual_px: Array
    chi2_dof: float

    def at(self, times_s: ArrayLike) -> Array:
        """Positions (..., 3) at times."""
        t = np.asarray(times_s, np.float64)[..., None] - self.time_s
        return self.position_m + self.velocity_m_s * t + np.array([0, 0, -GRAVITY_M_S2 / 2]) * t**2

    def at_cov(self, times_s: ArrayLike) -> Array:
        """Covariance (..., 3, 3) of `at`."""
        t = np.asarray(times_s, np.float64)[..., None, None] - self.time_s
        J = np.concatenate([np.broadcast_to(np.eye(3), (*t.shape[:-2], 3, 3)), t * np.eye(3)], axis=-1)
        return J @ self.cov @ np.swapaxes(J, -1, -2)

    def landing(self, height_m: float = 0.11) -> tuple[float, Array, Array]:
        """Time (s), point (2,) and its covariance (2, 2) where the ball comes down to height_m (a football's radius).

        NaN where it never is that high.
        """
        x = np.concatenate([self.position_m, self.velocity_m_s])
        point = _landing(x, height_m)
        J = derivative_of(lambda v: _landing(v, height_m), x, BALL_STEPS)
        return float(self.time_s + point[2]), point[:2], J[:2] @ self.cov @ J[:2].T


def _landing(x: Array, height_m: float) -> Array:
    """X, Y and the time after the first one, of coming down to a height."""
    under = x[5] ** 2 + 2 * GRAVITY_M_S2 * (x[2] - height_m)
    t = (x[5] + np.sqrt(under)) / GRAVITY_M_S2 if under >= 0 else np.nan
    return np.array([x[0] + x[3] * t, x[1] + x[4] * t, t])


def fit_flight(
    camera: PitchCamera,
    track: TrackCamera,
    times_s: ArrayLike,
    xy_px: ArrayLike,
    *,
    pixel_std: float = 1.0,
) -> Flight:
    """The flight of a ball seen at pixels (n, 2) at times (n,); track: the camera of each picture.

    The pitch camera moves along within its own covariance, so that its error is in the flight's. Raises ValueError:
    fewer than four views, times that do not differ, shapes.
    """
    t, xy = np.asarray(times_s, np.float64), np.asarray(xy_px, np.float64)
    n = len(track)
    if t.shape != (n,) or xy.shape != (n, 2):
        raise ValueError(f"times {t.shape} and pixels {xy.shape} do not go with {n} cameras")
    if n < MIN_VIEWS or np.ptp(t) <= 0:
        raise ValueError(
            f"{n} views over {np.ptp(t) if n else 0:g} s: at least {MIN_VIEWS} at different times"
        )
    first = float(t.min())
    since = t - first
    start = _linear_start(camera, track, since, xy)
    fall = np.array([0.0, 0.0, -GRAVITY_M_S2 / 2]) * since[:, None] ** 2
    # A whitening of the camera's covariance: cov = L L^T, change = L z with z ~ N(0, 1).
    L = np.linalg.cholesky(camera.cov / np.outer(STEPS, STEPS)) * STEPS[:, None]

    def residuals(x: Array) -> Array:
        ball = x[:3] + x[3:6] * since[:, None] + fall
        away = (camera.moved(L @ x[6:]).project(track, ball) - xy) / pixel_std
        return np.concatenate([np.where(np.isfinite(away), away, 1e6).ravel(), x[6:]])

    x0 = np.concatenate([start, np.zeros(7)])
    scale = np.concatenate([np.full(6, 1.0), np.full(7, 1.0)])
    found = least_squares(residuals, x0, x_scale=scale, jac="3-point", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    steps = np.concatenate([BALL_STEPS, np.full(7, 1e-3)])
    J = derivative_of(residuals, found.x, steps)
    cov = np.asarray(np.linalg.inv(J.T @ J), np.float64)
    best = camera.moved(L @ found.x[6:])
    ball = found.x[:3] + found.x[3:6] * since[:, None] + fall
    return Flight(
        time_s=first,
        position_m=found.x[:3],
        velocity_m_s=found.x[3:6],
        cov=cov[:6, :6],
        camera=best,
        residual_px=best.project(track, ball) - xy,
        chi2_dof=float(np.sum(found.fun**2)) / (2 * n - 6) if n > 3 else float("nan"),
    )


def _linear_start(camera: PitchCamera, track: TrackCamera, since_s: Array, xy: Array) -> Array:
    """Position and velocity (6,) from d x (p + v t + g t^2 / 2 - C) = 0, which is linear in both."""
    d = camera.directions(track, xy)
    if not np.isfinite(d).all():
        raise ValueError("a pixel lies outside the lens model")
    cross = skew(d)
    A = np.concatenate([cross, cross * since_s[:, None, None]], axis=-1).reshape(-1, 6)
    fall = np.array([0.0, 0.0, -GRAVITY_M_S2 / 2]) * since_s[:, None] ** 2
    b = np.einsum("nij,nj->ni", cross, camera.position_m - fall).ravel()
    solution: Array = np.linalg.lstsq(A, b, rcond=None)[0]
    return solution
