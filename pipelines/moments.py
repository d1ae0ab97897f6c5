"""The panorama with its players at some moments of the shot: a trail, over the clean plate.

Each moment is a stored frame. Who stands in front of the plate there is found as `render` finds it (render/matte.py).
Only whole bodies are kept: what touches the frame's border, a graphic or what the plate lacks was cut off there. Later
moments lie over earlier ones. Who stood still for most of the shot may be part of the plate, and then is there once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.canvas import Canvas
from mosaic.composite import Panorama
from mosaic.framestore import FrameStore
from mosaic.surface import Placement, Surface
from pipelines.render.matte import MatteOptions, difference, front_matte
from pipelines.render.plate import Light, Plate, fit_light
from pipelines.render.views import View, dense_map, node_grid

MEMORY_BYTES = 200_000_000  # of the two copies of the picture; beyond it they live in a scratch file
BORDER_PX = 4  # of a frame: a body that reaches it was cut off
OUTLINE_POINTS = 33  # along each side of a frame, to find where it lies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trail:
    """image (h, w, 3) uint8 on the panorama's pixels; frames: the moments, in the order of time."""

    image: NDArray[np.uint8]
    frames: tuple[int, ...]

    def without_image(self) -> Trail:
        """Which moments it shows, for who only has to make it again."""
        return Trail(image=np.zeros((0, 0, 3), np.uint8), frames=self.frames)


def choose_moments(stored: Sequence[int], n: int, wanted: Sequence[int] = ()) -> tuple[int, ...]:
    """Stored frames nearest to those wanted, or, without any wanted, to n moments evenly over the shot; ascending."""
    if not len(stored):
        return ()
    known = np.sort(np.asarray(stored))
    goals = np.asarray(wanted, float) if len(wanted) else np.linspace(known[0], known[-1], n)
    return tuple(sorted({int(known[np.argmin(np.abs(known - goal))]) for goal in goals}))


def trail(panorama: Panorama, store: FrameStore, moments: Sequence[int], scratch: str) -> Trail:
    """The panorama with the players of these frames, all of which the store has, in front of it."""
    canvas = Canvas(scratch, MEMORY_BYTES)
    plate = canvas.zeros((*panorama.alpha.shape, 4))
    plate[..., :3], plate[..., 3] = panorama.image, panorama.alpha
    image = canvas.zeros(panorama.image.shape)
    image[:] = panorama.image
    for frame in moments:
        placement = panorama.placements[frame]
        colour, matte = _players(Plate(surface=panorama.surface, levels=(plate,)), store, placement)
        _lay(image, panorama, placement, colour, matte)
    return Trail(image=image, frames=tuple(moments))


def _players(
    plate: Plate, store: FrameStore, placement: Placement
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """A frame (h, w, 3) in the plate's light, and 0..1 (h, w) where whole bodies are in front of it."""
    stored = store.get(placement.frame)
    behind, known = plate.seen_by(cast(View, placement))  # it asks for size_px and pixel_to_ray
    usable = np.ones(known.shape, bool) if stored.trust is None else stored.trust > 0
    usable &= _resized(store.still(placement.frame) > 0, known.shape)
    known = known & usable
    light = fit_light(stored.rgb, behind, known)
    matte = front_matte(difference(stored.rgb, behind, known, light), MatteOptions(), store.size_px[0])
    # Beside what is not known the matte says nothing for a pixel or two.
    cut = cv2.dilate((~known).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    cut[:BORDER_PX], cut[-BORDER_PX:], cut[:, :BORDER_PX], cut[:, -BORDER_PX:] = True, True, True, True
    n, labels = cv2.connectedComponents((matte > 0).astype(np.uint8), connectivity=8)
    whole = np.ones(n, bool)
    whole[labels[cut]] = False
    return _in_light_of_the_plate(stored.rgb, light), np.where(whole[labels], matte, np.float32(0))


def _resized(flags: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    small = flags.astype(np.uint8)
    return np.asarray(cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST) > 0)


def _in_light_of_the_plate(rgb: NDArray[np.uint8], light: Light) -> NDArray[np.uint8]:
    levels: NDArray[Any] = (np.arange(256, dtype=np.float32)[:, None] - light.offset) / light.gain
    table = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(rgb, np.ascontiguousarray(table[None])), np.uint8)


def _lay(
    image: NDArray[np.uint8],
    panorama: Panorama,
    placement: Placement,
    colour: NDArray[np.uint8],
    matte: NDArray[np.float32],
) -> None:
    """Mix a frame into the picture, by its matte; only the part of the picture that it covers is touched."""
    surface = panorama.surface
    left, top, right, bottom = _covered(surface, placement)
    if right <= left or bottom <= top:
        return
    size = (right - left, bottom - top)
    nodes = placement.ray_to_pixel(surface.pixel_to_ray(node_grid(size) + np.array([left, top])))
    map_x, map_y = dense_map(nodes, size)
    share = cv2.remap(matte, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[..., None]
    moved = cv2.remap(colour, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    part = image[top:bottom, left:right]
    seen = panorama.alpha[top:bottom, left:right, None] > 0
    mixed = np.rint(part + np.where(seen, share, 0) * (moved.astype(np.float32) - part))
    part[:] = np.clip(mixed, 0, 255).astype(np.uint8)


def _covered(surface: Surface, placement: Placement) -> tuple[int, int, int, int]:
    """left, top, right, bottom of the surface's pixels that a frame may cover."""
    w, h = placement.size_px
    x, y = np.linspace(0, w - 1, OUTLINE_POINTS), np.linspace(0, h - 1, OUTLINE_POINTS)
    at = surface.ray_to_pixel(placement.pixel_to_ray(np.stack(np.meshgrid(x, y), axis=-1)))
    at = at[np.isfinite(at).all(axis=-1)]
    if not len(at):
        return 0, 0, 0, 0
    low, high = np.floor(at.min(axis=0)) - 2, np.ceil(at.max(axis=0)) + 3
    left, top = np.maximum(low, 0).astype(int)
    right, bottom = np.minimum(high, [surface.width, surface.height]).astype(int)
    return int(left), int(top), int(right), int(bottom)
