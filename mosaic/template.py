"""A picture reduced to what registration needs of it: its most informative pixels on every level.

About 12,000 pixels (0.4 MB) stand for a frame, so a shot's keyframes cost next to nothing to keep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic import kernel_numba as kernel
from mosaic.coords import to_full, to_level
from mosaic.pyramid import Pyramid
from mosaic.records import GRID_COLUMNS, GRID_ROWS, FloatArray
from mosaic.warp import WarpFamily

_NO_MASK = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectionOptions:
    """Which pixels stand for a picture.

    n_per_level: wanted pixels from the finest level on (performance.md 2: 6,000 + 3,400 reach the codec's limit).
    threshold_grey: least gradient over two pixels; 6 keeps weak grass texture, 8 leaves the pitch empty.
    """

    n_per_level: tuple[int, ...] = (6000, 3400, 2000, 1000, 600, 400)
    threshold_grey: float = 6.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateLevel:
    """Chosen pixels of one level. src_px (n, 2) full px; values (n,); gradients (n, 2) per full px; cell (n,)."""

    src_px: FloatArray
    values: NDArray[np.float32]
    gradients: NDArray[np.float32]
    cell: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template:
    """The registration template of a frame: pixels per level (None = level not built) and a coarse even sample.

    wide_px (m, 2) full px with wide_values (m,) on level wide_level: for gain and offset. blocks: the pyramid's.
    """

    frame: int
    size_px: tuple[int, int]
    levels: tuple[TemplateLevel | None, ...]
    wide_px: FloatArray
    wide_values: NDArray[np.float32]
    wide_level: int
    blocks: float = 0.0


def mask_arguments(pyramid: Pyramid) -> tuple[NDArray[np.uint8], float, float, bool]:
    """(mask, full px per mask px in x and y, whether there is one) as the kernels take them."""
    if pyramid.mask is None:
        return _NO_MASK, 1.0, 1.0, False
    sx, sy = pyramid.mask_scale
    return pyramid.mask, sx, sy, True


def cells_of(points_px: FloatArray, size_px: tuple[int, int]) -> NDArray[np.int64]:
    """Cell row * 8 + column of the 8x5 grid over a w x h picture, for points (n, 2)."""
    w, h = size_px
    column = np.clip((points_px[:, 0] + 0.5) * GRID_COLUMNS / w, 0, GRID_COLUMNS - 1).astype(np.int64)
    row = np.clip((points_px[:, 1] + 0.5) * GRID_ROWS / h, 0, GRID_ROWS - 1).astype(np.int64)
    return row * GRID_COLUMNS + column


def build_template(
    pyramid: Pyramid,
    frame: int,
    *,
    options: SelectionOptions | None = None,
    levels: Sequence[int] | None = None,
) -> Template:
    """Choose the pixels of a pyramid: the strongest gradient of every bin of a regular grid, per level.

    levels: which levels to build (default all). Bins, not a global ranking: an even spread is worth more to the
    geometry than the last strong edge in a crowd.
    """
    options = options or SelectionOptions()
    wanted = range(len(pyramid.levels)) if levels is None else levels
    built: list[TemplateLevel | None] = [None] * len(pyramid.levels)
    for index in wanted:
        built[index] = _build_level(pyramid, index, options)
    mask, mask_sx, mask_sy, use_mask = mask_arguments(pyramid)
    wide_level = min(len(pyramid.levels) - 1, 3)
    wide_px, wide_values = _wide_sample(pyramid, wide_level, mask, mask_sx, mask_sy, use_mask)
    return Template(
        frame=frame,
        size_px=pyramid.size_px,
        levels=tuple(built),
        wide_px=wide_px,
        wide_values=wide_values,
        wide_level=wide_level,
        blocks=pyramid.blocks,
    )


def with_level(
    template: Template, pyramid: Pyramid, index: int, *, options: SelectionOptions | None = None
) -> Template:
    """The template with one more level of the pyramid that it was built from."""
    built = list(template.levels)
    built[index] = _build_level(pyramid, index, options or SelectionOptions())
    return replace(template, levels=tuple(built))


def _build_level(pyramid: Pyramid, index: int, options: SelectionOptions) -> TemplateLevel:
    mask, mask_sx, mask_sy, use_mask = mask_arguments(pyramid)
    level, scale = pyramid.levels[index], pyramid.scales[index]
    h, w = level.shape
    n = options.n_per_level[min(index, len(options.n_per_level) - 1)]
    bin_px = max(2, round((w * h / n) ** 0.5))
    threshold = np.float32(options.threshold_grey)
    x, y, values, gx, gy = kernel.select_pixels(
        level, bin_px, threshold, mask, scale[0] / mask_sx, scale[1] / mask_sy, use_mask
    )
    src = to_full(np.stack([x, y], axis=1).astype(np.float64), scale)
    return TemplateLevel(
        src_px=src,
        values=values,
        gradients=np.stack([gx / np.float32(scale[0]), gy / np.float32(scale[1])], axis=1),
        cell=cells_of(src, pyramid.size_px),
    )


def _wide_sample(
    pyramid: Pyramid, index: int, mask: NDArray[np.uint8], mask_sx: float, mask_sy: float, use_mask: bool
) -> tuple[FloatArray, NDArray[np.float32]]:
    level = pyramid.levels[index]
    scale = pyramid.scales[index]
    h, w = level.shape
    # Two px from the sides; the coarse level of a very small picture has not that many.
    left, top = min(2, (w - 1) // 2), min(2, (h - 1) // 2)
    xs = np.linspace(left, w - 1 - left, 32).round()
    ys = np.linspace(top, h - 1 - top, 18).round()
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    full = to_full(grid, scale)
    at = to_level(full, scale).round().astype(int)
    values = level[at[:, 1], at[:, 0]].astype(np.float32)
    if use_mask:
        mx = np.minimum(mask.shape[1] - 1, ((full[:, 0] + 0.5) / mask_sx).astype(int))
        my = np.minimum(mask.shape[0] - 1, ((full[:, 1] + 0.5) / mask_sy).astype(int))
        keep = mask[my, mx] > 0
        full, values = full[keep], values[keep]
    return np.ascontiguousarray(full), values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedTemplate:
    """A template with a family's precomputations, made once and used for every target it is registered to."""

    template: Template
    family: WarpFamily
    prepared: tuple[Any, ...]
    prepared_wide: Any


def prepare(template: Template, family: WarpFamily) -> PreparedTemplate:
    """Bind a template to a warp family."""
    return PreparedTemplate(
        template=template,
        family=family,
        prepared=tuple(None if lev is None else family.prepare(lev.src_px) for lev in template.levels),
        prepared_wide=family.prepare(template.wide_px),
    )
