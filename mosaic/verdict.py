"""What an alignment is worth: its residuals against those of the pictures shifted, and the information it holds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.level import LevelPair, Linearised
from mosaic.photometric import TUKEY
from mosaic.records import N_CELLS, FloatArray

# Error of a cell's place that all its pixels share (sampling, codec, crowd), px a grey level of residuals that agree:
# the codec leaves more of both. Measured on 720p pairs; without it the mean of chi^2 / 8 is 4, at 8 Mbit/s 7.
CELL_PX_PER_GREY = 0.009

REGIONS, REGION_PIXELS = (16, 10), 15  # columns and rows; fewer pixels than that say nothing of a region

_SHIFTS = np.array([[13.0, 5.0], [-13.0, -5.0], [7.0, -11.0], [-7.0, 11.0]])  # px at W = 1280


def alignment_score(pair: LevelPair, fine: Linearised) -> float:
    """Residual scale over the residual scale of the same pair shifted by a dozen pixels (the null); NaN: unknown."""
    level = pair.pixels
    stride = max(1, len(level.values) // 1500)
    shifts = _SHIFTS * max(1.0, pair.target.size_px[0] / 1280.0)
    null, n = pair.kernel.robust_scale(
        pair.kernel.shifted_residuals(
            *pair.picture, fine.dst, shifts, stride, level.values, pair.gain, pair.offset, *pair.masks
        )
    )
    return fine.scale / null if n >= 40 else float("nan")


def regional_evidence(pair: LevelPair, fine: Linearised) -> float:
    """How surely regions all over the overlap agree better at `fine` than shifted, in deviations; NaN: too few.

    Of every region of a REGIONS grid that has enough pixels: Tukey's mean cost at fine.sigma, less than that of the
    shifted pictures; the mean over the regions against its own standard error. Things that move agree by chance
    here and there, a scene wherever it is seen, however small its share of the pixels.
    """
    level, kernel = pair.pixels, pair.kernel
    columns, rows = REGIONS
    w, h = pair.source.template.size_px
    x, y = ((level.src_px + 0.5) * np.array([columns / w, rows / h])).astype(np.int64).T
    region = np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)
    shifts = _SHIFTS * max(1.0, pair.target.size_px[0] / 1280.0)
    shifted = kernel.shifted_residuals(
        *pair.picture, fine.dst, shifts, 1, level.values, pair.gain, pair.offset, *pair.masks
    ).reshape(len(shifts), -1)
    seen = np.isfinite(fine.residual) & np.isfinite(shifted).all(axis=0)
    agreement = [
        np.bincount(region[seen], _tukey_agreement(r[seen], fine.sigma), columns * rows)
        for r in (fine.residual, *shifted)
    ]
    n = np.bincount(region[seen], minlength=columns * rows)
    enough = n >= REGION_PIXELS
    if enough.sum() < 8:
        return float("nan")
    better = ((agreement[0] - np.mean(agreement[1:], axis=0)) / np.maximum(n, 1))[enough]
    return float(better.mean() / max(better.std(ddof=1) / np.sqrt(len(better)), 1e-9))


def _tukey_agreement(residual: NDArray[np.float32], sigma: float) -> FloatArray:
    """1 less Tukey's cost of each residual."""
    u = np.minimum(np.abs(residual.astype(np.float64)) / (TUKEY * sigma), 1.0)
    return np.asarray((1.0 - u * u) ** 3)


def pixel_information(pair: LevelPair, state: Any, fine: Linearised, anchors: FloatArray) -> FloatArray:
    """Information (2k, 2k) px^-2 of where k = 4 anchors land, from the pixels' normal equations at `fine`.

    Residuals are no independent draws: the blur, the codec and whoever walks through the picture tie neighbours
    together. So the variance of the normal equations' right side is not sigma^2 N but what the 40 cells' own sums say
    it is (calibration.md 7.3): kappa = trace(N^-1 sum_c s_c s_c^T) / p, a mean over the p directions because 40 cells
    cannot tell them apart. To it comes CELL_PX_PER_GREY. Zeros where the pixels do not determine the anchors.
    """
    level, kernel = pair.pixels, pair.kernel
    weight = kernel.robust_weights(fine.residual, np.float32(fine.sigma), True)
    N, _, _ = kernel.accumulate(fine.residual, fine.G, fine.J, weight)
    scores = kernel.cell_scores(fine.residual, fine.G, fine.J, weight, level.cell, N_CELLS)
    p = len(N)
    n_cells = int(np.any(scores != 0, axis=1).sum())
    _, J, _ = pair.source.family.warp(state, pair.source.family.prepare(anchors))
    J8 = J.reshape(-1, p).astype(np.float64)
    unknown = np.zeros((len(J8), len(J8)))
    if n_cells * 2 <= p or np.linalg.matrix_rank(N, hermitian=True) < p:
        return unknown
    # What no residual shows: every cell as a whole may be off by some hundredths of a pixel.
    moments = kernel.cell_moments(fine.G, fine.J, weight, level.cell, N_CELLS)
    common = (CELL_PX_PER_GREY * fine.sigma) ** 2 * np.einsum("cak,cbk->ab", moments, moments)
    # 2 n equations of p parameters: the sums at the optimum are smaller than the errors by that share.
    share = 2 * n_cells / (2 * n_cells - p)
    kappa = share * float(np.einsum("ca,ca->", scores, np.linalg.solve(N, scores.T).T)) / p
    variance = max(kappa, fine.sigma**2)
    inverse = np.linalg.inv(N)
    covariance = J8 @ (variance * inverse + inverse @ common @ inverse) @ J8.T
    # Anchors at the horizon of a wrong homography move by anything.
    if not np.isfinite(covariance).all() or not np.linalg.cond(covariance) < 1e14:
        return unknown
    return np.linalg.inv(covariance)
