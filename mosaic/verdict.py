"""What an alignment is worth: its residuals against those of the pictures shifted, and the information it holds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.coded import DISPLACED, displacement_px
from mosaic.level import LevelPair, Linearised
from mosaic.photometric import TUKEY
from mosaic.records import N_CELLS, FloatArray

# Error of a cell's place that all its pixels share (sampling, crowd), px a grey level of residuals that agree. Without
# it the mean of chi^2 / 8 of clean pairs is 3.8 (30 pairs at 360p, where the codec has its own term below).
CELL_PX_PER_GREY = 0.004
# Columns and rows of a grid four times as fine as the cells: how residuals are correlated is seen between the two.
FINE_GRID = (32, 20)

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
    region = _grid(level.src_px, pair.source.template.size_px, REGIONS)
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


def pixel_information(
    pair: LevelPair, state: Any, fine: Linearised, anchors: FloatArray, noise_ratio: float = 1.0
) -> FloatArray:
    """Information (2k, 2k) px^-2 of where k = 4 anchors land, from the pixels' normal equations at `fine`.

    Residuals are no independent draws: the blur, the codec and whoever walks through the picture tie neighbours
    together. So the variance of the normal equations' right side is not sigma^2 N but what the 40 cells' own sums say
    it is (calibration.md 7.3): kappa = trace(N^-1 sum_c s_c s_c^T) / p, a mean over the p directions because 40 cells
    cannot tell them apart. To it comes CELL_PX_PER_GREY. Zeros where the pixels do not determine the anchors.

    What an encoder copies is correlated over more than a cell, and the homography takes part of that with it: unseen.
    Seen is how kappa grows from a grid four times as fine to the cells (1.1 on clean pairs, 2.3 at CRF 23 to 35). It
    grows on up to the size of the picture, five to eight cells: the covariance is multiplied by its square. Where the
    pictures show an encoder's blocks, these may be displaced besides (coded.displacement_px), together or apart.
    """
    level, kernel = pair.pixels, pair.kernel
    weight = kernel.robust_weights(fine.residual, np.float32(fine.sigma), True)
    N, _, _ = kernel.accumulate(fine.residual, fine.G, fine.J, weight)
    scores = kernel.cell_scores(fine.residual, fine.G, fine.J, weight, level.cell, N_CELLS)
    p = len(N)
    columns, rows = FINE_GRID
    small = kernel.cell_scores(
        fine.residual,
        fine.G,
        fine.J,
        weight,
        _grid(level.src_px, pair.source.template.size_px, FINE_GRID),
        columns * rows,
    )
    n_cells = int(np.any(scores != 0, axis=1).sum())
    _, J, _ = pair.source.family.warp(state, pair.source.family.prepare(anchors))
    J8 = J.reshape(-1, p).astype(np.float64)
    unknown = np.zeros((len(J8), len(J8)))
    if n_cells * 2 <= p or np.linalg.matrix_rank(N, hermitian=True) < p:
        return unknown
    # What no residual shows: every cell as a whole may be off by some hundredths of a pixel.
    moments = kernel.cell_moments(fine.G, fine.J, weight, level.cell, N_CELLS)
    unseen_grey = noise_ratio * fine.sigma
    common = (CELL_PX_PER_GREY * unseen_grey) ** 2 * np.einsum("cak,cbk->ab", moments, moments)
    kappa, kappa_small = _kappa(scores, N), _kappa(small, N)
    growth = max(1.0, kappa / kappa_small) if kappa_small > 0 else 1.0
    variance = max(kappa, fine.sigma**2)
    inverse = np.linalg.inv(N)
    covariance = growth**2 * (J8 @ (variance * inverse + inverse @ common @ inverse) @ J8.T)
    away_px = displacement_px(pair.source.template.blocks, pair.target.blocks, unseen_grey)
    if away_px > 0:
        covariance += away_px**2 * (J8 @ inverse @ _displaced(pair, fine, weight) @ inverse @ J8.T)
    # Anchors at the horizon of a wrong homography move by anything.
    if not np.isfinite(covariance).all() or not np.linalg.cond(covariance) < 1e14:
        return unknown
    return np.linalg.inv(covariance)


def _displaced(pair: LevelPair, fine: Linearised, weight: NDArray[np.float32]) -> FloatArray:
    """Covariance (p, p) of the right side if all cells of each of DISPLACED were off by one px, each on its own."""
    level, p = pair.pixels, fine.J.shape[2]
    total = np.zeros((p, p))
    for columns, rows in DISPLACED:
        cell = _grid(level.src_px, pair.source.template.size_px, (columns, rows))
        moments = pair.kernel.cell_moments(fine.G, fine.J, weight, cell, columns * rows)
        total += np.einsum("cak,cbk->ab", moments, moments)
    return total


def _kappa(scores: FloatArray, N: FloatArray) -> float:
    """Variance of the normal equations' right side, in units of N, from the sums (c, p) of the cells of a grid."""
    n, p = int(np.any(scores != 0, axis=1).sum()), len(N)
    # 2 n equations of p parameters: the sums at the optimum are smaller than the errors by that share.
    share = 2 * n / max(2 * n - p, 1)
    return share * float(np.einsum("ca,ca->", scores, np.linalg.solve(N, scores.T).T)) / p


def _grid(src_px: FloatArray, size_px: tuple[int, int], grid: tuple[int, int]) -> NDArray[np.int64]:
    """Cell row * columns + column of a grid (columns, rows) over a picture, for points (n, 2)."""
    x, y = ((src_px + 0.5) * np.array([grid[0] / size_px[0], grid[1] / size_px[1]])).astype(np.int64).T
    return np.asarray(np.clip(y, 0, grid[1] - 1) * grid[0] + np.clip(x, 0, grid[0] - 1), np.int64)
