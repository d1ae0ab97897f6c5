"""What a set of rotations can reveal: the zero-skew matrix M, its rank and null space, and a verdict in words.

Source: Seo, Ahn, Hong 2000, eq. (19), (21); calibration.md 2. Rank is diagnostic text: the decision is the covariance's
(gates.py), because the smallest singular value falls with the square of the angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import quaternion, rotation

Array = NDArray[np.float64]
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # order of l = (L11, L12, L13, L22, L23, L33)
AXIS_NAMES = ("tilt (x axis)", "pan (y axis)", "roll (z axis)")

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
    """What the motion reveals, by the zero-skew theorem.

    singular_values (6,) of M / sqrt(n views); rank; null_space (6 - rank, 3, 3) symmetric L, I always among their span;
    sentence: the rank in words. free: which of fx, fy, cx, cy of the reference view some other L of the null space
    changes (empty when the calibration is unique); needed: the motion that would fix them, '' when none is.
    """

    singular_values: Array
    rank: int
    null_space: Array
    sentence: str
    free: tuple[str, ...] = ()
    needed: str = ""


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


def zero_skew_polynomials(q: ArrayLike) -> Array:
    """The same row m (..., 6) as polynomials of degree four in the paper's quaternions (..., 4), eq. (13)-(18).

    For R(q) of eq. (20), `quaternion.paper_rotation`; conjugate q first if it is Hamilton's. The formulas of the print
    restored: they equal `zero_skew_rows` of R(q) to rounding. q is normalised first.
    """
    q0, q1, q2, q3 = np.moveaxis(np.asarray(q, float) / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    m1 = 2 * (-q1 * q2 + q0 * q3) * (-(q0**2) - q1**2 + q2**2 + q3**2)
    m2 = q0**4 - q1**4 + 6 * q1**2 * q2**2 - q2**4 - 6 * q0**2 * q3**2 + q3**4
    m3 = q0**3 * q1 + q0 * q1**3 - 3 * q0 * q1 * q2**2 + 3 * q0**2 * q2 * q3
    m3 = 2 * (m3 + 3 * q1**2 * q2 * q3 - q2**3 * q3 - 3 * q0 * q1 * q3**2 - q2 * q3**3)
    m4 = 2 * (q1 * q2 + q0 * q3) * (q0**2 - q1**2 + q2**2 - q3**2)
    m5 = -(q0**3) * q2 + 3 * q0 * q1**2 * q2 - q0 * q2**3 + 3 * q0**2 * q1 * q3
    m5 = 2 * (m5 - q1**3 * q3 + 3 * q1 * q2**2 * q3 + 3 * q0 * q2 * q3**2 - q1 * q3**3)
    m6 = 4 * (-q0 * q2 + q1 * q3) * (q0 * q1 + q2 * q3)
    return np.stack([m1, m2, m3, m4, m5, m6], -1)


def zero_skew_rows_by_quaternion(rotations: ArrayLike) -> Array:
    """Rows (..., 6) of R (..., 3, 3) by way of quaternions: must equal `zero_skew_rows`; its cross-check."""
    # The paper's R(q) is Hamilton's transposed, so Hamilton's q of R^T is the paper's q of R.
    return zero_skew_polynomials(quaternion.from_rotation(np.swapaxes(np.asarray(rotations, float), -1, -2)))


def common_axis(rotations: ArrayLike, *, tolerance_rad: float = np.deg2rad(3.0)) -> Array:
    """Unit axis (3,) that all turns of R (n, 3, 3) against the first share, NaN if they differ or nothing turned.

    tolerance_rad: angle between the axis and the longest turn's; a shorter turn may be off it by as much in rad as that
    is for the longest, because noise tilts its axis more. Turns below 1e-6 rad have no axis.
    """
    R = np.asarray(rotations, float)
    w = rotation.log(R @ R[0].T)
    w = w[np.linalg.norm(w, axis=-1) > 1e-6]
    if not len(w):
        return np.full(3, np.nan)
    # Long turns know their axis best; the sign of an axis is none.
    axis = np.linalg.svd(w)[2][0]
    across = np.linalg.norm(np.cross(w, axis), axis=-1)
    longest = np.linalg.norm(w, axis=-1).max()
    return axis if np.all(across < np.sin(tolerance_rad) * longest) else np.full(3, np.nan)


def free_intrinsics(null_space: ArrayLike, *, tolerance: float = 1e-3) -> tuple[str, ...]:
    """Which of fx, fy, cx, cy of the reference view the null space (k, 3, 3) leaves open.

    P -> P Q with (Q Q^T)^-1 = L turns the image of the absolute conic of view 0 from K^-T K^-1 into K^-T L K^-1. To
    first order about L = I: L11 - L33 moves fx, L22 - L33 fy, L13 cx, L23 cy; the multiple of I moves nothing.
    """
    L = np.asarray(null_space, float).reshape(-1, 3, 3)
    moved = np.stack([L[:, 0, 0] - L[:, 2, 2], L[:, 1, 1] - L[:, 2, 2], L[:, 0, 2], L[:, 1, 2]], -1)  # (k, 4)
    return tuple(
        name
        for name, column in zip(("fx", "fy", "cx", "cy"), moved.T, strict=True)
        if np.linalg.norm(column) > tolerance
    )


def _needed(R: Array, free: tuple[str, ...], square_pixels: bool) -> str:
    if not free:
        return ""
    axis = common_axis(R)
    if not np.any(rotation.angle_between(R, R[0]) > 1e-6):
        return "The camera must turn: a pan or a tilt, better both."
    if np.isfinite(axis).all():
        k = int(np.argmax(np.abs(axis)))
        if np.abs(axis[k]) > np.cos(np.deg2rad(3.0)):
            only = f"All turns are {AXIS_NAMES[k]}. "
            if k == 2:
                return only + "A pan or a tilt is needed: roll moves no point off its circle."
            if square_pixels:
                return only + "A third view, or a principal point shared by the views, is needed."
            other = AXIS_NAMES[1 - k]
            return only + f"A {other} and a roll are needed, or square pixels and a shared principal point."
        if not square_pixels:
            return "All turns share one oblique axis. Turns about a second one are needed, and roll."
    if square_pixels:
        return "A third view in another direction, or a principal point shared by the views, is needed."
    return "Roll of several degrees is needed between the views, or a known aspect (square pixels)."


def observability(
    rotations: ArrayLike, *, square_pixels: bool = False, tolerance: float = 1e-3
) -> Observability:
    """Rank and null space of the zero-skew conditions of rotations (n, 3, 3), the reference view included.

    rotations: R_cam_world, dimensionless; square_pixels adds the second condition per view (known aspect, pixels
    squared up). tolerance: singular values of M / sqrt(n) below it count as zero. Raises ValueError for another shape.
    Source: Seo, Ahn, Hong 2000, theorem of Sect. 3, eq. (19); calibration.md 2.5 for square pixels.
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
    for k, (i, j) in enumerate(_PAIRS):
        L[:, i, j] = L[:, j, i] = null[:, k]
    words = WORDS_SQUARE if square_pixels else WORDS
    free = free_intrinsics(L)
    return Observability(
        singular_values=s, rank=rank, null_space=L, sentence=words.get(rank, words[max(words)]),
        free=free, needed=_needed(R, free, square_pixels),
    )  # fmt: skip
