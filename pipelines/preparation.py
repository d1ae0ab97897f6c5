"""What registration wants of a frame, made from its gray alone: pyramid, template, a small picture for a rescue.

It knows nothing of the frames before, so that the next frame is prepared in a thread while this one is registered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.pyramid import Pyramid, build_pyramid
from mosaic.rescue import small_gray
from mosaic.template import SelectionOptions, Template, build_template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedFrame:
    """A frame before registration. template: of the levels from 1 on, for the frame after it; small: see small_gray."""

    frame: int
    pts_s: float
    pyramid: Pyramid
    template: Template
    small: NDArray[np.uint8]

    @property
    def coarse(self) -> NDArray[np.generic]:
        """A quarter of the picture or less: to tell a repeated one."""
        return self.pyramid.levels[min(2, len(self.pyramid.levels) - 1)]


def prepare_frame(
    frame: int,
    pts_s: float,
    gray: NDArray[Any],
    *,
    selection: SelectionOptions,
    n_levels: int | None = None,
    mask: NDArray[np.bool_] | None = None,
) -> PreparedFrame:
    """Pyramid, template and small picture of gray (h, w), uint8 or float32 0..255. mask (h, w): True = usable."""
    pyramid = build_pyramid(gray, n_levels=n_levels, mask=mask)
    levels = tuple(range(1, len(pyramid.levels)))
    return PreparedFrame(
        frame=frame,
        pts_s=pts_s,
        pyramid=pyramid,
        template=build_template(pyramid, frame, options=selection, levels=levels),
        small=small_gray(pyramid),
    )
