"""Gauss-Newton on normal equations: the step, its decrement, and when to stop. No images."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from mosaic.records import FloatArray


@nb.njit(cache=True, nogil=True)
def _scaled_solve(N: Any, b: Any, damping: float) -> Any:
    """Cholesky solution after scaling the diagonal to one, and whether it went well."""
    p = len(b)
    s = np.empty(p)
    for i in range(p):
        if not N[i, i] > 0.0:
            return np.zeros(p), False
        s[i] = 1.0 / np.sqrt(N[i, i])
    L = np.zeros((p, p))
    for i in range(p):
        for j in range(i + 1):
            value = N[i, j] * s[i] * s[j]
            if i == j:
                value += damping + 1e-9
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                if not value > 0.0:
                    return np.zeros(p), False
                L[i, i] = np.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    y = np.empty(p)
    for i in range(p):
        value = b[i] * s[i]
        for k in range(i):
            value -= L[i, k] * y[k]
        y[i] = value / L[i, i]
    for i in range(p - 1, -1, -1):
        value = y[i]
        for k in range(i + 1, p):
            value -= L[k, i] * y[k]
        y[i] = value / L[i, i]
    for i in range(p):
        y[i] *= s[i]
    return y, bool(np.all(np.isfinite(y)))


def newton_step(N: FloatArray, b: FloatArray, damping: float) -> FloatArray | None:
    """Solve (N + damping diag N) d = b after scaling the diagonal to one; None when singular or not finite."""
    step, good = _scaled_solve(N, b, float(damping))
    return step if good else None


def step_in_sigmas(N: FloatArray, step: FloatArray, variance: float) -> float:
    """Length of a step against its own standard deviation: sqrt(d^T N d / (p variance)). No unit."""
    decrease = float(step @ N @ step)
    return float(np.sqrt(max(decrease, 0.0) / (len(step) * max(variance, 1e-12))))
