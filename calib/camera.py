"""The camera that rotates and zooms: K, homographies of rotation, and the transfer of raw points between two views.

The transfer undistorts a point of a, turns it into b and distorts it there, with closed-form derivatives in the 13
numbers of an edge (calibration.md 6.3), or 16 of the wider lens: a second coefficient of distortion and a principal
point that drifts with the zoom. Arrays run over (start, edge, point): no loop over points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import distortion, homography

Array = NDArray[np.float64]

# Unknowns that all frames share, as an edge's Jacobian has them behind the 8 of its two poses; the last three only in
# the wider lens.
SHARED = ("pp_x", "pp_y", "log_aspect", "c0", "c1", "k2", "pp_drift_x", "pp_drift_y")
N_POSES = 8
N_SHARED = 5
N_WIDE = len(SHARED)


def infinite_homography(K_dst: ArrayLike, K_src: ArrayLike, R_dst_src: ArrayLike) -> Array:
    """Homography between two views of a camera that only rotates and zooms: K_dst R_dst_src K_src^-1.

    K_dst, K_src: (..., 3, 3) px, undistorted. R_dst_src: (..., 3, 3), src axes to dst axes.
    Returns H_dst_src (..., 3, 3), det 1; NaN where an input is NaN. Raises ValueError: shapes do not broadcast.
    Source: Seo, Ahn, Hong 2000; Hartley and Zisserman, camera rotation about its centre.
    """
    K_src = np.asarray(K_src, float)
    finite = np.isfinite(K_src).all((-1, -2), keepdims=True)
    inverse = np.where(finite, np.linalg.inv(np.where(finite, K_src, np.eye(3))), np.nan)
    return homography.normalise(np.asarray(K_dst, float) @ np.asarray(R_dst_src, float) @ inverse)


class Transfer(NamedTuple):
    """Predicted raw points (..., m) x and y in b; Jacobian (..., 13 or 16, 2, m) or None; NaN behind or folded."""

    x: Array
    y: Array
    J: Array | None


def transfer(
    points_x: Array,
    points_y: Array,
    log_f_a: Array,
    log_f_b: Array,
    R_b_a: Array,
    shared: Array,
    width_px: float,
    *,
    log_f_pp: float = 0.0,
    jacobian: bool = True,
    pose_only: bool = False,
) -> Transfer:
    """Raw points of a, (..., m), seen in b.

    log_f_a, log_f_b: (...,); R_b_a (..., 3, 3); shared (..., 5) = pp_x, pp_y, log aspect, c0, c1, or (..., 8) with k2
    and the principal point's drift (x, y), px per unit of log f: pp(f) = pp + drift (log f - log_f_pp). The Jacobian's
    columns: log f_a, left increment of R_a (3), log f_b, left increment of R_b (3), and (not pose_only) the shared.
    """
    s2 = (width_px / 2) ** 2
    ppx, ppy, log_aspect, c0, c1 = (shared[..., k, None] for k in range(5))
    lam_a, lam_b = log_f_a[..., None], log_f_b[..., None]
    log_w = np.log(width_px)
    wide = shared.shape[-1] == N_WIDE
    k2: Array | float = 0.0
    ppx_b, ppy_b = ppx, ppy
    if wide:
        k2, drift_x, drift_y = (shared[..., k, None] for k in range(N_SHARED, N_WIDE))
        since_a, since_b = lam_a - log_f_pp, lam_b - log_f_pp
        ppx_b, ppy_b = ppx + drift_x * since_b, ppy + drift_y * since_b
        ppx, ppy = ppx + drift_x * since_a, ppy + drift_y * since_a
    ka, kb = c0 + c1 * (lam_a - log_w), c0 + c1 * (lam_b - log_w)
    aspect = np.exp(log_aspect)
    alpha_a, alpha_b = np.exp(lam_a), np.exp(lam_b)
    beta_a, beta_b = alpha_a / aspect, alpha_b / aspect

    dx, dy = points_x - ppx, points_y - ppy
    rho_d = np.sqrt((dx * dx + dy * dy) / s2)
    rho = distortion.undistorted_radius(rho_d, ka, k2)
    shrink = np.where(rho_d > 1e-9, rho / np.where(rho_d > 1e-9, rho_d, 1.0), 1.0)
    v1, v2 = dx * shrink / alpha_a, dy * shrink / beta_a
    R = R_b_a[..., None]  # (..., 3, 3, 1)
    w1 = R[..., 0, 0, :] * v1 + R[..., 0, 1, :] * v2 + R[..., 0, 2, :]
    w2 = R[..., 1, 0, :] * v1 + R[..., 1, 1, :] * v2 + R[..., 1, 2, :]
    w3 = R[..., 2, 0, :] * v1 + R[..., 2, 1, :] * v2 + R[..., 2, 2, :]
    inv = 1.0 / np.where(w3 > 1e-3, w3, np.nan)
    q1, q2 = w1 * inv, w2 * inv
    bx, by = alpha_b * q1, beta_b * q2
    rho_b2 = (bx * bx + by * by) / s2
    if wide:
        g = 1 + rho_b2 * (kb + k2 * rho_b2)
        g = np.where(rho_b2 < distortion.fold_square(kb, k2), g, np.nan)
    else:
        g = 1 + kb * rho_b2
        g = np.where(1 + 3 * kb * rho_b2 > 0, g, np.nan)
    out_x, out_y = ppx_b + bx * g, ppy_b + by * g
    if not jacobian:
        return Transfer(out_x, out_y, None)

    # D_b = derivative of the distortion at u'; G = D_b A_b dpi/dw; GR = G R.
    twice = (2 * kb + 4 * k2 * rho_b2) / s2 if wide else 2 * kb / s2
    d11, d12, d22 = g + twice * bx * bx, twice * bx * by, g + twice * by * by
    ai, bi = alpha_b * inv, beta_b * inv
    G11, G12, G21, G22 = d11 * ai, d12 * bi, d12 * ai, d22 * bi
    G13, G23 = -(G11 * q1 + G12 * q2), -(G21 * q1 + G22 * q2)
    n_columns = N_POSES if pose_only else N_POSES + shared.shape[-1]
    J = np.empty((*out_x.shape[:-1], n_columns, 2, out_x.shape[-1]))
    ra = rho * rho
    slope_a = 1 + ra * (3 * ka + 5 * k2 * ra) if wide else 1 + 3 * ka * ra
    radial_a = ra / slope_a
    # D_a^-1 = (1/g_a)(I - (slope - g_a)/slope n n^T): eigenvalue 1/slope along the radius, 1/g_a across.
    if wide or not pose_only:
        ga_inv = 1.0 / (1 + ra * (ka + k2 * ra)) if wide else 1.0 / (1 + ka * ra)
        ux, uy = dx * shrink, dy * shrink
        ratio = (2 * ka + 4 * k2 * ra if wide else 2 * ka) / s2 / slope_a
        i11, i12, i22 = (
            ga_inv * (1 - ratio * ux * ux),
            -ga_inv * ratio * ux * uy,
            ga_inv * (1 - ratio * uy * uy),
        )
    for row, (a, b, c) in enumerate(((G11, G12, G13), (G21, G22, G23))):
        x = a * R[..., 0, 0, :] + b * R[..., 1, 0, :] + c * R[..., 2, 0, :]
        y = a * R[..., 0, 1, :] + b * R[..., 1, 1, :] + c * R[..., 2, 1, :]
        z = a * R[..., 0, 2, :] + b * R[..., 1, 2, :] + c * R[..., 2, 2, :]
        by_f = -(x * v1 + y * v2)
        by_k_a = by_f * radial_a
        by_k_b = (bx if row == 0 else by) * rho_b2
        J[..., 0, row, :] = by_f + c1 * by_k_a
        J[..., 1, row, :] = y - z * v2
        J[..., 2, row, :] = z * v1 - x
        J[..., 3, row, :] = x * v2 - y * v1
        own = d11 * bx + d12 * by if row == 0 else d12 * bx + d22 * by
        J[..., 4, row, :] = own + c1 * by_k_b
        J[..., 5, row, :] = c * w2 - b * w3
        J[..., 6, row, :] = a * w3 - c * w1
        J[..., 7, row, :] = b * w1 - a * w2
        if pose_only and not wide:
            continue
        au, av = x / alpha_a, y / beta_a
        by_pp_a = (-(au * i11 + av * i12), -(au * i12 + av * i22))
        if wide:  # the principal point of either frame follows its log f
            J[..., 0, row, :] += drift_x * by_pp_a[0] + drift_y * by_pp_a[1]
            J[..., 4, row, :] += drift_x if row == 0 else drift_y
            if pose_only:
                continue
            J[..., 13, row, :] = by_k_a * ra + by_k_b * rho_b2
            for k in (0, 1):
                J[..., 14 + k, row, :] = since_a * by_pp_a[k] + (since_b if row == k else 0.0)
        for k in (0, 1):
            J[..., 8 + k, row, :] = by_pp_a[k] + (1.0 if row == k else 0.0)
        J[..., 10, row, :] = y * v2 - (d12 if row == 0 else d22) * by
        J[..., 11, row, :] = by_k_a + by_k_b
        J[..., 12, row, :] = (lam_a - log_w) * by_k_a + (lam_b - log_w) * by_k_b
    return Transfer(out_x, out_y, J)
