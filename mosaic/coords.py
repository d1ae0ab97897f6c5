"""Pixel conventions of this package: homographies on points, pyramid levels, the four-anchor chart.

(0, 0) is the centre of the top-left pixel; points are (x, y). Only this module converts between levels.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import ArrayLike

from mosaic.records import FloatArray


def normalise_homography(H: ArrayLike) -> FloatArray:
    """H (..., 3, 3) scaled to det 1 by the real cube root; NaN where H is singular or not finite."""
    H = np.asarray(H, np.float64)
    root = np.cbrt(np.linalg.det(H))
    with np.errstate(divide="ignore", invalid="ignore"):
        return H / np.where(np.abs(root) > 1e-300, root, np.nan)[..., None, None]


def transfer(H_b_a: ArrayLike, points_a: ArrayLike) -> FloatArray:
    """Points (..., 2) of a mapped into b by H_b_a (3, 3); NaN on or behind the line at infinity."""
    H = np.asarray(H_b_a, np.float64)
    p = np.asarray(points_a, np.float64)
    q = p @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(q[..., 2:] > 1e-12, q[..., :2] / q[..., 2:], np.nan)


def level_scale(size_px: tuple[int, int], level_size_px: tuple[int, int]) -> tuple[float, float]:
    """(sx, sy) with x_full = sx x_level + (sx - 1) / 2: what area averaging does, per axis and after rounding."""
    return size_px[0] / level_size_px[0], size_px[1] / level_size_px[1]


def level_matrix(scale: tuple[float, float]) -> FloatArray:
    """`to_full` as a matrix (3, 3)."""
    sx, sy = scale
    return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])


def to_full(points_level: ArrayLike, scale: tuple[float, float]) -> FloatArray:
    """Level pixels (..., 2) to full-size pixels."""
    s = np.asarray(scale, np.float64)
    return np.asarray(points_level, np.float64) * s + (s - 1.0) / 2.0


def to_level(points_full: ArrayLike, scale: tuple[float, float]) -> FloatArray:
    """Full-size pixels (..., 2) to level pixels; the inverse of `to_full`."""
    s = np.asarray(scale, np.float64)
    return (np.asarray(points_full, np.float64) - (s - 1.0) / 2.0) / s


def default_anchors(size_px: tuple[int, int]) -> FloatArray:
    """The four anchors (4, 2) of a w x h picture: its corners drawn in by 10 % of each side."""
    w, h = size_px
    x0, x1 = 0.1 * (w - 1), 0.9 * (w - 1)
    y0, y1 = 0.1 * (h - 1), 0.9 * (h - 1)
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def transfer_jacobian(H: FloatArray, points: FloatArray) -> FloatArray:
    """d transfer(H, points) / d vec(H), row-major: (n, 2, 9)."""
    x = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    y = x @ H.T
    w = y[:, 2:3]
    q = y[:, :2] / w
    J = np.zeros((len(points), 2, 9))
    J[:, 0, 0:3] = x / w
    J[:, 1, 3:6] = x / w
    J[:, 0, 6:9] = -q[:, :1] * x / w
    J[:, 1, 6:9] = -q[:, 1:] * x / w
    return J


@nb.njit(cache=True, nogil=True)
def _homography_normal_equations(H, H0, src, dst, info, ridge):  # type: ignore[no-untyped-def]
    """N (9, 9) and g (9,) of the measured points, R (9, 9) and rg (9,) of the pull to H0; see the caller."""
    N = np.zeros((9, 9))
    g = np.zeros(9)
    R = np.zeros((9, 9))
    rg = np.zeros(9)
    J = np.zeros((2, 9))
    for i in range(len(src)):
        x, y = src[i, 0], src[i, 1]
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        q0 = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
        q1 = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
        w0 = H0[2, 0] * x + H0[2, 1] * y + H0[2, 2]
        p0 = (H0[0, 0] * x + H0[0, 1] * y + H0[0, 2]) / w0
        p1 = (H0[1, 0] * x + H0[1, 1] * y + H0[1, 2]) / w0
        J[0, 0], J[0, 1], J[0, 2] = x / w, y / w, 1.0 / w
        J[1, 3], J[1, 4], J[1, 5] = x / w, y / w, 1.0 / w
        J[0, 6], J[0, 7], J[0, 8] = -q0 * x / w, -q0 * y / w, -q0 / w
        J[1, 6], J[1, 7], J[1, 8] = -q1 * x / w, -q1 * y / w, -q1 / w
        r0, r1 = dst[i, 0] - q0, dst[i, 1] - q1
        for a in range(9):
            ja0 = info[i, 0, 0] * J[0, a] + info[i, 0, 1] * J[1, a]
            ja1 = info[i, 1, 0] * J[0, a] + info[i, 1, 1] * J[1, a]
            g[a] += ja0 * r0 + ja1 * r1
            rg[a] += ridge * (J[0, a] * (p0 - q0) + J[1, a] * (p1 - q1))
            for b in range(9):
                N[a, b] += ja0 * J[0, b] + ja1 * J[1, b]
                R[a, b] += ridge * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return N, g, R, rg


def fit_homography_to_flow(
    src: FloatArray, dst: FloatArray, info: FloatArray, H_start: FloatArray, ridge_px: float = 100.0
) -> tuple[FloatArray, FloatArray]:
    """Homography nearest to measured points, and the information (9, 9) on vec(H) at the solution.

    src, dst: (m, 2) px; info: (m, 2, 2) px^-2 of dst. Gauss-Newton from H_start. `ridge_px` is a weak pull towards
    H_start: the std, in px at the points, that a direction without evidence keeps. Returns (H det 1, information of
    vec(H) of that scale, row-major).
    """
    return _fit_homography(
        np.ascontiguousarray(src), np.ascontiguousarray(dst), np.ascontiguousarray(info),
        normalise_homography(H_start), float(ridge_px) ** -2,
    )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def _fit_homography(src, dst, info, H0, ridge):  # type: ignore[no-untyped-def]
    """The Gauss-Newton loop of `fit_homography_to_flow`."""
    H = H0.copy()
    N = np.zeros((9, 9))
    for _ in range(3):
        N, g, R, rg = _homography_normal_equations(H, H0, src, dst, info, ridge)
        total = N + R
        scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
        # vec(H) has one free scale: a unit of curvature along H itself keeps the system regular.
        h = H.copy().reshape(9) / scale
        h /= np.sqrt((h * h).sum())
        M = total * scale.reshape(9, 1) * scale.reshape(1, 9) + h.reshape(9, 1) * h.reshape(1, 9)
        step = scale * np.linalg.solve(M + 1e-12 * np.eye(9), scale * (g + rg))
        if not np.all(np.isfinite(step)):
            break
        H = H + step.reshape(3, 3)
        det = np.linalg.det(H)
        H = H / (np.sign(det) * abs(det) ** (1.0 / 3.0))
        if step @ total @ step < 1e-4:  # far below a tenth of its own standard deviation
            break
    return H, N


def anchor_information(H: FloatArray, N: FloatArray, anchors: FloatArray) -> FloatArray:
    """Information (8, 8) of the four transferred anchors, from N (9, 9) on vec(H) (calibration.md 3.5)."""
    J = transfer_jacobian(H, anchors).reshape(8, 9)
    # Eight anchors' coordinates determine vec(H) up to scale: invert the chart on the complement of H.
    h = H.ravel() / np.linalg.norm(H)
    chart = np.vstack([J, h[None, :] * np.linalg.norm(J)])
    try:
        back = np.linalg.inv(chart)[:, :8]  # a tenth of the time of its pseudo-inverse
    except np.linalg.LinAlgError:
        back = np.linalg.pinv(chart)[:, :8]
    return back.T @ N @ back
