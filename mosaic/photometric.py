"""Gain and offset between two pictures, from smooth values spread evenly over the overlap.

Not from the selected pixels and not as free parameters of the alignment: those pixels are gradient maxima, so any
decorrelation pulls a regressed gain below one, the alignment blurs, and the gain drifts on from pair to pair
(real-footage.md 7.4). The ratio of robust spreads of coarse values has no such pull.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def estimate_gain(template: NDArray[np.float32], target: NDArray[np.float32]) -> tuple[float, float]:
    """(gain, offset) with template ~ gain * target + offset; NaN in `target` marks points outside.

    Reduced major axis under Tukey weights, four passes; the gain is drawn to 1 by a prior of 2 %, so that a
    picture without exposure change gets none. Returns (1, 0) on fewer than 40 common points.
    """
    good = np.isfinite(target)
    t = template[good].astype(np.float64)
    i = target[good].astype(np.float64)
    if len(t) < 40:
        return 1.0, 0.0
    gain = 1.0
    offset = float(np.median(t - i))
    for _ in range(4):
        r = t - gain * i - offset
        scale = max(1.4826 * float(np.median(np.abs(r - np.median(r)))), 0.5)
        w = np.clip(1.0 - (r / (4.685 * scale)) ** 2, 0.0, None) ** 2
        total = w.sum()
        if total < 20:
            return 1.0, 0.0
        mean_t, mean_i = (w @ t) / total, (w @ i) / total
        var_t, var_i = w @ (t - mean_t) ** 2, w @ (i - mean_i) ** 2
        raw = float(np.sqrt(var_t / var_i)) if var_i > 1e-9 else 1.0
        pull = (raw - 1.0) ** 2 / ((raw - 1.0) ** 2 + 0.02**2)
        gain = float(np.clip(1.0 + (raw - 1.0) * pull, 0.4, 2.5))
        offset = float(mean_t - gain * mean_i)
    return gain, offset
