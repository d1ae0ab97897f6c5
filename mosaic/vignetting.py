"""The lens's falloff of light towards the corners, from the overlaps: what no gain of a whole frame explains.

v(r) = exp(a r^2 + b r^4) multiplies the scene's colours, r in half widths of the frame from its middle, one falloff
for the whole shot. As a logarithm it is linear beside the frames' gains and the points' colours, and solved together
with them. In a pan the part of r^2 that belongs to the frame alone goes into its gain, the part that belongs to the
point alone into its colour; the product of the two is left, and shows a falloff. A camera that stands still shows
none. It knows no zoom and no iris: of a lens whose falloff changes within the shot it gives the mean.

Source: the even polynomial of Goldman, "Vignette and exposure calibration and compensation", PAMI 2010, as a logarithm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mosaic.gains import gain_weights

N_BLOCKS = 12  # of the panorama, left out in turn
CERTAIN = 4.0  # times its own standard deviation: a coefficient below is held at 0
LEAST = 0.01  # log of the light in the corner: 1 % is a grey level, and nothing that is seen
NONE = np.zeros(2)  # no falloff
NONE.setflags(write=False)


def radius_squared(xy: NDArray[np.float64], size_px: tuple[int, int]) -> NDArray[np.float64]:
    """r^2 in half widths at pixels xy (..., 2) of a frame."""
    off = (xy - (np.array(size_px) - 1) / 2) / (size_px[0] / 2)
    return np.asarray((off**2).sum(axis=-1))


def corner(size_px: tuple[int, int]) -> float:
    """r^2 in a frame's corner."""
    return float(1 + (size_px[1] / size_px[0]) ** 2)


def log_falloff(falloff: NDArray[np.float64], r2: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """log v at r^2, of the coefficients (a, b)."""
    return np.asarray(falloff[0] * np.asarray(r2) + falloff[1] * np.asarray(r2) ** 2)


def solve_falloff(
    log_samples: NDArray[np.floating],
    weight: NDArray[np.floating],
    r2: NDArray[np.floating],
    block: NDArray[np.intp],
    corner_r2: float,
    *,
    prior_std: float = 0.3,
    noise_std: float = 0.05,
    n_steps: int = 6,
) -> NDArray[np.float64]:
    """(a, b) of the falloff from log intensities of the same points in many frames; zeros where none is certain.

    log_samples, weight, r2 (n, p): frame i at point j, weight 0 where not seen. block (p,): which of N_BLOCKS parts of
    the scene a point belongs to. Minimises what gains.solve_log_gains does, with a r^2 + b r^4 beside the gains and
    the same prior on every unknown. Standard deviations come from leaving out the blocks in turn, because the errors of
    neighbouring points go together. Taken is r^2 and r^4 where the second is certain too, else r^2 alone; only what
    darkens all the way to the corner, and there by more than LEAST, is a lens.
    """
    y: NDArray[np.float32] = np.asarray(log_samples, dtype=np.float32)
    base: NDArray[np.float32] = np.asarray(weight, dtype=np.float32)
    shared = (base > 0).sum(axis=0) >= 2
    if not shared.any():
        return NONE
    y, base, block = np.asarray(y[:, shared]), base[:, shared], block[shared]
    radius = np.asarray(r2[:, shared], dtype=np.float32)
    basis = np.stack([radius, radius**2])
    n, ridge = len(y), (noise_std / prior_std) ** 2
    prior = ridge * np.eye(n + 2)
    robust = base
    for step in range(n_steps):
        parts = [_normal(y, robust, basis, np.flatnonzero(block == k)) for k in range(N_BLOCKS)]
        normal, right = _total(parts, prior)
        solution = np.linalg.solve(normal, right)
        if step < n_steps - 1:
            gain, (a, b) = solution[:n], -solution[n:]
            adjusted = y + (gain[:, None] - a * basis[0] - b * basis[1]).astype(np.float32)
            robust = gain_weights(adjusted, robust, base, step, n_steps)
    for n_terms in (2, 1):
        keep = np.arange(n + n_terms)
        terms, std = _jackknife(parts, prior, keep, n)
        falloff = np.zeros(2)
        falloff[:n_terms] = terms
        slopes = falloff[0] + 2 * falloff[1] * np.linspace(0, corner_r2, 9)
        if abs(terms[-1]) > CERTAIN * std[-1] and slopes.max() <= 0:
            return falloff if log_falloff(falloff, corner_r2) < -LEAST else NONE
    return NONE


_Normal = tuple[NDArray[np.float64], NDArray[np.float64]]  # matrix and right side


def _normal(
    y: NDArray[np.float32], robust: NDArray[np.float32], basis: NDArray[np.float32], points: NDArray[np.intp]
) -> _Normal:
    """Normal matrix (n + 2, n + 2) and right side of some points, their colours eliminated; unknowns: gains, -a, -b."""
    y, robust, basis = y[:, points], robust[:, points], basis[:, :, points]
    n = len(y)
    share = robust / np.maximum(robust.sum(axis=0), 1e-9)
    centred = basis - (share * basis).sum(axis=1, keepdims=True)
    away = y - (share * y).sum(axis=0)
    normal, right = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
    normal[:n, :n] = -(robust @ share.T)
    normal[np.arange(n), np.arange(n)] += robust.sum(axis=1, dtype=np.float64)
    weighted = robust * centred
    normal[:n, n:] = weighted.sum(axis=2, dtype=np.float64).T
    normal[n:, :n] = normal[:n, n:].T
    normal[n:, n:] = np.einsum("knp,lnp->kl", weighted, centred, dtype=np.float64)
    right[:n] = -(robust * away).sum(axis=1, dtype=np.float64)
    right[n:] = -(weighted * away).sum(axis=(1, 2), dtype=np.float64)
    return normal, right


def _total(parts: list[_Normal], prior: NDArray[np.float64]) -> _Normal:
    normal = np.sum([p[0] for p in parts], axis=0)
    return np.asarray(normal + prior), np.asarray(np.sum([p[1] for p in parts], axis=0), np.float64)


def _jackknife(
    parts: list[_Normal],
    prior: NDArray[np.float64],
    keep: NDArray[np.intp],
    n: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The falloff's terms with only the unknowns `keep`, and their standard deviations by leaving out each block."""
    normal, right = _total(parts, prior)
    box = np.ix_(keep, keep)

    def solved(without: int | None) -> NDArray[np.float64]:
        matrix, side = (
            (normal, right) if without is None else (normal - parts[without][0], right - parts[without][1])
        )
        return np.asarray(-np.linalg.solve(matrix[box], side[keep])[n:], np.float64)

    left_out = np.array([solved(k) for k in range(len(parts))])
    variance = ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0) * (len(parts) - 1) / len(parts)
    return solved(None), np.asarray(np.sqrt(variance), np.float64)
