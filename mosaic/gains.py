"""A gain for each frame that makes overlapping views agree, from log intensities of the same points in many frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def solve_log_gains(
    log_samples: NDArray[np.floating],
    weight: NDArray[np.floating],
    *,
    prior_std: float = 0.3,
    noise_std: float = 0.05,
    n_steps: int = 6,
) -> NDArray[np.float64]:
    """Log gain to ADD to each frame so that all agree, from log intensities of the same points in many frames.

    log_samples (n, p): frame i at point j; weight (n, p), 0 where not seen. Minimises sum w rho(y_ij + g_i - b_j) +
    (noise_std / prior_std)^2 sum g_i^2 over frame gains g and point colours b by iteratively reweighted least squares;
    the p colours are eliminated exactly, what is solved is n x n. Huber first, then Tukey: players must not pull.
    Returns (n,), median 0. A frame that shares no point with another gets 0 (before the median is taken off).
    """
    y = np.asarray(log_samples, dtype=np.float32)
    base = np.asarray(weight, dtype=np.float32)
    if y.shape != base.shape or y.ndim != 2:
        raise ValueError(f"samples {y.shape} and weights {base.shape} must be equal and two-dimensional")
    n = len(y)
    gain = np.zeros(n)
    shared = (base > 0).sum(axis=0) >= 2  # a point seen once says nothing
    y, base = y[:, shared], base[:, shared]
    if not shared.any():
        return gain
    ridge = (noise_std / prior_std) ** 2
    robust = base
    for step in range(n_steps):
        total = robust.sum(axis=0)
        share = robust / np.maximum(total, 1e-9)
        colour = (share * y).sum(axis=0)
        normal = -(robust @ share.T).astype(np.float64)
        normal[np.diag_indices(n)] += robust.sum(axis=1, dtype=np.float64) + ridge
        gain = np.linalg.solve(normal, -(robust * (y - colour)).sum(axis=1, dtype=np.float64))
        robust = gain_weights(y + gain[:, None].astype(np.float32), robust, base, step, n_steps)
    return gain - np.median(gain)


def gain_weights(
    adjusted: NDArray[np.float32],
    robust: NDArray[np.float32],
    base: NDArray[np.float32],
    step: int,
    n_steps: int,
) -> NDArray[np.float32]:
    """Weights (n, p) of the next of n_steps from samples as adjusted by this one: Huber, in the second half Tukey.

    robust, base (n, p): this step's weights, and those that the samples came with."""
    share = robust / np.maximum(robust.sum(axis=0), 1e-9)
    residual = adjusted - (share * adjusted).sum(axis=0)
    scale = max(1.4826 * float(np.median(np.abs(residual[base > 0]))), 0.005)
    ratio = np.abs(residual) / scale
    if step < n_steps // 2:
        return np.asarray(base / np.maximum(ratio / 1.5, 1.0), np.float32)
    return np.asarray(base * np.clip(1 - (ratio / 5.0) ** 2, 0.0, 1.0) ** 2, np.float32)
