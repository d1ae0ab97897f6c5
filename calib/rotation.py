"""Rotations: exponential and logarithm, pan / tilt / roll, projection on SO(3). Angles in radians.

R = Rz(-roll) Rx(-tilt) Ry(-pan) maps world axes into camera axes (x right, y down, z forward). Updates of an estimate
are left increments, R <- Exp(delta) R, and the result is made orthonormal again: R^T stands for the inverse everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def skew(vectors: ArrayLike) -> Array:
    """Cross-product matrices [w]x (..., 3, 3) of vectors (..., 3): [w]x y = w x y."""
    w = np.asarray(vectors, float)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exp(vectors: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) rad (Rodrigues; Taylor series below 1e-4 rad)."""
    w = np.asarray(vectors, float)
    angle2 = np.sum(w * w, -1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle2 < 1e-8
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    # 2 sin^2(t/2) / t^2 keeps its digits where 1 - cos(t) loses them.
    cosine = np.where(small, 0.5 - angle2 / 24, 2 * np.sin(safe / 2) ** 2 / (safe * safe))
    cross = skew(w)
    return np.eye(3) + sine * cross + cosine * (cross @ cross)


def turned(points: ArrayLike, vectors: ArrayLike) -> Array:
    """Points (..., 3) turned by rotation vectors (..., 3) rad: exp(vectors) @ points, without the matrices.

    The shapes broadcast.
    """
    v, w = np.asarray(points, float), np.asarray(vectors, float)
    angle2 = np.sum(w * w, -1, keepdims=True)
    small = angle2 < 1e-8
    safe = np.where(small, 1.0, np.sqrt(angle2))
    sine = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    cosine = np.where(small, 0.5 - angle2 / 24, 2 * np.sin(safe / 2) ** 2 / (safe * safe))
    across = np.cross(w, v)
    return np.asarray(v + sine * across + cosine * np.cross(w, across))


def log(rotations: ArrayLike) -> Array:
    """Rotation vectors (..., 3) rad of rotation matrices (..., 3, 3); angle in [0, pi], exact also near pi."""
    R = np.asarray(rotations, float)
    vee = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    sine = np.linalg.norm(vee, axis=-1)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > 1e-9, angle / np.where(sine > 1e-9, sine, 1), 1.0)
    out = vee * scale[..., None]
    near_pi = np.asarray((cosine < -0.99) & (sine < 0.1))
    if near_pi.any():
        # There the skew part vanishes and the axis comes from the symmetric part: (R + R^T)/2 = c I + (1-c) a a^T.
        part = R[near_pi]
        outer = 0.5 * (part + np.swapaxes(part, -1, -2)) - cosine[near_pi][..., None, None] * np.eye(3)
        column = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
        axis = np.take_along_axis(outer, column[..., None, None], -1)[..., 0]
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        sign = np.where(np.sum(axis * vee[near_pi], -1) < 0, -1.0, 1.0)
        out[near_pi] = axis * (sign * angle[near_pi])[..., None]
    return out


def from_pan_tilt_roll(pan_rad: ArrayLike, tilt_rad: ArrayLike, roll_rad: ArrayLike) -> Array:
    """R_cam_world (..., 3, 3) = Rz(-roll) Rx(-tilt) Ry(-pan). pan > 0 turns right, tilt > 0 up, roll > 0 clockwise."""
    p, t, r = (np.asarray(a, float) for a in (pan_rad, tilt_rad, roll_rad))
    cp, sp, ct, st, cr, sr = np.cos(p), np.sin(p), np.cos(t), np.sin(t), np.cos(r), np.sin(r)
    R = np.empty((*np.broadcast_shapes(p.shape, t.shape, r.shape), 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = cr * cp + sr * st * sp, sr * ct, sr * st * cp - cr * sp
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = cr * st * sp - sr * cp, cr * ct, cr * st * cp + sr * sp
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = ct * sp, -st, ct * cp
    return R


def to_pan_tilt_roll(rotations: ArrayLike) -> tuple[Array, Array, Array]:
    """pan, tilt, roll (...,) rad of R_cam_world (..., 3, 3); tilt in [-pi/2, pi/2]. Inverse of `from_pan_tilt_roll`."""
    R = np.asarray(rotations, float)
    pan = np.arctan2(R[..., 2, 0], R[..., 2, 2])
    tilt = np.arcsin(np.clip(-R[..., 2, 1], -1, 1))
    roll = np.arctan2(R[..., 0, 1], R[..., 1, 1])
    return pan, tilt, roll


def project_so3(matrices: ArrayLike) -> Array:
    """Nearest rotations (..., 3, 3), Frobenius norm: U diag(1, 1, det U V^T) V^T. NaN where the input is not finite."""
    M = np.asarray(matrices, float)
    finite = np.isfinite(M).all((-1, -2))
    U, _, Vt = np.linalg.svd(np.where(finite[..., None, None], M, np.eye(3)))
    sign = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return np.where(finite[..., None, None], U @ Vt, np.nan)


def orthonormalise(rotations: ArrayLike) -> Array:
    """Two Newton steps towards orthonormality, (..., 3, 3): for matrices that are rotations but for rounding."""
    R = np.asarray(rotations, float)
    for _ in range(2):
        R = 1.5 * R - 0.5 * R @ np.swapaxes(R, -1, -2) @ R
    return R


def angle_between(R_a: ArrayLike, R_b: ArrayLike) -> Array:
    """Angle (...,) rad of R_b R_a^T."""
    return np.linalg.norm(log(np.asarray(R_b) @ np.swapaxes(np.asarray(R_a), -1, -2)), axis=-1)
