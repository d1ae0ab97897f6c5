"""From rays of a turning camera to metres on a flat pitch: where the camera stands, and what its clicks are worth.

The pitch is the plane Z = 0 of a right-handed frame in metres: X along it to the right, Y away from the camera's side,
Z up. The pitch camera adds to a camera track its position, its axes, and one correction of the track's focal length,
which is common to all frames because the track's own error is: it is held by that error, and the points may improve it.

Pixels are modelled through `TrackCamera`, one per point. Error bars are those of the linearised maximum a posteriori
estimate; they hold while the clicks' errors are independent and as large as stated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from calib import rotation
from calib.distortion import undistorted_radius

Array = NDArray[np.float64]

N_PARAMETERS = 7  # position (3), left rotation of the axes (3), log focal correction (1)
FLAT = 1e-6  # relative singular value below which points do not fix the plane
STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6])  # of central differences: m, rad, log


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackCamera:
    """Cameras of a track, n of them: f_px (fx), aspect fx / fy, k1 (OpenCV's), pp_px (n, 2), R_cam_world (n, 3, 3).

    R_ref_world (3, 3): axes of the frame that the track's angles are relative to. When the focal length is corrected,
    angles between frames shrink as it grows: what a pair of pictures fixes is their product.
    """

    f_px: Array
    aspect: Array
    k1: Array
    pp_px: Array
    R_cam_world: Array
    R_ref_world: Array

    def __len__(self) -> int:
        return len(self.f_px)

    def taken(self, rows: Any) -> TrackCamera:
        """The cameras of some rows, repeated as often as they are named."""
        return TrackCamera(
            f_px=self.f_px[rows], aspect=self.aspect[rows], k1=self.k1[rows], pp_px=self.pp_px[rows],
            R_cam_world=self.R_cam_world[rows], R_ref_world=self.R_ref_world,
        )  # fmt: skip

    def corrected(self, log_focal: float) -> TrackCamera:
        """The track with its focal lengths multiplied by exp(log_focal); lens distortion stays the same in pixels."""
        factor = float(np.exp(log_focal))
        turned = rotation.log(self.R_cam_world @ self.R_ref_world.T) / factor
        return TrackCamera(
            f_px=self.f_px * factor, aspect=self.aspect, k1=self.k1 * factor**2, pp_px=self.pp_px,
            R_cam_world=rotation.exp(turned) @ self.R_ref_world, R_ref_world=self.R_ref_world,
        )  # fmt: skip

    def rays(self, xy_px: ArrayLike) -> Array:
        """Unit directions (n, 3) in world axes of pixels (n, 2), one per camera; NaN outside the lens model."""
        d = np.asarray(xy_px, np.float64) - self.pp_px
        x, y = d[:, 0] / self.f_px, d[:, 1] * self.aspect / self.f_px
        radius = np.hypot(x, y)
        with np.errstate(invalid="ignore", divide="ignore"):
            stretch = np.where(radius > 0, undistorted_radius(radius, self.k1) / radius, 1.0)
        camera = np.stack([x * stretch, y * stretch, np.ones_like(x)], axis=-1)
        world = np.einsum("nji,nj->ni", self.R_cam_world, camera)
        return world / np.linalg.norm(world, axis=-1, keepdims=True)

    def pixels(self, rays: ArrayLike) -> Array:
        """Pixels (n, 2) of directions (n, 3), one per camera; NaN behind it or where the lens model folds."""
        camera = np.einsum("nij,nj->ni", self.R_cam_world, np.asarray(rays, np.float64))
        with np.errstate(invalid="ignore", divide="ignore"):
            q = camera[:, :2] / np.where(camera[:, 2:] > 0, camera[:, 2:], np.nan)
            r2 = (q**2).sum(axis=-1)
            bend = np.where(1 + 3 * self.k1 * r2 > 0, 1 + self.k1 * r2, np.nan)
        return self.pp_px + q * bend[:, None] * np.stack([self.f_px, self.f_px / self.aspect], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PitchCamera:
    """Where a track's camera stands: position_m (3,), R_pitch_world (3, 3), log_focal.

    cov (7, 7) is of a small change of (position, left rotation vector, log_focal). residual_px (n, 2) of the clicks;
    chi2_dof, NaN without redundancy.
    """

    position_m: Array
    R_pitch_world: Array
    log_focal: float
    cov: Array
    residual_px: Array
    chi2_dof: float

    def moved(self, change: ArrayLike) -> PitchCamera:
        """The camera after a small change (7,)."""
        d = np.asarray(change, np.float64)
        return PitchCamera(
            position_m=self.position_m + d[:3], R_pitch_world=rotation.exp(d[3:6]) @ self.R_pitch_world,
            log_focal=self.log_focal + float(d[6]), cov=self.cov, residual_px=self.residual_px, chi2_dof=self.chi2_dof,
        )  # fmt: skip

    def directions(self, track: TrackCamera, xy_px: ArrayLike) -> Array:
        """Unit directions (n, 3) in pitch axes of pixels (n, 2)."""
        return track.corrected(self.log_focal).rays(xy_px) @ self.R_pitch_world.T

    def project(self, track: TrackCamera, points_m: ArrayLike) -> Array:
        """Pixels (n, 2) of points (n, 3) in the pitch frame, one per camera of the track."""
        away = np.asarray(points_m, np.float64) - self.position_m
        return track.corrected(self.log_focal).pixels(away @ self.R_pitch_world)

    def on_plane(self, track: TrackCamera, xy_px: ArrayLike, height_m: float = 0.0) -> Array:
        """Points (n, 2) at height_m above the pitch where pixels (n, 2) look; NaN at and above the horizon."""
        d = self.directions(track, xy_px)
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.where(d[:, 2] < 0, (height_m - self.position_m[2]) / d[:, 2], np.nan)
        return self.position_m[:2] + along[:, None] * d[:, :2]

    def on_plane_cov(
        self, track: TrackCamera, xy_px: ArrayLike, pixel_std: float, height_m: float = 0.0
    ) -> Array:
        """Covariance (n, 2, 2), m^2, of `on_plane`: this camera's error and pixel_std (px) of the pixel itself."""
        xy = np.asarray(xy_px, np.float64)
        by_camera = derivative(lambda c: c.on_plane(track, xy, height_m), self)
        half = 0.01
        by_pixel = np.stack(
            [
                (self.on_plane(track, xy + step, height_m) - self.on_plane(track, xy - step, height_m))
                / (2 * half)
                for step in half * np.eye(2)
            ],
            axis=-1,
        )
        return by_camera @ self.cov @ np.swapaxes(by_camera, -1, -2) + pixel_std**2 * (
            by_pixel @ np.swapaxes(by_pixel, -1, -2)
        )


def derivative(function: Callable[[PitchCamera], Array], camera: PitchCamera) -> Array:
    """Central differences (..., 7) of a function of the camera."""
    columns = [
        (function(camera.moved(step)) - function(camera.moved(-step))) / (2 * size)
        for step, size in zip(np.diag(STEPS), STEPS, strict=True)
    ]
    return np.stack(columns, axis=-1)


def fit_pitch_camera(
    track: TrackCamera,
    xy_px: ArrayLike,
    points_m: ArrayLike,
    *,
    click_std_px: float = 1.0,
    log_focal_std: float = 0.02,
    position_m: ArrayLike | None = None,
    position_std_m: float = 0.0,
) -> PitchCamera:
    """The camera that sees points of the pitch (n, 2) in m at pixels (n, 2); track: the camera of each point.

    At least four points, no three of the four corners they span in one line; two where position_m (3,) is known, with
    position_std_m its error. click_std_px: one-sigma error of a click, log_focal_std: of the track's focal lengths
    (relative). Raises ValueError: too few points, points in one line, a point above the camera's horizon, shapes.
    """
    xy, plane = np.asarray(xy_px, np.float64), np.asarray(points_m, np.float64)
    n = len(track)
    if xy.shape != (n, 2) or plane.shape != (n, 2):
        raise ValueError(f"pixels {xy.shape} and points {plane.shape} do not go with {n} cameras")
    needed = 4 if position_m is None else 2
    if n < needed:
        raise ValueError(f"{n} {'point' if n == 1 else 'points'}, {needed} are needed")
    if not (click_std_px > 0 and log_focal_std > 0):
        raise ValueError("errors of clicks and focal length must be positive")
    points = np.concatenate([plane, np.zeros((n, 1))], axis=1)
    rays = track.rays(xy)
    if not np.isfinite(rays).all():
        raise ValueError("a pixel lies outside the lens model")
    known = None if position_m is None else np.asarray(position_m, np.float64)
    start_position, start_R = (
        _from_plane(rays, plane) if known is None else (known, _towards(rays, points - known))
    )
    start = PitchCamera(
        position_m=start_position, R_pitch_world=start_R, log_focal=0.0, cov=np.full((7, 7), np.nan),
        residual_px=np.full((n, 2), np.nan), chi2_dof=np.nan,
    )  # fmt: skip
    tied = max(position_std_m, 1e-6)

    def residuals(change: Array) -> Array:
        camera = start.moved(change)
        away = (camera.project(track, points) - xy) / click_std_px
        # Behind the camera there is no pixel: far away, so that the step is not taken.
        away = np.where(np.isfinite(away), away, 1e6)
        parts: list[Array] = [away.ravel(), np.array([camera.log_focal / log_focal_std])]
        if known is not None:
            parts.append((camera.position_m - known) / tied)
        return np.concatenate(parts)

    scale = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 0.01])
    found = least_squares(
        residuals, np.zeros(7), x_scale=scale, jac="3-point", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    best = start.moved(found.x)
    # The information at the end, in units in which its parts are alike.
    J = derivative_of(residuals, found.x) * scale
    information = J.T @ J
    if np.linalg.cond(information) > 1e14:
        raise ValueError("the points do not fix the camera: take some that are not in one line")
    cov = np.linalg.inv(information) * np.outer(scale, scale)
    residual = best.project(track, points) - xy
    dof = 2 * n + 1 + (3 if known is not None else 0) - N_PARAMETERS
    chi2 = float(np.sum(found.fun**2)) / dof if dof > 0 else float("nan")
    return PitchCamera(
        position_m=best.position_m, R_pitch_world=best.R_pitch_world, log_focal=best.log_focal, cov=cov,
        residual_px=residual, chi2_dof=chi2,
    )  # fmt: skip


def derivative_of(function: Callable[[Array], Array], at: Array, steps: Array = STEPS) -> Array:
    """Central differences (m, k) of a function (k,) -> (m,)."""
    columns = [
        (function(at + step) - function(at - step)) / (2 * size)
        for step, size in zip(np.diag(steps), steps, strict=True)
    ]
    return np.stack(columns, axis=-1)


def _from_plane(rays: Array, plane: Array) -> tuple[Array, Array]:
    """Position and R_pitch_world from the homography plane -> ray (DLT): its columns are two axes and the origin."""
    centre, size = plane.mean(axis=0), max(float(np.abs(plane - plane.mean(axis=0)).max()), 1e-9)
    p = np.concatenate([(plane - centre) / size, np.ones((len(plane), 1))], axis=1)
    # ray x (H p) = 0: two independent rows of three, all of them taken.
    cross = rotation.skew(rays)
    A = (cross[:, :, :, None] * p[:, None, None, :]).reshape(-1, 9)
    _, singular, Vt = np.linalg.svd(A)
    if singular[7] < FLAT * singular[0]:
        raise ValueError("the points do not fix the pitch plane: no four of them in general position")
    H = Vt[-1].reshape(3, 3)
    if np.sum((p @ H.T) * rays) < 0:
        H = -H
    if (np.sum((p @ H.T) * rays, axis=1) <= 0).any():
        raise ValueError("a point would lie behind the camera: check the points' order and signs")
    H = H @ np.diag([1 / size, 1 / size, 1.0])
    scale = np.linalg.norm(H[:, :2], axis=0).mean()
    axes = H[:, :2] / scale
    R_world_pitch = rotation.project_so3(np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])]))
    position = -R_world_pitch.T @ (H[:, 2] / scale) + [*centre, 0.0]
    if position[2] <= 0:
        raise ValueError("the camera would stand below the pitch: X and Y of the points are mirrored")
    return position, R_world_pitch.T


def _towards(rays: Array, away: Array) -> Array:
    """R_pitch_world that turns rays (n, 3) towards `away` (n, 3) in pitch axes, least squares."""
    return rotation.project_so3((away / np.linalg.norm(away, axis=1, keepdims=True)).T @ rays)
