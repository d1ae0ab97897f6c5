"""The part of a panorama that is seen without a gap: the largest upright rectangle inside what the frames cover."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mosaic.composite import Panorama


def crop_inside(panorama: Panorama, *, step_px: int | None = None) -> Panorama:
    """The panorama cut to the largest rectangle of pixels that were all seen; every pixel keeps its ray.

    step_px: the rectangle's sides lie on multiples of it (default: a 400th of the longer side, finer where no cell of
    that size is seen whole). The arrays are views of the panorama's. Raises ValueError when nothing was seen.
    """
    height, width = panorama.alpha.shape
    step = max(1, max(height, width) // 400) if step_px is None else step_px
    top, left, high, wide = largest_rectangle(_seen_cells(panorama.alpha, step))
    while not high:
        if step == 1:
            raise ValueError("nothing of the panorama was seen: there is nothing to crop to")
        step //= 2
        top, left, high, wide = largest_rectangle(_seen_cells(panorama.alpha, step))
    box = np.s_[top * step : (top + high) * step, left * step : (left + wide) * step]
    surface = panorama.surface
    return replace(
        panorama,
        image=panorama.image[box],
        alpha=panorama.alpha[box],
        n_seen=panorama.n_seen[box],
        spread=panorama.spread[box],
        deep=None if panorama.deep is None else panorama.deep[box],
        surface=replace(
            surface,
            cx=surface.cx - left * step,
            cy=surface.cy - top * step,
            width=wide * step,
            height=high * step,
        ),
    )


def _seen_cells(alpha: NDArray[np.uint8], step: int) -> NDArray[np.bool_]:
    """Cells of step x step px that were seen whole. Row by row: the picture may be larger than memory."""
    rows, columns = (n // step for n in alpha.shape)
    cells = np.zeros((rows, columns), bool)
    for i in range(rows):
        strip = alpha[i * step : (i + 1) * step, : columns * step]
        cells[i] = (strip.reshape(step, columns, step) > 0).all(axis=(0, 2))
    return cells


def largest_rectangle(cells: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """top, left, rows, columns of the largest all-True rectangle of cells (h, w); zeros where there is none.

    Row by row, the heights of the columns of True cells that end there; the widest stretch of each height by a stack.
    """
    best = (0, 0, 0, 0)
    heights = np.zeros(cells.shape[1] + 1, np.int64)  # one more of height 0 ends every stretch
    for row, line in enumerate(cells):
        heights[:-1] = np.where(line, heights[:-1] + 1, 0)
        stack: list[tuple[int, int]] = []  # (first column, height), heights rising
        for column, high in enumerate(heights.tolist()):
            first = column
            while stack and stack[-1][1] >= high:
                first, tall = stack.pop()
                if tall * (column - first) > best[2] * best[3]:
                    best = (row - tall + 1, first, tall, column - first)
            stack.append((first, high))
    return best
