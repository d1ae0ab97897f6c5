"""Radial distortion in half-width units: u_d = pp + d (1 + k1 rho^2 + k2 rho^4), d = u - pp, rho = |d| / (W / 2).

`k1_half` describes the picture, a few per cent at any focal; `k1_opencv` multiplies focal-normalised radii. Ideal to
observed is closed form, observed to ideal a scalar Newton iteration on the radius. NaN where the model folds over.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
NEWTON_STEPS = 6


def k1_to_opencv(k1_half: ArrayLike, f_px: ArrayLike, width_px: float) -> Array:
    """OpenCV's k1 of half-width k1 (...,): radii divided by f instead of W / 2."""
    return np.asarray(k1_half, float) * (2 * np.asarray(f_px, float) / width_px) ** 2


def k1_from_opencv(k1_opencv: ArrayLike, f_px: ArrayLike, width_px: float) -> Array:
    """Half-width k1 (...,) of OpenCV's k1. Inverse of `k1_to_opencv`."""
    return np.asarray(k1_opencv, float) / (2 * np.asarray(f_px, float) / width_px) ** 2


def undistorted_radius(rho_observed: ArrayLike, k1_half: ArrayLike, k2_half: ArrayLike = 0.0) -> Array:
    """Ideal radius rho with rho (1 + k1 rho^2 + k2 rho^4) = rho_observed, in half widths; NaN where none exists."""
    rho_d = np.asarray(rho_observed, float)
    k1, k2 = np.asarray(k1_half, float), np.asarray(k2_half, float)
    with np.errstate(over="ignore", invalid="ignore"):
        rho = rho_d / (1 + np.maximum(k1, -0.2) * np.minimum(rho_d, 2.0) ** 2)
        for _ in range(NEWTON_STEPS):
            r2 = rho * rho
            slope = 1 + r2 * (3 * k1 + 5 * k2 * r2)
            rho = rho - (rho * (1 + r2 * (k1 + k2 * r2)) - rho_d) / np.maximum(slope, 0.05)
        r2 = rho * rho
        valid = (1 + r2 * (3 * k1 + 5 * k2 * r2) > 0) & (rho >= 0)
        valid &= np.abs(rho * (1 + r2 * (k1 + k2 * r2)) - rho_d) <= 1e-9 * (1 + rho_d)
    return np.where(valid, rho, np.nan)


def distort(
    points_px: ArrayLike, pp_px: ArrayLike, k1_half: ArrayLike, width_px: float, k2_half: float = 0.0
) -> Array:
    """Ideal pixels (..., 2) to observed pixels; k1_half broadcasts over the leading axes. NaN where it folds."""
    pp = np.asarray(pp_px, float)
    d = np.asarray(points_px, float) - pp
    k1 = np.asarray(k1_half, float)[..., None]
    r2 = np.sum(d * d, -1, keepdims=True) / (width_px / 2) ** 2
    folded = 1 + r2 * (3 * k1 + 5 * k2_half * r2) <= 0
    return np.where(folded, np.nan, pp + d * (1 + r2 * (k1 + k2_half * r2)))


def undistort(
    points_px: ArrayLike, pp_px: ArrayLike, k1_half: ArrayLike, width_px: float, k2_half: float = 0.0
) -> Array:
    """Observed pixels (..., 2) to ideal pixels (..., 2). Inverse of `distort`; NaN outside the model's range."""
    d = np.asarray(points_px, float) - np.asarray(pp_px, float)
    rho_d = np.linalg.norm(d, axis=-1) / (width_px / 2)
    rho = undistorted_radius(rho_d, k1_half, k2_half)
    ratio = np.where(rho_d > 1e-12, rho / np.where(rho_d > 1e-12, rho_d, 1.0), 1.0)
    return np.asarray(pp_px, float) + d * ratio[..., None]


def is_invertible(k1_half: float, size_px: tuple[int, int], k2_half: float = 0.0) -> bool:
    """Whether the model is one to one up to the picture's corner (16:9, k2 = 0: k1_half > -0.25)."""
    rho = np.linspace(0, np.hypot(1.0, size_px[1] / size_px[0]), 65)
    return bool(np.all(1 + 3 * k1_half * rho**2 + 5 * k2_half * rho**4 > 0))
