"""Gauss-Newton on normal equations: the step, its decrement, and when to stop. No images."""

from __future__ import annotations

import numpy as np

from mosaic.records import FloatArray


def newton_step(N: FloatArray, b: FloatArray, damping: float) -> FloatArray | None:
    """Solve (N + damping diag N) d = b after scaling the diagonal to one; None when singular or not finite."""
    diagonal = np.diag(N)
    if not np.all(np.isfinite(N)) or np.any(diagonal <= 0):
        return None
    s = 1.0 / np.sqrt(diagonal)
    M = N * s[:, None] * s[None, :]
    M[np.diag_indices_from(M)] += damping + 1e-9
    try:
        return s * np.linalg.solve(M, s * b)
    except np.linalg.LinAlgError:
        return None


def step_in_sigmas(N: FloatArray, step: FloatArray, variance: float) -> float:
    """Length of a step against its own standard deviation: sqrt(d^T N d / (p variance)). No unit."""
    return float(np.sqrt(max(step @ N @ step, 0.0) / (len(step) * max(variance, 1e-12))))
