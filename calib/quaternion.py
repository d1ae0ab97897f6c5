"""Unit quaternions (q0 scalar first) and rotation matrices, in the two conventions that the literature mixes.

Hamilton's (active) matrix is what most libraries mean; Seo, Ahn, Hong 2000, eq. (20), print its transpose. Nothing
here estimates anything: rotations are carried as matrices everywhere else, quaternions are the cross-check.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def _unit(q: ArrayLike) -> Array:
    values = np.asarray(q, float)
    if values.shape[-1:] != (4,):
        raise ValueError(f"quaternions must be (..., 4), got {values.shape}")
    with np.errstate(all="ignore"):
        return values / np.linalg.norm(values, axis=-1, keepdims=True)


def to_rotation(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), Hamilton's convention; q is normalised first.

    q = (cos t/2, sin t/2 axis) gives the matrix that `rotation.exp(t axis)` gives. NaN for a zero quaternion.
    Raises ValueError: the last axis is not 4.
    """
    return np.swapaxes(paper_rotation(q), -1, -2)


def paper_rotation(q: ArrayLike) -> Array:
    """R(q) (..., 3, 3) of quaternions (..., 4) as Seo, Ahn, Hong 2000, eq. (20), print it: Hamilton's transposed."""
    q0, q1, q2, q3 = np.moveaxis(_unit(q), -1, 0)
    rows = (
        (q0**2 + q1**2 - q2**2 - q3**2, 2 * (q1 * q2 + q0 * q3), 2 * (q1 * q3 - q0 * q2)),
        (2 * (q1 * q2 - q0 * q3), q0**2 - q1**2 + q2**2 - q3**2, 2 * (q2 * q3 + q0 * q1)),
        (2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0**2 - q1**2 - q2**2 + q3**2),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def from_rotation(rotations: ArrayLike) -> Array:
    """Quaternions (..., 4), Hamilton's, scalar part >= 0, of rotation matrices (..., 3, 3); exact near 180 degrees.

    Of the four equivalent formulas the one with the largest pivot is taken (Shepperd 1978). Raises ValueError: shape.
    """
    R = np.asarray(rotations, float)
    if R.shape[-2:] != (3, 3):
        raise ValueError(f"rotations must be (..., 3, 3), got {R.shape}")
    # 4 q q^T is linear in R: take its column with the largest diagonal entry.
    d = np.diagonal(R, axis1=-2, axis2=-1)
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + d.sum(-1)
    for i in range(3):
        outer[..., i + 1, i + 1] = 1 + 2 * d[..., i] - d.sum(-1)
    for i, (a, b) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        outer[..., 0, i] = outer[..., i, 0] = R[..., a, b] - R[..., b, a]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        outer[..., a + 1, b + 1] = outer[..., b + 1, a + 1] = R[..., a, b] + R[..., b, a]
    pivot = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = _unit(np.take_along_axis(outer, pivot[..., None, None], -1)[..., 0])
    return np.where(q[..., :1] < 0, -q, q)
