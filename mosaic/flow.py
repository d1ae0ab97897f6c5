"""The residual-flow grid of an aligned pair: where each textured cell was found, whatever the family could express."""

from __future__ import annotations

from typing import Any

import numpy as np

from mosaic.level import LevelPair, Linearised, RegisterOptions
from mosaic.records import N_CELLS, FlowGrid


def measure_flow(pair: LevelPair, state: Any, fine: Linearised, options: RegisterOptions) -> FlowGrid:
    """Residual flow per cell with its anisotropic information (real-footage.md 6.3), from the alignment `fine`.

    Several local passes, each resampled at the flow found so far: robust weights at the family's own warp would
    down-weight just those pixels that disagree with it, and so pull the measurement towards the model (measured: half
    of a wrong lens' flow was lost, and the focal with it).
    """
    level, kernel = pair.pixels, pair.kernel
    shift = np.zeros((N_CELLS, 2))
    moved = fine.dst
    residual, G = fine.residual, fine.G
    scale = fine.scale
    for _ in range(options.flow_passes):
        weight = kernel.robust_weights(residual, np.float32(scale), True)
        sums, b, S, counts = kernel.accumulate_cells(
            residual, G, weight, level.src_px, moved, level.cell, N_CELLS
        )
        step, vectors, std2, known = kernel.cell_steps(
            sums, b, options.correlation * scale**2, options.cell_max_px
        )
        shift = shift + np.clip(step, -1.5, 1.5)
        residual, G, moved = kernel.linearise_cells(
            *pair.picture, fine.dst, shift, level.cell, fine.A, level.values, level.gradients,
            pair.gain, pair.offset, *pair.masks,
        )  # fmt: skip
        scale, n_valid = kernel.robust_scale(residual)
        if n_valid < options.min_pixels:
            return FlowGrid.empty()
    info = np.where(known, 1.0 / (std2 + options.cell_floor_px**2), 0.0)
    keep = (S[:, 0] > 0) & (counts[:, 1] >= 6) & known.any(axis=1)
    # A shift beyond the linear range is no measurement, nor is one that still moves.
    keep &= (np.abs(shift).max(axis=1) <= options.cell_linear_px) & (np.abs(step).max(axis=1) < 0.25)
    if not keep.any():
        return FlowGrid.empty()
    src_px = S[keep, 1:3] / S[keep, 0:1]
    # The warp of the centroid, not the centroid of the warped pixels: over a cell of 240 px a pan of 8 degrees bends
    # the warp by .3 px, always to the same side (measured: 1.6 % of focal).
    family = pair.source.family
    where, _, _ = family.warp(state, family.prepare(src_px))
    vectors = vectors[keep]
    return FlowGrid(
        src_px=src_px,
        dst_px=where + shift[keep],
        info=(vectors * info[keep, None, :]) @ vectors.transpose(0, 2, 1),
        weight=(counts[keep, 1] / np.maximum(counts[keep, 0], 1.0)),
        cell=np.flatnonzero(keep),
    )
