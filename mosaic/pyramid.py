"""Gray pyramids by area averaging. Level 0 is the picture itself (lightly smoothed on request)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import level_scale


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pyramid:
    """levels[0] is full size, each next about half; uint8 or float32. scales[l] as `coords.level_scale`.

    mask: (h, w) uint8 at quarter size, 1 = usable, or None when every pixel is. blocks: coded.blockiness of the picture
    before the blur; 0 also where nobody asked for it.
    """

    levels: tuple[NDArray[np.generic], ...]
    scales: tuple[tuple[float, float], ...]
    size_px: tuple[int, int]
    mask: NDArray[np.uint8] | None
    blocks: float = 0.0

    @property
    def mask_scale(self) -> tuple[float, float]:
        """Scale of `mask` against the full size ((1, 1) when there is none)."""
        if self.mask is None:
            return 1.0, 1.0
        return level_scale(self.size_px, (self.mask.shape[1], self.mask.shape[0]))


def n_levels_for(size_px: tuple[int, int], coarsest_px: int = 120) -> int:
    """Levels until the width is about `coarsest_px`: 5 at 1920, 4 at 1280 and 640."""
    return max(2, 1 + int(np.floor(np.log2(max(size_px[0], 1) / coarsest_px) + 0.01)))


def build_pyramid(
    gray: NDArray[np.generic],
    *,
    n_levels: int | None = None,
    smooth: bool = True,
    mask: NDArray[np.bool_] | None = None,
) -> Pyramid:
    """Pyramid of a gray picture (h, w), uint8 or float32 with values 0..255.

    smooth: 3x3 binomial blur of level 0. Bilinear sampling of an unsmoothed picture is biased towards whole
    pixels; the blur takes that away at no cost in accuracy (performance.md 1). mask: (h, w), True = usable.
    Raises ValueError for another shape or type.
    """
    if gray.ndim != 2:
        raise ValueError(f"gray picture expected, got shape {gray.shape}")
    if gray.dtype != np.uint8 and gray.dtype != np.float32:
        raise ValueError(f"uint8 or float32 expected, got {gray.dtype}")
    size_px = (gray.shape[1], gray.shape[0])
    count = n_levels_for(size_px) if n_levels is None else n_levels
    first: Any = cv2.GaussianBlur(cast(Any, gray), (3, 3), 0) if smooth else np.ascontiguousarray(gray)
    levels: list[Any] = [first]
    for _ in range(count - 1):
        h, w = levels[-1].shape
        levels.append(cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA))
    scales = tuple(level_scale(size_px, (level.shape[1], level.shape[0])) for level in levels)
    small = None
    if mask is not None:
        if mask.shape != gray.shape:
            raise ValueError(f"mask {mask.shape} does not match the picture {gray.shape}")
        small = quarter_mask(mask)
    return Pyramid(levels=tuple(levels), scales=scales, size_px=size_px, mask=small)


def with_scene(pyramid: Pyramid, scene: NDArray[np.uint8]) -> Pyramid:
    """A pyramid whose mask leaves out what is no scene; scene at the size of that mask, 1 = scene."""
    return replace(pyramid, mask=scene if pyramid.mask is None else np.minimum(scene, pyramid.mask))


def block_minimum(plane: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The least of each side x side block of a plane (h, w); the last ones may be smaller."""
    # An erosion that looks right and down, at every side-th pixel: twenty times as fast as numpy's min over blocks.
    least = cv2.erode(plane, np.ones((side, side), np.uint8), anchor=(0, 0))
    return np.ascontiguousarray(least[::side, ::side], np.uint8)


def quarter_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Mask (h, w) at quarter size, 1 = usable; a quarter pixel is usable only when all of it is."""
    h, w = mask.shape
    if h % 4 == 0 and w % 4 == 0:
        # Four columns are one word: a tenth of the time of the least of each block.
        rows = np.ascontiguousarray(mask).view(np.uint32).reshape(h // 4, 4, w // 4)
        return (np.bitwise_and.reduce(rows, axis=1) == 0x01010101).view(np.uint8)
    size = ((w + 3) // 4, (h + 3) // 4)
    return (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999).astype(np.uint8)
