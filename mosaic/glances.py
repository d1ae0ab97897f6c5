"""Where a shot's frames show the ground, told from small pictures of some of them, before it is known which are kept.

The frames of a panorama are chosen before anybody has seen them together. Small pictures of every few frames are enough
to find bodies in (moving.py, at a fraction of its scale), and to choose so that each place is seen clear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mosaic.composite import scene_of
from mosaic.framestore import FrameStore
from mosaic.motion import expand_map
from mosaic.moving import NEAR, find_still
from mosaic.surface import Placement, Surface
from mosaic.views import COVER_CELLS, CompositeOptions, ShownGround, clipped_ratio, resolution

STEP_CELLS = 8  # between exact points of a map
CELL_PX = 2.0  # least side of a cell, px of the small pictures
BORDER_PX = 1.0  # of a small picture, not looked at


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """A placement of the same frame with fewer pixels."""

    full: Placement
    size_px: tuple[int, int]

    @property
    def frame(self) -> int:
        return self.full.frame

    @property
    def px_per_rad(self) -> float:
        return self.full.px_per_rad * self.size_px[0] / self.full.size_px[0]

    @property
    def blur_px(self) -> float:
        return self.full.blur_px * self.size_px[0] / self.full.size_px[0]

    def _ratio(self) -> NDArray[np.float64]:
        return np.array(self.full.size_px) / np.array(self.size_px)

    def ray_to_pixel(self, rays: ArrayLike) -> NDArray[np.float64]:
        return (self.full.ray_to_pixel(np.asarray(rays, np.float64)) + 0.5) / self._ratio() - 0.5

    def pixel_to_ray(self, xy: ArrayLike) -> NDArray[np.float64]:
        return self.full.pixel_to_ray((np.asarray(xy, np.float64) + 0.5) * self._ratio() - 0.5)


def shown_ground(
    store: FrameStore, placements: Sequence[Placement], surface: Surface, options: CompositeOptions
) -> ShownGround | None:
    """Which cells of the surface the pictures of a store show clear; None where no picture sees the surface.

    store: of pictures smaller than the frames; colour is not needed. placements, surface: of the frames at full size.
    """
    views = [
        _Reduced(p, store.size_px)
        for p in sorted(placements, key=lambda p: p.frame)
        if p.frame in store and np.isfinite(p.px_per_rad)
    ]
    if not views:
        return None
    small = surface.reduced(views[0].full.size_px[0] / store.size_px[0])
    try:
        # Each pixel by itself: one round has not learned enough of how bodies look to call a whole one ground, and a
        # body of which a part is found is closed.
        rough = replace(options, motion_rounds=1, together=False)
        scene, _, _ = scene_of(store, views, small, rough)
    except ValueError:  # pictures of which no pixel is believed in
        return None
    still, _ = find_still(scene)
    step = max(CELL_PX, max(small.width, small.height) / COVER_CELLS)
    size = (int(np.ceil(small.width / step)), int(np.ceil(small.height / step)))
    columns, rows = (STEP_CELLS * np.arange(-(-n // STEP_CELLS) + 1.0) for n in size)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = small.pixel_to_ray((nodes + 0.5) * step - 0.5)
    vote = _votes([view.full for view in views])
    clear = np.zeros((len(views), size[0] * size[1]), bool)
    n_seen = np.zeros(len(views))
    last = np.array(store.size_px) - 1 - BORDER_PX
    for row, (view, plane) in enumerate(zip(views, still, strict=True)):
        at = expand_map(view.ray_to_pixel(rays), STEP_CELLS, size)
        seen = ((at >= BORDER_PX) & (at <= last)).all(axis=-1)
        known = cv2.remap(plane, at[..., 0], at[..., 1], cv2.INTER_NEAREST)
        clear[row] = (seen & (known > NEAR)).ravel() & (vote[row] > 0)
        n_seen[row] = seen.sum()
    return ShownGround(
        frames=np.array([v.frame for v in views], np.int64), clear=clear, vote=vote,
        cells_seen=float(np.median(n_seen)),
    )  # fmt: skip


def _votes(views: Sequence[Placement]) -> NDArray[np.float32]:
    """As share_views has it for coarser views: the root of the resolution over what is usual in the shot; 0 where it is
    so coarse that it would not vote."""
    usual = np.median([resolution(v) for v in views])
    return np.sqrt(clipped_ratio(views, np.array([usual])))[:, 0].astype(np.float32)
