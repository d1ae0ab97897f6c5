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


def fold_square(k1_half: ArrayLike, k2_half: ArrayLike = 0.0) -> Array:
    """Square of the ideal radius, half widths, up to which the model is one to one; inf where it never folds.

    The first zero of 1 + 3 k1 x + 5 k2 x^2 in x = rho^2: beyond it radii come back, and a second branch may follow.
    """
    k1, k2 = np.asarray(k1_half, float), np.asarray(k2_half, float)
    with np.errstate(invalid="ignore", divide="ignore"):
        # In this form of the root no small k2 stands in a denominator.
        inverse = -3 * k1 + np.sqrt(9 * k1 * k1 - 20 * k2)
        return np.where(inverse > 0, 2 / inverse, np.inf)


def undistorted_radius(rho_observed: ArrayLike, k1_half: ArrayLike, k2_half: ArrayLike = 0.0) -> Array:
    """Ideal radius rho with rho (1 + k1 rho^2 + k2 rho^4) = rho_observed, in half widths; NaN where none exists."""
    rho_d = np.asarray(rho_observed, float)
    k1, k2 = np.asarray(k1_half, float), np.asarray(k2_half, float)
    with np.errstate(over="ignore", invalid="ignore"):
        r2 = np.square(np.minimum(rho_d, 2.0))
        rho = rho_d / (1 + np.maximum(k1 + k2 * r2, -0.2) * r2)
        one = not np.any(k2)  # the usual lens, and half the arithmetic
        for _ in range(NEWTON_STEPS):
            r2 = rho * rho
            bend = k1 * r2 if one else (k1 + k2 * r2) * r2
            slope = 1 + 3 * bend if one else 1 + r2 * (3 * k1 + 5 * k2 * r2)
            step = (rho * (1 + bend) - rho_d) / np.maximum(slope, 0.05)
            rho = rho - step
            # Newton's error is about squared by a step: after one this small, the next would be below rounding.
            if np.abs(step).max(initial=0.0) < 1e-9:
                break
        r2 = rho * rho
        bend = k1 * r2 if one else (k1 + k2 * r2) * r2
        valid = (1 + 3 * bend > 0 if one else r2 < fold_square(k1, k2)) & (rho >= 0)
        valid &= np.abs(rho * (1 + bend) - rho_d) <= 1e-9 * (1 + rho_d)
    return rho if valid.all() else np.where(valid, rho, np.nan)


def distort(
    points_px: ArrayLike, pp_px: ArrayLike, k1_half: ArrayLike, width_px: float, k2_half: float = 0.0
) -> Array:
    """Ideal pixels (..., 2) to observed pixels; k1_half broadcasts over the leading axes. NaN where it folds."""
    pp = np.asarray(pp_px, float)
    d = np.asarray(points_px, float) - pp
    k1 = np.asarray(k1_half, float)[..., None]
    r2 = np.sum(d * d, -1, keepdims=True) / (width_px / 2) ** 2
    folded = r2 >= fold_square(k1, k2_half)
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
    return bool(1 + (size_px[1] / size_px[0]) ** 2 < fold_square(k1_half, k2_half))
