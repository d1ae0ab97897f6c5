"""What the ground is where frames disagree: of all colours seen at a place the one that comes again at most moments and
looks least like a body (appearance.py), as far as it is seen together with what is chosen round about (states.py).

A median asks only how often; a body that stands or strolls wins it wherever it hides the ground in most of the frames.
Every frame that sees a place is asked, not only those that the composite samples: the ground may show in few.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from mosaic.boards import MARGIN_PX, MOST_VIEWS, column_costs, cut_columns, find_boards
from mosaic.motion import expand_map
from mosaic.states import EVIDENCE_STEP, NEVER, REACH, find_states, no_states, settle
from mosaic.surface import Placement, Surface

TILE_PX = 128
STEP_PX = 8  # surface px between exact points of a map
BORDER_PX = 2.0  # of a frame, not used

Picture = NDArray[np.uint8]


@numba.njit(cache=True, nogil=True)
def apart(a, b):  # type: ignore[no-untyped-def]
    """Mean difference (h, w) float32 of the channels of two pictures, green twice."""
    out = np.empty(a.shape[:2], np.float32)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            red = abs(np.int32(a[i, j, 0]) - np.int32(b[i, j, 0]))
            green = abs(np.int32(a[i, j, 1]) - np.int32(b[i, j, 1]))
            blue = abs(np.int32(a[i, j, 2]) - np.int32(b[i, j, 2]))
            out[i, j] = np.float32(0.25) * np.float32(red + 2 * green + blue)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """A frame at the small scale. picture (h, w, 4): its levelled colours and their evidence for ground, see
    EVIDENCE_STEP; usable (h, w) uint8, 0 = not the scene. shrink: frame px per px. box: x and y from, to, on the
    surface."""

    placement: Placement
    picture: Picture
    usable: Picture
    shrink: int
    box: tuple[float, float, float, float]


def evidence(ratio: NDArray[np.float32]) -> Picture:
    """Log ratios (h, w) as a plane of 8 bits."""
    return np.asarray(np.clip(np.rint(128 + ratio / EVIDENCE_STEP), 0, 255), np.uint8)


def decide(
    witnesses: Sequence[Witness],
    composite: Picture,
    contested: NDArray[np.bool_],
    surface: Surface,
    threads: int,
    *,
    together: bool = True,
) -> tuple[Picture, NDArray[np.int16], NDArray[np.bool_]]:
    """The composite (h, w, 3) with the ground decided where it is contested (h, w); at how many moments that colour
    was seen there (h, w), 0 where nothing was decided; and where boards change (h, w), see boards.py.

    witnesses: in the order of time. surface: the one whose pixels the composite has. together: see CompositeOptions."""
    height, width = contested.shape
    states = no_states(height, width)
    corners = [(x, y) for y in range(0, height, TILE_PX) for x in range(0, width, TILE_PX)]

    def work(corner: tuple[int, int]) -> None:
        x, y = corner
        # What is seen together may lie on both sides of a border.
        wider = np.s_[y : y + TILE_PX + REACH, x : x + TILE_PX + REACH]
        if not contested[wider].any():
            return
        part = states.part(x, y, TILE_PX)
        views, seen, frames = _sampled(witnesses, surface, x, y, contested[wider].shape)
        if len(frames):
            find_states(views, seen, frames, composite[wider], contested[wider], part)
        else:
            part.value[:] = NEVER

    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, corners):
            pass
    if not together:
        nothing = np.zeros((height, width), np.uint8)
        return *states.picture(nothing, composite, contested), nothing > 0
    image, moments = states.picture(settle(states, contested), composite, contested)
    boards = find_boards(states.restless)
    return in_whole_pieces(image, boards, witnesses, surface), moments, boards


def in_whole_pieces(
    image: Picture, where: NDArray[np.bool_], witnesses: Sequence[Witness], surface: Surface
) -> Picture:
    """The picture (h, w, 3) of a surface with each board of `where` (h, w) put together of columns of witnesses."""
    n, labels, stats, _ = cv2.connectedComponentsWithStats(where.astype(np.uint8), connectivity=8)
    image = image.copy()
    for label, (x, y, width, height, _) in enumerate(stats[1:n], start=1):
        top = max(y - MARGIN_PX, 0)
        box = np.s_[top : y + height + MARGIN_PX, x : x + width]
        board = np.asarray(labels[box] == label)
        views, seen, _ = _sampled(witnesses, surface, x, top, board.shape, MOST_VIEWS)
        if not len(views):
            continue
        colours, usable = np.ascontiguousarray(views[..., :3]), seen > 0
        chosen = cut_columns(colours, usable, board, column_costs(colours, usable, image[box], board))
        columns = np.arange(width)
        shown = usable[chosen, :, columns].T & board
        image[box][shown] = colours[chosen, :, columns].swapaxes(0, 1)[shown]
    return image


def _sampled(
    witnesses: Sequence[Witness],
    surface: Surface,
    x: int,
    y: int,
    shape: tuple[int, int],
    most: int | None = None,
) -> tuple[Picture, Picture, NDArray[np.int64]]:
    """The witnesses that meet a tile (h, w) at x, y, on its pixels: pictures (n, h, w, 4), where they are usable
    (n, h, w), 0 = not, and their frames (n,). most: of more some are left out, evenly."""
    here = [w for w in witnesses if _meet(w.box, x, y, shape)]
    if most is not None and len(here) > most:
        here = [here[row] for row in np.linspace(0, len(here) - 1, most).round().astype(int)]
    views = np.zeros((len(here), *shape, 4), np.uint8)
    seen = np.zeros((len(here), *shape), np.uint8)
    rays = _rays(surface, x, y, shape)
    for view, usable, witness in zip(views, seen, here, strict=True):
        _sample(witness, rays, view, usable)
    return views, seen, np.array([w.placement.frame for w in here], np.int64)


def _meet(box: tuple[float, float, float, float], x: int, y: int, shape: tuple[int, int]) -> bool:
    return box[0] < x + shape[1] and box[2] > x and box[1] < y + shape[0] and box[3] > y


def _rays(surface: Surface, x: int, y: int, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Rays of every STEP_PX-th pixel of a tile (h, w) at x, y, one beyond each end."""
    rows, columns = (STEP_PX * np.arange(-(-n // STEP_PX) + 1.0) for n in shape)
    return surface.pixel_to_ray(np.stack(np.meshgrid(x + columns, y + rows), axis=-1))


def _sample(witness: Witness, rays: NDArray[np.float64], view: Picture, usable: Picture) -> None:
    """A witness on a tile's pixels, into view (h, w, 4) and usable (h, w)."""
    height, width = witness.usable.shape
    at = (witness.placement.ray_to_pixel(rays) - (witness.shrink - 1) / 2) / witness.shrink
    where = expand_map(np.where(np.isfinite(at), at, -1e6), STEP_PX, (view.shape[1], view.shape[0]))
    x, y = where[..., 0], where[..., 1]
    cv2.remap(witness.picture, x, y, cv2.INTER_LINEAR, dst=view)
    cv2.remap(witness.usable, x, y, cv2.INTER_NEAREST, dst=usable)
    inside = (
        (x >= BORDER_PX) & (x <= width - 1 - BORDER_PX) & (y >= BORDER_PX) & (y <= height - 1 - BORDER_PX)
    )
    usable[~inside] = 0
