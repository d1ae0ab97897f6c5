"""Placements and stored frames -> Panorama, tile by tile.

plan_views (first, with approximate placements) -> a pass over the clip that puts the planned frames into a
FrameStore -> composite (with the final placements). Memory: the panorama, one stack of views per thread, the
store's cache; nothing grows with the clip.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mosaic.blend import blend_stack, sample_view, solve_log_gains
from mosaic.framestore import COARSE, FrameStore
from mosaic.surface import Placement, Surface
from mosaic.views import (
    CompositeOptions,
    Lattice,
    ViewPlan,
    centrality,
    lattice_of,
    plan_views,
    rate_views,
    resolution,
    share_views,
)

__all__ = ["CompositeOptions", "FrameStore", "Panorama", "ViewPlan", "composite", "plan_views"]

GRID_PX = 16  # spacing of exact map points in a tile; halved until linear interpolation holds MAP_ERROR_PX
MAP_ERROR_PX = 0.02
UNSEEN = np.float32(-1e9)  # a map point that the frame does not see; any mix with it lies outside the frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panorama:
    """The picture and where each pixel looks.

    image (h, w, 3) uint8 RGB; alpha (h, w) uint8, 0 where nothing was seen, else 255. n_seen (h, w) uint8: views
    that saw the pixel. spread (h, w) uint8: 1.4826 times the median distance of the views from the value, in grey
    levels (0 where fewer than 3 views). frames: those used. placements: of every frame of the shot, by number.
    gains (len(frames), 3): what each frame's channels were multiplied by.
    """

    image: NDArray[np.uint8]
    alpha: NDArray[np.uint8]
    surface: Surface
    n_seen: NDArray[np.uint8]
    spread: NDArray[np.uint8]
    frames: tuple[int, ...]
    placements: Mapping[int, Placement]
    gains: NDArray[np.float64]
    canvas: Canvas | None = field(default=None, repr=False)

    def pixel_to_ray(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Panorama pixels (..., 2) -> unit rays (..., 3) in the shot world."""
        return self.surface.pixel_to_ray(xy)

    def ray_to_pixel(self, rays: ArrayLike) -> NDArray[np.float64]:
        """Rays (..., 3) in the shot world -> panorama pixels (..., 2), NaN where the surface has none."""
        return self.surface.ray_to_pixel(rays)

    def frame_to_pixel(self, frame: int, xy: ArrayLike) -> NDArray[np.float64]:
        """Raw pixels (..., 2) of a frame -> panorama pixels (..., 2). Raises KeyError for a frame without placement."""
        return self.surface.ray_to_pixel(
            self.placements[frame].pixel_to_ray(np.asarray(xy, dtype=np.float64))
        )

    def pixel_to_frame(self, frame: int, xy: ArrayLike) -> NDArray[np.float64]:
        """Panorama pixels (..., 2) -> raw pixels (..., 2) of a frame, inside it or not; NaN where it cannot look."""
        return self.placements[frame].ray_to_pixel(self.surface.pixel_to_ray(xy))

    def release(self) -> None:
        """Give back memory that the picture's file occupies; it is read again when touched. For long writers."""
        if self.canvas is not None:
            self.canvas.release()


class Canvas:
    """Arrays in memory while they fit into a budget, else in an unlinked file of the scratch folder.

    A shared file map counts as resident while its pages are mapped: release() unmaps them, the data stay.
    """

    def __init__(self, folder: str | os.PathLike[str], memory_bytes: int) -> None:
        self._folder, self._left, self._maps = folder, memory_bytes, list[mmap.mmap]()

    def zeros(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """A uint8 array of zeros."""
        n_bytes = int(np.prod(shape))
        if n_bytes <= self._left:
            self._left -= n_bytes
            return np.zeros(shape, np.uint8)
        with tempfile.TemporaryFile(prefix="panorama-", dir=self._folder) as file:
            file.truncate(n_bytes)
            pages = mmap.mmap(file.fileno(), n_bytes)
        self._maps.append(pages)
        return np.frombuffer(pages, np.uint8).reshape(shape)

    def release(self) -> None:
        for pages in self._maps:
            pages.flush()
            if hasattr(mmap, "MADV_DONTNEED"):  # Linux; elsewhere the system takes pages back by itself
                pages.madvise(mmap.MADV_DONTNEED)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scene:
    """What all tiles share."""

    surface: Surface
    store: FrameStore
    views: tuple[Placement, ...]
    gains: NDArray[np.float32]  # (n, 3)
    lattice: Lattice
    floor: NDArray[np.float64]  # (ny, nx)
    vote: NDArray[np.float32]  # (n, ny, nx), 0 = does not count
    options: CompositeOptions


def composite(
    plan: ViewPlan,
    store: FrameStore,
    placements: Sequence[Placement],
    surface: Surface,
    options: CompositeOptions | None = None,
    *,
    scratch: str | os.PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Panorama:
    """The panorama of the stored frames on a surface.

    placements: the final ones of the shot; frames of the plan that are not in the store, or lost since, are left out.
    scratch: folder for a picture too large for memory (default: the system's). progress: called with 0..1 from
    worker threads, one at a time. Raises ValueError when no stored frame sees the surface.
    """
    options = options or CompositeOptions()
    by_frame = {p.frame: p for p in placements}
    stored = [
        by_frame[k]
        for k in plan.frames
        if k in store and k in by_frame and np.isfinite(by_frame[k].px_per_rad)
    ]
    lattice = lattice_of(surface)
    views, floor, vote = _final_views(stored, lattice, surface, options)
    gains = solve_gains(store, views, surface) if options.gains else np.ones((len(views), 3))
    scene = _Scene(
        surface=surface, store=store, views=views, gains=gains.astype(np.float32), lattice=lattice,
        floor=floor.reshape(vote.shape[1:]), vote=vote, options=options,
    )  # fmt: skip
    canvas = Canvas(scratch or tempfile.gettempdir(), options.memory_bytes)
    size = (surface.height, surface.width)
    image, alpha, n_seen, spread = (canvas.zeros(s) for s in ((*size, 3), size, size, size))
    step = options.tile_px
    # Row by row: neighbours share most of their frames, so the store's cache holds one tile's views and that is enough.
    tiles = [(x, y) for y in range(0, surface.height, step) for x in range(0, surface.width, step)]
    local, lock, done = threading.local(), threading.Lock(), [0]

    def work(corner: tuple[int, int]) -> None:
        x, y = corner
        box = np.s_[y : y + step, x : x + step]
        result = _tile(scene, x, y, min(step, surface.width - x), min(step, surface.height - y), local)
        if result is not None:
            image[box], n_seen[box], spread[box] = result
            alpha[box] = np.where(result[1] > 0, np.uint8(255), np.uint8(0))
        with lock:
            done[0] += 1
            if done[0] % 16 == 0:
                canvas.release()
            if progress is not None:
                progress(done[0] / len(tiles))

    with ThreadPoolExecutor(options.threads) as pool:
        for _ in pool.map(work, tiles):
            pass
    canvas.release()
    return Panorama(
        image=image, alpha=alpha, surface=surface, n_seen=n_seen, spread=spread, frames=tuple(p.frame for p in views),
        placements=by_frame, gains=gains, canvas=canvas,
    )  # fmt: skip


def _final_views(
    stored: Sequence[Placement], lattice: Lattice, surface: Surface, options: CompositeOptions
) -> tuple[tuple[Placement, ...], NDArray[np.float64], NDArray[np.float32]]:
    """Views in use, the resolution floor (p,) and votes (n, ny, nx), with the final placements."""
    if not stored:
        raise ValueError("no stored frame has a placement: nothing to composite")
    rating = rate_views(stored, lattice, options)
    vote = share_views(stored, rating, lattice, surface.scale_px, options)
    used = np.flatnonzero(vote.any(axis=(1, 2)) & rating.quality.any(axis=1))
    if not len(used):
        raise ValueError(f"none of {len(stored)} stored frames sees the panorama")
    return tuple(stored[int(i)] for i in used), rating.floor, vote[used]


def _tile(
    scene: _Scene, x0: int, y0: int, width: int, height: int, local: threading.local
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]] | None:
    """image (h, w, 3), n_seen, spread of one tile; None where no view reaches it."""
    options = scene.options
    maps = _tile_maps(scene, x0, y0, width, height)
    if not maps:
        return None
    side, most = options.tile_px, options.max_views
    if not hasattr(local, "stack"):  # one stack per thread, used again for every tile
        local.stack = np.empty(most * 3 * side * side, np.uint8)
        local.flags = np.empty((2, most * side * side), np.uint8)
    n, area = len(maps), width * height
    stack = local.stack[: n * 3 * area].reshape(n, 3, height, width)
    vote, weight = (plane[: n * area].reshape(n, height, width) for plane in local.flags)
    nothing = np.zeros((1, 1), np.uint8)
    strongest = max(float(grid[..., 3].max()) for _, grid, _, _ in maps)
    for row, (index, grid, step, shrink) in enumerate(maps):
        # Views that hardly count in the mean only help to find the median: linear is good enough, at half the time.
        cubic = options.cubic and float(grid[..., 3].max()) > 0.2 * strongest
        frame = scene.store.get(scene.views[index].frame, shrink)
        sample_view(
            frame.rgb, nothing if frame.trust is None else frame.trust, frame.trust is not None, grid, step,
            scene.gains[index], np.float32(max(options.margin_px / shrink, 2.0)),
            np.float32(max(1.0, options.feather * frame.rgb.shape[1])), cubic,
            stack[row], vote[row], weight[row],
        )  # fmt: skip
    return blend_stack(stack, vote, weight, floor=options.floor, cap=options.cap, doubt=options.doubt)


def _tile_maps(
    scene: _Scene, x0: int, y0: int, width: int, height: int
) -> list[tuple[int, NDArray[np.float32], int, int]]:
    """(view, grid (rows, columns, 3), step, shrink) of the views that count in a tile, heaviest max_views of them."""
    near = _lattice_box(scene.lattice, x0, y0, width, height)
    candidates = np.flatnonzero(scene.vote[(slice(None), *near)].any(axis=(1, 2)))
    rays, checks = _tile_rays(scene.surface, x0, y0, width, height, GRID_PX)
    at = _lattice_at(scene.lattice, rays.shape[:2], x0, y0, GRID_PX)
    found = []
    for index in candidates:
        placement = scene.views[index]
        step = GRID_PX
        xy = placement.ray_to_pixel(rays)
        if _grid_error(xy, placement.ray_to_pixel(checks)) > MAP_ERROR_PX:
            while step > 2:
                step //= 2
                finer, finer_checks = _tile_rays(scene.surface, x0, y0, width, height, step)
                xy = placement.ray_to_pixel(finer)
                if _grid_error(xy, placement.ray_to_pixel(finer_checks)) <= MAP_ERROR_PX:
                    break
        here = at if step == GRID_PX else _lattice_at(scene.lattice, xy.shape[:2], x0, y0, step)
        central = centrality(xy, placement.size_px, scene.options.margin_px)
        ratio = _ratio(resolution(placement), _floor(scene, *here))
        vote = _bilinear(scene.vote[index], *here)
        member = _bilinear((scene.vote[index] > 0).astype(np.float32), *here)
        # A cell cut by the frame's border must not lose its half inside because its outer corner weighs nothing;
        # the sampler tests the border itself, pixel by pixel.
        inside = np.maximum(central, np.float32(0.04))
        if not (central * ratio * vote).any():
            continue
        shrink = _shrink(xy, step)
        grid = np.empty((*xy.shape[:2], 4), np.float32)
        grid[..., :2] = np.where(np.isfinite(xy), (xy - (shrink - 1) / 2) / shrink, UNSEEN)
        # To decide what stands still, who sees it best counts a little; to paint it, the sharp views count most.
        grid[..., 2] = vote * (0.3 + 0.7 * inside) * ratio**2
        grid[..., 3] = member * inside * ratio**4
        found.append((float((central * grid[..., 3]).sum()), int(index), grid, step, shrink))
    if not found:
        return []
    heaviest = np.max([entry[2][..., 2:].max(axis=(0, 1)) for entry in found], axis=0)
    for entry in found:  # the sampler stores both in 8 bits: use all of them
        entry[2][..., 2:] /= heaviest
    if len(found) > scene.options.max_views:
        found = sorted(sorted(found, key=lambda f: -f[0])[: scene.options.max_views], key=lambda f: f[1])
    return [entry[1:] for entry in found]


def _ratio(fineness: float, floor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Resolution over the floor's, at most 2, fading to 0 from the floor to 15 % below it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(floor > 0, fineness / floor, 1.0)
    return np.minimum(ratio, 2.0) * np.clip((ratio - 0.85) / 0.15, 0.0, 1.0)


def _shrink(xy: NDArray[np.float64], step: int) -> int:
    """Whole factor by which a frame is finer than the panorama here: sampling it as it is would alias."""
    with np.errstate(invalid="ignore"):
        lengths = np.linalg.norm(np.diff(xy, axis=1), axis=-1) / step
    finite = lengths[np.isfinite(lengths)]
    return max(1, int(np.median(finite) + 0.3)) if len(finite) else 1


def _tile_rays(
    surface: Surface, x0: int, y0: int, width: int, height: int, step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays at every step-th pixel of a tile, one row and column beyond it, and at the middles of their cells."""
    x = x0 + step * np.arange(-(-width // step) + 1, dtype=np.float64)
    y = y0 + step * np.arange(-(-height // step) + 1, dtype=np.float64)
    rays = surface.pixel_to_ray(np.stack(np.meshgrid(x, y), axis=-1))
    middles = surface.pixel_to_ray(np.stack(np.meshgrid(x[:-1] + step / 2, y[:-1] + step / 2), axis=-1))
    return rays, middles


def _grid_error(xy: NDArray[np.float64], exact: NDArray[np.float64]) -> float:
    """Largest distance, px, of the interpolated map from the exact one at the middles of cells."""
    between = (xy[:-1, :-1] + xy[1:, :-1] + xy[:-1, 1:] + xy[1:, 1:]) / 4
    error = np.abs(between - exact).max(axis=-1)
    return float(error[np.isfinite(error)].max(initial=0.0))


def _lattice_box(lattice: Lattice, x0: int, y0: int, width: int, height: int) -> tuple[slice, slice]:
    """Lattice rows and columns over a tile, one more on each side."""

    def span(points: NDArray[np.float64], start: int, length: int) -> slice:
        first = int(np.searchsorted(points, start, side="right")) - 1
        last = int(np.searchsorted(points, start + length - 1, side="left"))
        return slice(max(first, 0), last + 1)

    return span(lattice.y_px, y0, height), span(lattice.x_px, x0, width)


def _lattice_at(
    lattice: Lattice, shape: tuple[int, int], x0: int, y0: int, step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lattice rows (m,) and columns (k,), with fractions, of a tile's grid of `step` px."""
    rows = (y0 + step * np.arange(shape[0])) / max(lattice.y_px[1], 1e-9)
    columns = (x0 + step * np.arange(shape[1])) / max(lattice.x_px[1], 1e-9)
    return rows, columns


def _floor(scene: _Scene, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Resolution floor at lattice positions; points that nobody sees do not pull it down."""
    share = _bilinear((scene.floor > 0).astype(np.float64), rows, columns)
    return np.where(share > 0, _bilinear(scene.floor, rows, columns) / np.maximum(share, 1e-9), 0.0)


def _bilinear(
    table: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float64]:
    def split(at: NDArray[np.float64], n: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        at = np.clip(at, 0, n - 1)
        low = np.minimum(at.astype(np.intp), n - 2)
        return low, at - low

    i, v = split(rows, table.shape[0])
    j, u = split(columns, table.shape[1])
    upper = table[i][:, j] * (1 - u) + table[i][:, j + 1] * u
    lower = table[i + 1][:, j] * (1 - u) + table[i + 1][:, j + 1] * u
    return upper * (1 - v)[:, None] + lower * v[:, None]


def solve_gains(
    store: FrameStore, views: Sequence[Placement], surface: Surface, n_points: int = 5000
) -> NDArray[np.float64]:
    """Gain per frame and channel (n, 3) so that the views agree, from the coarse pictures; median 1.

    Dark (below 8) and burnt (above 247) blocks are left out: there a gain does not act as a factor.
    """
    lattice = lattice_of(surface, n_points)
    samples = np.zeros((3, len(views), len(lattice.rays)), np.float32)
    weight = np.zeros((len(views), len(lattice.rays)), np.float32)
    for row, placement in enumerate(views):
        picture, trust = store.coarse(placement.frame)
        at = (placement.ray_to_pixel(lattice.rays) - (COARSE - 1) / 2) / COARSE
        height, width = trust.shape
        with np.errstate(invalid="ignore"):
            inside = ((at >= 0) & (at <= [width - 1.001, height - 1.001])).all(axis=-1)
        if not inside.any() or min(width, height) < 2:
            continue
        value, sure = _coarse_samples(picture, trust, at[inside])
        usable = sure * ((value > 8) & (value < 247)).all(axis=-1)
        samples[:, row, inside] = np.log(np.maximum(value, 1.0)).T
        weight[row, inside] = usable
    gains: list[Any] = [np.exp(solve_log_gains(channel, weight)) for channel in samples]
    return np.stack(gains, axis=1)


def _coarse_samples(
    picture: NDArray[np.uint8], trust: NDArray[np.uint8], at: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bilinear colour (m, 3) and least trust 0..1 (m,) of a coarse picture at px (m, 2) inside it."""
    low = at.astype(np.intp)
    (u, v), (x, y) = (at - low).T[..., None], low.T
    corners = [
        (y, x, (1 - u) * (1 - v)),
        (y, x + 1, u * (1 - v)),
        (y + 1, x, (1 - u) * v),
        (y + 1, x + 1, u * v),
    ]
    value = sum(picture[i, j] * share for i, j, share in corners)
    sure = np.min([trust[i, j] for i, j, _ in corners], axis=0) / 255.0
    return np.asarray(value), sure * (sure > 0.5)
