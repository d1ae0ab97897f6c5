"""Cameras of known parameters: the truth that every accuracy test of the project rests on.

Own implementation, it imports nothing of calib. World = head axes: x right, y down (the pan axis), z forward at pan 0.
R_cam_world = Rz(-roll) Rx(-tilt) Ry(-pan). Pixel (0, 0) is the centre of the top-left pixel. Half-width distortion:
u_d = pp + d (1 + k1_half rho^2), rho = |d| / (W/2), d = ideal pixel - pp. Does not know any image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Newton converges quadratically from rho_d for |k| <= .15; eight steps reach round-off at the corner.
_NEWTON_STEPS = 8


def rotation_cam_world(pan_rad: float, tilt_rad: float, roll_rad: float) -> Array:
    """World axes -> camera axes (3, 3): Rz(-roll) Rx(-tilt) Ry(-pan); pan right, tilt up, roll clockwise positive."""
    cp, sp = np.cos(-pan_rad), np.sin(-pan_rad)
    ct, st = np.cos(-tilt_rad), np.sin(-tilt_rad)
    cr, sr = np.cos(-roll_rad), np.sin(-roll_rad)
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1.0]])
    return about_z @ about_x @ about_y


def distort_radius(rho: Array, k1_half: float) -> Array:
    """Observed radius of an ideal one, both in half widths; NaN past the fold of a barrel distortion."""
    slope = 1 + 3 * k1_half * rho**2
    return np.where(slope > 0, rho * (1 + k1_half * rho**2), np.nan)


def undistort_radius(rho_d: Array, k1_half: float) -> Array:
    """Ideal radius of an observed one, both in half widths; NaN where no ideal radius exists."""
    rho = np.asarray(rho_d, dtype=np.float64).copy()
    if k1_half == 0:
        return rho
    if k1_half < 0:  # the image radius has a maximum at the fold
        fold = np.sqrt(-1 / (3 * k1_half))
        rho[rho >= fold * (1 + k1_half * fold**2)] = np.nan
    for _ in range(_NEWTON_STEPS):
        rho -= (rho * (1 + k1_half * rho**2) - rho_d) / (1 + 3 * k1_half * rho**2)
    return rho


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthCamera:
    """One frame's camera. f_px is fx; aspect = fx / fy; cx_px, cy_px the principal point; pupil_m how far the entrance
    pupil lies in front of the pan axis, along the optical axis (metres, 0 = pure rotation)."""

    width: int
    height: int
    f_px: float
    pan_rad: float = 0.0
    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    cx_px: float
    cy_px: float
    k1_half: float = 0.0
    aspect: float = 1.0
    pupil_m: float = 0.0

    @property
    def R_cam_world(self) -> Array:
        return rotation_cam_world(self.pan_rad, self.tilt_rad, self.roll_rad)

    @property
    def K(self) -> Array:
        """Calibration matrix (3, 3): camera axes -> ideal pixels."""
        return np.array([[self.f_px, 0, self.cx_px], [0, self.f_px / self.aspect, self.cy_px], [0, 0, 1.0]])

    @property
    def k1_opencv(self) -> float:
        """k1_half in OpenCV's focal-normalised convention: r_d = r_u (1 + k1 r_u^2), r in units of f."""
        return self.k1_half * (2 * self.f_px / self.width) ** 2

    @property
    def pupil_world_m(self) -> Array:
        """Where the entrance pupil is (3,), metres from the pan axis, world axes."""
        return self.R_cam_world[2] * self.pupil_m

    def distort(self, ideal_px: Array) -> Array:
        """Ideal (pinhole) pixels (..., 2) -> observed pixels (..., 2)."""
        pp = np.array([self.cx_px, self.cy_px])
        d = np.asarray(ideal_px, dtype=np.float64) - pp
        rho = np.hypot(d[..., 0], d[..., 1]) / (self.width / 2)
        rho_d = distort_radius(rho, self.k1_half)
        return pp + d * np.where(rho > 0, rho_d / np.where(rho > 0, rho, 1), 1)[..., None]

    def undistort(self, observed_px: Array) -> Array:
        """Observed pixels (..., 2) -> ideal (pinhole) pixels (..., 2)."""
        pp = np.array([self.cx_px, self.cy_px])
        d = np.asarray(observed_px, dtype=np.float64) - pp
        rho_d = np.hypot(d[..., 0], d[..., 1]) / (self.width / 2)
        rho = undistort_radius(rho_d, self.k1_half)
        return pp + d * np.where(rho_d > 0, rho / np.where(rho_d > 0, rho_d, 1), 1)[..., None]

    def pixel_to_ray(self, observed_px: Array) -> Array:
        """Observed pixels (..., 2) -> unit directions (..., 3) in world axes, from the pupil."""
        ideal = self.undistort(observed_px)
        x = (ideal[..., 0] - self.cx_px) / self.f_px
        y = (ideal[..., 1] - self.cy_px) * self.aspect / self.f_px
        ray = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.R_cam_world
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def ray_to_pixel(self, rays: Array) -> Array:
        """Directions (..., 3) in world axes -> observed pixels (..., 2); NaN behind the camera or past the fold."""
        cam = np.asarray(rays, dtype=np.float64) @ self.R_cam_world.T
        z = np.where(cam[..., 2] > 1e-9, cam[..., 2], np.nan)
        x = self.cx_px + self.f_px * cam[..., 0] / z
        y = self.cy_px + self.f_px / self.aspect * cam[..., 1] / z
        return self.distort(np.stack([x, y], axis=-1))

    def point_to_pixel(self, points_m: Array) -> Array:
        """Points (..., 3), metres from the pan axis in world axes -> observed pixels, seen from the pupil."""
        return self.ray_to_pixel(np.asarray(points_m, dtype=np.float64) - self.pupil_world_m)


def pixel_grid(width: int, height: int, step: int = 1) -> Array:
    """(ceil(h/step), ceil(w/step), 2) pixel coordinates (x, y)."""
    x, y = np.meshgrid(
        np.arange(0, width, step, dtype=np.float64), np.arange(0, height, step, dtype=np.float64)
    )
    return np.stack([x, y], axis=-1)
