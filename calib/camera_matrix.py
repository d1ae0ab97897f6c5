"""Camera matrices P = K R of a camera at a fixed centre: the zero-skew condition, and P and H taken apart.

Source: Seo, Ahn, Hong 2000, eq. (3), (5), (7)-(12), (36); calibration.md 2.2, 4.1. Ideal pixels; nothing is estimated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography, rotation

Array = NDArray[np.float64]


class Parts(NamedTuple):
    """K (..., 3, 3) upper triangular, px, K[2, 2] = 1, positive diagonal; R (..., 3, 3) world axes into camera axes."""

    K: Array
    R: Array


def _checked(matrices: ArrayLike, what: str) -> Array:
    M = np.asarray(matrices, float)
    if M.shape[-2:] != (3, 3):
        raise ValueError(f"{what} must be (..., 3, 3), got {M.shape}")
    return M


def zero_skew_residual(P: ArrayLike) -> Array:
    """(p1 x p3) . (p2 x p3) over the lengths of both, (...,): 0 if and only if K of P = K R has zero skew, eq. (7).

    P: (..., 3, 3), any scale, rows p1, p2, p3. The value is the cosine between the two planes, so -1..1; with skew s
    and K = [[a, s, x], [0, b, y], [0, 0, 1]] it is s / hypot(a, s). Raises ValueError: shape.
    """
    P = _checked(P, "camera matrices")
    n1, n2 = np.cross(P[..., 0, :], P[..., 2, :]), np.cross(P[..., 1, :], P[..., 2, :])
    with np.errstate(all="ignore"):
        return np.sum(n1 * n2, -1) / (np.linalg.norm(n1, axis=-1) * np.linalg.norm(n2, axis=-1))


def parts(P: ArrayLike) -> Parts:
    """K and R of camera matrices P = mu K R (..., 3, 3), any scale mu: the RQ decomposition, R with det 1.

    NaN where P is singular or not finite. Raises ValueError: shape.
    """
    P = homography.normalise(_checked(P, "camera matrices"))
    finite = np.isfinite(P).all((-1, -2), keepdims=True)
    safe = np.where(finite, P, np.eye(3))
    # RQ by QR of the reversed transpose; LAPACK's QR has no fixed signs, so the diagonal of K decides them.
    flip = safe[..., ::-1, :].swapaxes(-1, -2)
    Q, U = np.linalg.qr(flip)
    K, R = U.swapaxes(-1, -2)[..., ::-1, ::-1], Q.swapaxes(-1, -2)[..., ::-1, :]
    sign = np.where(np.diagonal(K, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    K, R = K * sign[..., None, :], R * sign[..., :, None]
    K = K / K[..., 2:, 2:]
    return Parts(np.where(finite, K, np.nan), np.where(finite, R, np.nan))


def homography_parts(H_dst_src: ArrayLike, K_src: ArrayLike) -> Parts:
    """K_dst and R_dst_src of H_dst_src = K_dst R_dst_src K_src^-1 when K_src is known: parts of H K_src, eq. (22).

    H_dst_src, K_src: (..., 3, 3), ideal px. Any H has such parts; that K_dst has zero skew is the evidence.
    """
    H, K = _checked(H_dst_src, "homographies"), _checked(K_src, "K_src")
    # Negative determinants mean the opposite sign of H, not a reflected camera: normalise() in parts() takes care.
    return parts(H @ K)


def rotation_from_homography(H_dst_src: ArrayLike, K_dst: ArrayLike, K_src: ArrayLike) -> Array:
    """K_dst^-1 H K_src with det 1 (..., 3, 3), eq. (36): a rotation only as far as H and both K are right.

    Project with `rotation.project_so3`; what is lost by that is the paper's error E, see `orthogonality_error`.
    """
    H = _checked(H_dst_src, "homographies")
    return homography.normalise(np.linalg.solve(_checked(K_dst, "K_dst"), H @ _checked(K_src, "K_src")))


def orthogonality_error(R: ArrayLike) -> Array:
    """|R R^T - I|_F^2 + |R^T R - I|_F^2 (...,) of matrices (..., 3, 3), summed by the paper to its E, eq. (41)."""
    R = _checked(R, "rotations")
    outer, inner = R @ R.swapaxes(-1, -2) - np.eye(3), R.swapaxes(-1, -2) @ R - np.eye(3)
    return np.sum(outer**2, (-1, -2)) + np.sum(inner**2, (-1, -2))


def nearest_rotation(H_dst_src: ArrayLike, K_dst: ArrayLike, K_src: ArrayLike) -> Array:
    """`rotation_from_homography` projected on SO(3), (..., 3, 3)."""
    return rotation.project_so3(rotation_from_homography(H_dst_src, K_dst, K_src))
