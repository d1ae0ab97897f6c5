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
    """Raw points of a, (..., m), seen in b, and their derivatives (`Seen.jacobian`)."""
    seen = Seen(points_x, points_y, log_f_a, log_f_b, R_b_a, shared, width_px, log_f_pp=log_f_pp)
    return Transfer(seen.x, seen.y, seen.jacobian(pose_only=pose_only) if jacobian else None)


class Seen:
    """Raw points of a, (..., m), seen in b: x, y (..., m) raw px; NaN where behind the camera or folded.

    log_f_a, log_f_b: (...,); R_b_a (..., 3, 3); shared (..., 5) = pp_x, pp_y, log aspect, c0, c1, or (..., 8) with k2
    and the principal point's drift (x, y), px per unit of log f: pp(f) = pp + drift (log f - log_f_pp).
    Keeps what the derivatives are made of, so that they can be asked for once the residuals are known.
    """

    def __init__(
        self,
        points_x: Array,
        points_y: Array,
        log_f_a: Array,
        log_f_b: Array,
        R_b_a: Array,
        shared: Array,
        width_px: float,
        *,
        log_f_pp: float = 0.0,
    ) -> None:
        self.R, self.s2 = R_b_a, (width_px / 2) ** 2
        ppx, ppy, log_aspect, c0, self.c1 = (shared[..., k, None] for k in range(N_SHARED))
        lam_a, lam_b = log_f_a[..., None], log_f_b[..., None]
        self.zoom_a, self.zoom_b = lam_a - np.log(width_px), lam_b - np.log(width_px)
        self.wide = shared.shape[-1] == N_WIDE
        self.k2: Array | float = 0.0
        ppx_b, ppy_b = ppx, ppy
        if self.wide:
            self.k2, self.drift_x, self.drift_y = (shared[..., k, None] for k in range(N_SHARED, N_WIDE))
            self.since_a, self.since_b = lam_a - log_f_pp, lam_b - log_f_pp
            ppx_b, ppy_b = ppx + self.drift_x * self.since_b, ppy + self.drift_y * self.since_b
            ppx, ppy = ppx + self.drift_x * self.since_a, ppy + self.drift_y * self.since_a
        self.ka, self.kb = c0 + self.c1 * self.zoom_a, c0 + self.c1 * self.zoom_b
        aspect = np.exp(log_aspect)
        self.per_alpha_a, self.per_beta_a = np.exp(-lam_a), np.exp(-lam_a) * aspect
        self.alpha_b = np.exp(lam_b)
        self.beta_b = self.alpha_b / aspect

        dx, dy = points_x - ppx, points_y - ppy
        rho_d = np.sqrt((dx * dx + dy * dy) / self.s2)
        self.rho = distortion.undistorted_radius(rho_d, self.ka, self.k2)
        shrink = self.rho / np.maximum(rho_d, 1e-12)  # at the centre itself dx and dy are 0
        self.ux, self.uy = dx * shrink, dy * shrink
        # Batched products with R are several times faster than sums over its entries.
        shape = np.broadcast(dx, self.R[..., 0, :1]).shape
        self.v = (self.ux * self.per_alpha_a, self.uy * self.per_beta_a)
        ray = np.empty((*shape[:-1], 3, shape[-1]))
        ray[..., 0, :], ray[..., 1, :], ray[..., 2, :] = *self.v, 1.0
        self.w = np.moveaxis(self.R @ ray, -2, 0).copy()
        w1, w2, w3 = self.w
        self.inv = 1.0 / w3
        _null(self.inv, w3 <= 1e-3)
        self.bx, self.by = w1 * self.inv * self.alpha_b, w2 * self.inv * self.beta_b
        self.rho_b2 = (self.bx * self.bx + self.by * self.by) / self.s2
        bend = self.rho_b2 * (self.kb + self.k2 * self.rho_b2) if self.wide else self.rho_b2 * self.kb
        self.g = 1 + bend
        _null(self.g, self.rho_b2 >= distortion.fold_square(self.kb, self.k2))
        self.x, self.y = ppx_b + self.bx * self.g, ppy_b + self.by * self.g

    def jacobian(self, left: tuple[Array, Array, Array] | None = None, *, pose_only: bool = False) -> Array:
        """Derivatives (..., 13 or 16, 2, m) of x and y: by log f_a, left increment of R_a (3), log f_b, left increment

        of R_b (3), and (not pose_only) the shared. left: l11, l12, l22 (..., m) of a symmetric matrix on the left of
        every point's derivatives: whitened and weighted ones cost hardly more than plain ones.
        """
        wide, k2, ka, c1 = self.wide, self.k2, self.ka, self.c1
        bx, by, g, rho_b2 = self.bx, self.by, self.g, self.rho_b2
        shape = bx.shape

        def two(first: Array | float, second: Array | float) -> Array:
            # The two results come first in what follows, so that arithmetic runs over long rows of memory.
            out = np.empty((2, *shape))
            out[0], out[1] = first, second
            return out

        # D_b = derivative of the distortion at u'; G = D_b A_b dpi/dw; GR = G R.
        twice = (2 * self.kb + 4 * k2 * rho_b2) / self.s2 if wide else 2 * self.kb / self.s2
        tx, ty = twice * bx, twice * by
        d11, d12, d22 = g + tx * bx, tx * by, g + ty * by
        if left is None:
            unit = (two(1.0, 0.0), two(0.0, 1.0))
            D, b = (two(d11, d12), two(d12, d22)), two(bx, by)
        else:
            l11, l12, l22 = left
            unit = two(l11, l12), two(l12, l22)
            D = (
                two(l11 * d11 + l12 * d12, l12 * d11 + l22 * d12),
                two(l11 * d12 + l12 * d22, l12 * d12 + l22 * d22),
            )
            b = two(l11 * bx + l12 * by, l12 * bx + l22 * by)
        own = D[0] * bx + D[1] * by
        a, e, c = D[0] * (self.alpha_b * self.inv), D[1] * (self.beta_b * self.inv), own * -self.inv
        G = np.empty((*shape[:-1], 3, 2, shape[-1]))
        for k, part in enumerate((a, e, c)):
            G[..., k, 0, :], G[..., k, 1, :] = part
        GR = np.swapaxes(self.R, -1, -2) @ G.reshape(*shape[:-1], 3, -1)
        x, y, z = np.moveaxis(GR.reshape(G.shape), (-3, -2), (0, 1)).copy()
        (v1, v2), (w1, w2, w3) = self.v, self.w

        n_columns = N_POSES + (0 if pose_only else N_WIDE if wide else N_SHARED)
        J = np.empty((*shape[:-1], n_columns, 2, shape[-1]))
        column = np.moveaxis(J, (-3, -2), (0, 1))
        ra = self.rho * self.rho
        slope = 1 + ra * (3 * ka + 5 * k2 * ra) if wide else 1 + 3 * ka * ra
        # G w = 0, so z = -(x v1 + y v2): what moves with log f_a.
        by_k_a, by_k_b = z * (ra / slope), b * rho_b2
        column[0] = z + c1 * by_k_a
        column[1] = y - z * v2
        column[2] = z * v1 - x
        column[3] = x * v2 - y * v1
        column[4] = own + c1 * by_k_b
        column[5] = c * w2 - e * w3
        column[6] = a * w3 - c * w1
        column[7] = e * w1 - a * w2
        if pose_only and not wide:
            return J
        # D_a^-1 = (1/g_a)(I - (slope - g_a)/slope n n^T): eigenvalue 1/slope along the radius, 1/g_a across.
        per_ga = 1.0 / (1 + ra * (ka + k2 * ra)) if wide else 1.0 / (1 + ka * ra)
        ratio = per_ga * ((2 * ka + 4 * k2 * ra if wide else 2 * ka) / self.s2) / slope
        rx, ry = ratio * self.ux, ratio * self.uy
        i11, i12, i22 = per_ga - rx * self.ux, rx * self.uy, per_ga - ry * self.uy
        by_pp_a = (
            y * (i12 * self.per_beta_a) - x * (i11 * self.per_alpha_a),
            x * (i12 * self.per_alpha_a) - y * (i22 * self.per_beta_a),
        )
        if wide:  # the principal point of either frame follows its log f
            for k, drift in enumerate((self.drift_x, self.drift_y)):
                column[0] += drift * by_pp_a[k]
                column[4] += drift * unit[k]
        if pose_only:
            return J
        for k in (0, 1):
            column[8 + k] = by_pp_a[k] + unit[k]
        column[10] = y * v2 - D[1] * by
        column[11] = by_k_a + by_k_b
        column[12] = self.zoom_a * by_k_a + self.zoom_b * by_k_b
        if wide:
            column[13] = by_k_a * ra + by_k_b * rho_b2
            for k in (0, 1):
                column[14 + k] = self.since_a * by_pp_a[k] + self.since_b * unit[k]
        return J


def _null(values: Array, where: Array) -> None:
    """NaN into some of the values, in place."""
    if where.any():
        values[where] = np.nan
