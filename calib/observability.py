"""What a set of rotations can reveal: the zero-skew matrix M, its rank and null space, and a verdict in words.

Source: Seo, Ahn, Hong 2000, eq. (19), (21); calibration.md 2. Rank is diagnostic text: the decision is the covariance's
(gates.py), because the smallest singular value falls with the square of the angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WORDS = {
    1: "Nothing but the skew of the first view: the camera did not turn.",
    2: "One fixed axis (pan only, tilt only or roll only): a focal needs known aspect and a shared principal point.",
    3: "One oblique axis: not enough without square pixels.",
    4: "Pan and tilt without roll: the aspect stays free.",
    5: "Unique up to the choice of axes.",
}
WORDS_SQUARE = {
    2: "Square pixels, but no turn of the viewing direction: nothing is observable.",
    3: "Square pixels, nearly enough: one more direction is needed.",
    4: "Square pixels and two views: unique once the principal point is shared or known.",
    5: "Square pixels and three or more views: unique.",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observability:
    """singular_values (6,) of M / sqrt(n views); rank; null_space (6 - rank, 3, 3) symmetric L beside I; sentence."""

    singular_values: Array
    rank: int
    null_space: Array
    sentence: str


def zero_skew_rows(rotations: ArrayLike) -> Array:
    """Rows m_i (..., 6), eq. (21), of R (..., 3, 3): m_i . (L11, L12, L13, L22, L23, L33) = e2^T R L R^T e1."""
    R = np.asarray(rotations, float)
    a, b = R[..., 0, :], R[..., 1, :]
    return _symmetric_rows(a, b)


def square_pixel_rows(rotations: ArrayLike) -> Array:
    """Rows (..., 6) of the second condition of square pixels: a^T L a - b^T L b = 0, rows a, b of R (..., 3, 3)."""
    R = np.asarray(rotations, float)
    a, b = R[..., 0, :], R[..., 1, :]
    return _symmetric_rows(a, a) - _symmetric_rows(b, b)


def _symmetric_rows(a: Array, b: Array) -> Array:
    (a1, a2, a3), (b1, b2, b3) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([a1 * b1, a1 * b2 + a2 * b1, a1 * b3 + a3 * b1, a2 * b2, a2 * b3 + a3 * b2, a3 * b3], -1)


def observability(
    rotations: ArrayLike, *, square_pixels: bool = False, tolerance: float = 1e-3
) -> Observability:
    """Rank and null space of the zero-skew conditions of rotations (n, 3, 3), the reference view included.

    tolerance: singular values of M / sqrt(n) below it count as zero. Raises ValueError for another shape.
    """
    R = np.asarray(rotations, float)
    if R.ndim != 3 or R.shape[1:] != (3, 3) or not len(R):
        raise ValueError(f"rotations must be (n, 3, 3), got {R.shape}")
    M = zero_skew_rows(R)
    if square_pixels:
        M = np.concatenate([M, square_pixel_rows(R)])
    _, s, Vt = np.linalg.svd(np.concatenate([M / np.sqrt(len(R)), np.zeros((6, 6))]))
    rank = int(np.sum(s > tolerance))
    null = Vt[rank:]
    L = np.zeros((len(null), 3, 3))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        L[:, i, j] = L[:, j, i] = null[:, k]
    words = WORDS_SQUARE if square_pixels else WORDS
    return Observability(
        singular_values=s, rank=rank, null_space=L, sentence=words.get(rank, words[max(words)])
    )
