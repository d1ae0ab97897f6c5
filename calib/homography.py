"""Homographies: gauge (det 1), application to points, inverse, and the four-anchor chart. No estimation: see dlt.py."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def normalise(H: ArrayLike) -> Array:
    """H (..., 3, 3) scaled to det 1 (real cube root, so a negative determinant changes H's sign too).

    NaN where H is singular or not finite. Points visible in both views then have a positive third coordinate in both.
    """
    H = np.asarray(H, float)
    with np.errstate(all="ignore"):
        # Scale to unit norm first: pixel homographies reach 1e3 and their determinants would lose nothing but looks.
        unit = H / np.linalg.norm(H, axis=(-1, -2), keepdims=True)
        det = np.linalg.det(np.where(np.isfinite(unit), unit, 0.0))
        det = np.where(np.abs(det) > 1e-300, det, np.nan)
        return unit / np.cbrt(det)[..., None, None]


def apply(H: ArrayLike, points_px: ArrayLike) -> Array:
    """Points (..., m, 2) mapped by H (..., 3, 3); NaN where the third coordinate is not positive (H of det 1)."""
    H, points = np.asarray(H, float), np.asarray(points_px, float)
    w = points @ np.swapaxes(H[..., :2], -1, -2) + H[..., None, :, 2]
    with np.errstate(all="ignore"):
        return np.where(w[..., 2:] > 0, w[..., :2] / w[..., 2:], np.nan)


def invert(H: ArrayLike) -> Array:
    """Inverse, det 1: H_a_b of H_b_a."""
    return normalise(np.linalg.inv(np.asarray(H, float)))


def from_anchors(anchors_src_px: ArrayLike, anchors_dst_px: ArrayLike) -> Array:
    """H_dst_src (..., 3, 3), det 1, that maps four points (..., 4, 2) exactly onto four points. NaN if degenerate."""
    src, dst = np.broadcast_arrays(np.asarray(anchors_src_px, float), np.asarray(anchors_dst_px, float))
    centre, spread = (
        src.mean((-2,), keepdims=True),
        np.abs(src - src.mean((-2,), keepdims=True)).max((-1, -2)),
    )
    spread = spread[..., None, None]
    x, u = (src - centre) / spread, (dst - centre) / spread
    rows = np.zeros((*src.shape[:-2], 8, 8))
    rows[..., 0::2, 0:2], rows[..., 0::2, 2] = x, 1
    rows[..., 1::2, 3:5], rows[..., 1::2, 5] = x, 1
    rows[..., 0::2, 6:8], rows[..., 1::2, 6:8] = -x * u[..., :1], -x * u[..., 1:]
    right = u.reshape(*u.shape[:-2], 8, 1)
    try:
        h = np.linalg.solve(rows, right)[..., 0]
    except np.linalg.LinAlgError:
        return np.full((*src.shape[:-2], 3, 3), np.nan)
    unit = np.concatenate([h, np.ones((*h.shape[:-1], 1))], -1).reshape(*h.shape[:-1], 3, 3)
    T = np.zeros((*src.shape[:-2], 3, 3))
    T[..., 0, 0] = T[..., 1, 1] = 1 / spread[..., 0, 0]
    T[..., :2, 2] = -centre[..., 0, :] / spread[..., 0, :]
    T[..., 2, 2] = 1
    return normalise(np.linalg.inv(T) @ unit @ T)


def point_jacobian(H: ArrayLike, points_px: ArrayLike) -> Array:
    """d(H x)/d(row-major h), (..., m, 2, 9), at points (..., m, 2): rows [x/y3, 0, -q1 x/y3], [0, x/y3, -q2 x/y3]."""
    H, points = np.asarray(H, float), np.asarray(points_px, float)
    x = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)
    y = x @ np.swapaxes(H, -1, -2)
    q, scaled = y[..., :2] / y[..., 2:], x / y[..., 2:]
    out = np.zeros((*y.shape[:-1], 2, 9))
    out[..., 0, 0:3], out[..., 1, 3:6] = scaled, scaled
    out[..., 0, 6:9], out[..., 1, 6:9] = -q[..., :1] * scaled, -q[..., 1:] * scaled
    return out
