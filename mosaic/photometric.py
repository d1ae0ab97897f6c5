"""Gain and offset between two pictures, from smooth values spread evenly over the overlap.

Not from the selected pixels and not as free parameters of the alignment: those pixels are gradient maxima, so any
decorrelation pulls a regressed gain below one, the alignment blurs, and the gain drifts on from pair to pair
(real-footage.md 7.4). The ratio of robust spreads of coarse values has no such pull.
"""

from __future__ import annotations

import numba as nb
import numpy as np

# The scale of residuals comes from the 30 % quantile of their size, not the median: players hold most of the strong
# gradients where the pitch shows none, and up to two thirds of the chosen pixels may move on their own.
SCALE_QUANTILE = 0.3
NORMAL_QUANTILE = 0.38532  # of |x|, x standard normal
TUKEY = 4.685  # width of the weights in deviations: 95 % efficiency on normal residuals
TUKEY_VARIANCE = 0.82807  # weighted variance of standard normal residuals under them


@nb.njit(cache=True, nogil=True)
def estimate_gain(template, target):  # type: ignore[no-untyped-def]
    """(gain, offset) with template ~ gain * target + offset; NaN in `target` marks points outside.

    template, target: (n,) float32. Reduced major axis under Tukey weights, four passes; the gain is drawn to 1 by a
    prior of 2 %, so that a picture without exposure change gets none. Returns (1, 0) on fewer than 40 common points.
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
        u = r / (4.685 * scale)
        w = np.maximum(1.0 - u * u, 0.0) ** 2
        total = w.sum()
        if total < 20:
            return 1.0, 0.0
        mean_t = (w * t).sum() / total
        mean_i = (w * i).sum() / total
        var_t = (w * (t - mean_t) ** 2).sum()
        var_i = (w * (i - mean_i) ** 2).sum()
        raw = np.sqrt(var_t / var_i) if var_i > 1e-9 else 1.0
        away = (raw - 1.0) ** 2
        gain = min(max(1.0 + (raw - 1.0) * away / (away + 0.02**2), 0.4), 2.5)
        offset = mean_t - gain * mean_i
    return gain, offset
