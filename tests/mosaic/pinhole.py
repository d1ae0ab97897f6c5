"""A pinhole camera with one radial coefficient, as a Placement: the mosaic tests' own, independent of calib."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def rotation(pan_rad, tilt_rad, roll_rad):
    """R = Rz(-roll) Rx(-tilt) Ry(-pan), world axes to camera axes."""
    (cp, sp), (ct, st), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (-pan_rad, -tilt_rad, -roll_rad))
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rx = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    rz = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return rz @ rx @ ry


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """k1 is OpenCV's. Angles in degrees."""

    frame: int = 0
    size_px: tuple[int, int] = (320, 180)
    f_px: float = 400.0
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    k1: float = 0.0
    blur_px: float = 0.0

    @property
    def px_per_rad(self):
        return self.f_px

    @property
    def centre(self):
        return (np.array(self.size_px) - 1) / 2

    @property
    def R(self):
        return rotation(*np.radians([self.pan_deg, self.tilt_deg, self.roll_deg]))

    def ray_to_pixel(self, rays):
        cam = np.asarray(rays, dtype=np.float64) @ self.R.T
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.where(cam[..., 2:] > 0, cam[..., :2] / cam[..., 2:], np.nan)
            r2 = (u**2).sum(axis=-1, keepdims=True)
            u = np.where(1 + 3 * self.k1 * r2 > 0, u * (1 + self.k1 * r2), np.nan)
        return u * self.f_px + self.centre

    def pixel_to_ray(self, xy):
        d = (np.asarray(xy, dtype=np.float64) - self.centre) / self.f_px
        u = d.copy()
        for _ in range(60 if self.k1 else 0):
            u = d / (1 + self.k1 * (u**2).sum(axis=-1, keepdims=True))
        ray = np.concatenate([u, np.ones_like(u[..., :1])], axis=-1)
        return (ray / np.linalg.norm(ray, axis=-1, keepdims=True)) @ self.R


def sweep(pans_deg, n, **values):
    """n placements panning evenly from pans_deg[0] to pans_deg[1]."""
    return [Pinhole(frame=k, pan_deg=float(p), **values) for k, p in enumerate(np.linspace(*pans_deg, n))]
