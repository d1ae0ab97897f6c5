"""What the first pass wants of a frame, made from its gray alone: pyramid, template, small pictures for a rescue and
for edits.

It knows nothing of the frames before, so that the next frame is prepared in a thread while this one is registered.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.pyramid import Pyramid, build_pyramid, quarter_mask
from mosaic.rescue import small_gray
from mosaic.template import SelectionOptions, Template, build_template
from pipelines.edits import EditPicture, edit_picture
from pipelines.errors import InputError
from pipelines.overlays import both_masks

SMALL_PX = 1280  # width below which a picture is small
LARGE_PX = 1600  # and from which it is large
LEAST_SIDE_PX = 8  # two pixels at a quarter of the size, where graphics are looked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedFrame:
    """A frame before registration. template: of the levels from `finest_of` on, for the frame after it; small: see
    small_gray; edit: what cuts and dissolves are found by; scene: at a quarter of the size, 1 = none of the people that
    are known (None: nothing is known)."""

    frame: int
    pts_s: float
    pyramid: Pyramid
    template: Template
    small: NDArray[np.uint8]
    edit: EditPicture
    scene: NDArray[np.uint8] | None = None

    @property
    def coarse(self) -> NDArray[np.generic]:
        """A quarter of the picture or less: to tell a repeated one."""
        return self.pyramid.levels[min(2, len(self.pyramid.levels) - 1)]


def refuse_tiny(path: Path, size_px: tuple[int, int]) -> None:
    """Raises InputError: pictures too small for a camera to be followed in them."""
    if min(size_px) < LEAST_SIDE_PX:
        cause = f"its pictures have {size_px[0]}x{size_px[1]} px"
        raise InputError(path, cause, f"a camera can be followed from {LEAST_SIDE_PX} px a side on")


def finest_of(size_px: tuple[int, int]) -> int:
    """The finest level on which neighbours are registered: the half size suffices from 1280 px of width on.

    At 480 px it does not: lines of the pitch are a pixel wide there, and players are not."""
    return 1 if size_px[0] >= SMALL_PX else 0


def finest_linked(size_px: tuple[int, int]) -> int:
    """The finest level on which frames are registered to their keyframe while the camera is only being followed.

    Of a large picture the half size: with the full one cameras come no nearer to the truth (1080p: zoom and corners
    alike to .001 % and .00 px) and a pair takes twice as long."""
    return 1 if size_px[0] >= LARGE_PX else 0


def prepare_frame(
    frame: int,
    pts_s: float,
    gray: NDArray[Any],
    *,
    selection: SelectionOptions,
    n_levels: int | None = None,
    mask: NDArray[np.bool_] | None = None,
    scene: NDArray[np.bool_] | None = None,
) -> PreparedFrame:
    """Pyramid, template and small picture of gray (h, w), uint8 or float32 0..255. mask (h, w): True = usable in all
    frames; scene (h, w): True = no people in this one."""
    pyramid = build_pyramid(gray, n_levels=n_levels, mask=both_masks(mask, scene))
    levels = tuple(range(finest_of(pyramid.size_px), len(pyramid.levels)))
    small = small_gray(pyramid)
    return PreparedFrame(
        frame=frame,
        pts_s=pts_s,
        pyramid=pyramid,
        template=build_template(pyramid, frame, options=selection, levels=levels),
        small=small,
        edit=edit_picture(small),
        scene=None if scene is None else quarter_mask(scene),
    )
