"""Paints a scene tile by tile: which views count in a tile, their maps, samples and blend.

The map from a tile's pixels to a frame's is exact on a grid and linear in between, with the error checked.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mosaic.blend import blend_stack, sample_view
from mosaic.canvas import Canvas
from mosaic.framestore import FrameStore
from mosaic.surface import Placement, Surface
from mosaic.views import CompositeOptions, Lattice, centrality, resolution

GRID_PX = 16  # spacing of exact map points in a tile; halved until linear interpolation is good enough
UNSEEN = np.float32(-1e9)  # a map point that the frame does not see; any mix with it lies outside the frame


TileMap = tuple[int, NDArray[np.float32], int, int]  # view, grid (rows, columns, 4), step, shrink


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What all tiles share. lattice: points of views.lattice_of, of which floor and vote are tables. still: a plane
    (h, w) uint8 per view over its frame, at any resolution: 255 = at rest, low = something moves there; None = all
    at rest. map_error_px: how far the interpolated map may be from the exact one, in frame px. maps: where given,
    the maps of a tile are kept in it, for a scene that is painted more than once."""

    surface: Surface
    store: FrameStore
    views: tuple[Placement, ...]
    gains: NDArray[np.float32]  # (n, 3)
    lattice: Lattice
    floor: NDArray[np.float64]  # (ny, nx)
    vote: NDArray[np.float32]  # (n, ny, nx), 0 = does not count
    options: CompositeOptions
    still: tuple[NDArray[np.uint8], ...] | None = None
    map_error_px: float = 0.02
    maps: dict[tuple[int, int], list[TileMap]] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layers:
    """image (h, w, 3), n_seen, spread, support (h, w), all uint8; see blend.robust_value."""

    image: NDArray[np.uint8]
    n_seen: NDArray[np.uint8]
    spread: NDArray[np.uint8]
    support: NDArray[np.uint8]


def paint(scene: Scene, canvas: Canvas, progress: Callable[[float], None] | None = None) -> Layers:
    """All tiles of a scene. progress: called with 0..1 from worker threads, one at a time."""
    surface, step = scene.surface, scene.options.tile_px
    size = (surface.height, surface.width)
    layers = Layers(
        image=canvas.zeros((*size, 3)),
        n_seen=canvas.zeros(size),
        spread=canvas.zeros(size),
        support=canvas.zeros(size),
    )
    # Row by row: neighbours share most of their frames.
    tiles = [(x, y) for y in range(0, surface.height, step) for x in range(0, surface.width, step)]
    local, lock, done = threading.local(), threading.Lock(), [0]

    def work(index: int) -> None:
        x, y = tiles[index]
        box = np.s_[y : y + step, x : x + step]
        # To and fro through the views: the store's cache still holds the last ones of the tiles before.
        backwards = index // scene.options.threads % 2 == 1
        width, height = min(step, surface.width - x), min(step, surface.height - y)
        result = _tile(scene, x, y, width, height, backwards, local)
        if result is not None:
            layers.image[box], layers.n_seen[box], layers.spread[box], layers.support[box] = result
        with lock:
            done[0] += 1
            if done[0] % 16 == 0:
                canvas.release()
            if progress is not None:
                progress(done[0] / len(tiles))

    with ThreadPoolExecutor(scene.options.threads) as pool:
        for _ in pool.map(work, range(len(tiles))):
            pass
    canvas.release()
    return layers


def _tile(
    scene: Scene, x0: int, y0: int, width: int, height: int, backwards: bool, local: threading.local
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]] | None:
    """image (h, w, 3), n_seen, spread, support of one tile; None where no view reaches it."""
    maps = scene.maps.get((x0, y0)) if scene.maps is not None else None
    if maps is None:
        maps = _tile_maps(scene, x0, y0, width, height)
        if scene.maps is not None:
            scene.maps[x0, y0] = maps
    image, n_seen, spread, support = _blended(scene, maps, width, height, backwards, local)
    if (n_seen == 0).any():
        # The lattice's rules leave out who sees a place too coarsely, or in a strip between its points.
        others = _fallback_maps(scene, x0, y0, n_seen == 0)
        if others:
            empty = n_seen == 0
            filling = _blended(scene, others, width, height, backwards, local)
            for layer, fill in zip((image, n_seen, spread, support), filling, strict=True):
                layer[empty] = fill[empty]
    return (image, n_seen, spread, support) if n_seen.any() else None


def _blended(
    scene: Scene, maps: list[TileMap], width: int, height: int, backwards: bool, local: threading.local
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """image (h, w, 3), n_seen, spread, support of the views in `maps` over one tile."""
    options = scene.options
    if not maps:
        plain = np.zeros((3, height, width), np.uint8)
        return np.zeros((height, width, 3), np.uint8), plain[0], plain[1], plain[2]
    side, most = options.tile_px, options.max_views
    if not hasattr(local, "stack"):  # one stack per thread, used again for every tile
        local.stack = np.empty(most * 3 * side * side, np.uint8)
        local.flags = np.empty((2, most * side * side), np.uint8)
    n, area = len(maps), width * height
    stack = local.stack[: n * 3 * area].reshape(n, 3, height, width)
    vote, weight = (plane[: n * area].reshape(n, height, width) for plane in local.flags)
    everywhere = np.full((1, 1), 255, np.uint8)
    strongest = max(float(grid[..., 3].max()) for _, grid, _, _ in maps)
    for row in reversed(range(n)) if backwards else range(n):
        index, grid, step, shrink = maps[row]
        # Views that hardly count in the mean only help to find the median: linear is good enough, at half the time.
        cubic = options.cubic and float(grid[..., 3].max()) > 0.2 * strongest
        frame = scene.store.get(scene.views[index].frame, shrink)
        sample_view(
            frame.rgb, everywhere if frame.trust is None else frame.trust,
            everywhere if scene.still is None else scene.still[index], grid, step,
            scene.gains[index], np.float32(max(options.margin_px / shrink, 2.0)),
            np.float32(max(1.0, options.feather * frame.rgb.shape[1])), cubic,
            stack[row], vote[row], weight[row],
        )  # fmt: skip
    return blend_stack(stack, vote, weight, floor=options.floor, cap=options.cap, doubt=options.doubt)


def _fallback_maps(scene: Scene, x0: int, y0: int, empty: NDArray[np.bool_]) -> list[TileMap]:
    """Maps, without regard to the lattice, of views that reach empty pixels (h, w) of a tile: the finest of them."""
    height, width = empty.shape
    rays, _ = _tile_rays(scene.surface, x0, y0, width, height, GRID_PX)
    rows, columns = rays.shape[0] - 1, rays.shape[1] - 1
    padded = np.zeros((rows * GRID_PX, columns * GRID_PX), bool)
    padded[:height, :width] = empty
    wanted = padded.reshape(rows, GRID_PX, columns, GRID_PX).any(axis=(1, 3))
    short = np.where(wanted, scene.options.views, 0)  # views still wanted per cell
    found: list[TileMap] = []
    for index in sorted(range(len(scene.views)), key=lambda i: -resolution(scene.views[i])):
        placement = scene.views[index]
        xy = placement.ray_to_pixel(rays)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((xy >= 0) & (xy <= np.array(placement.size_px) - 1)).all(axis=-1))
        reached = (inside[:-1, :-1] | inside[1:, :-1] | inside[:-1, 1:] | inside[1:, 1:]) & (short > 0)
        if not reached.any() or len(found) >= scene.options.max_views:
            continue
        short = short - reached
        step, shrink = GRID_PX, _shrink(xy, GRID_PX)
        grid = np.empty((*xy.shape[:2], 4), np.float32)
        grid[..., :2] = np.where(np.isfinite(xy), (xy - (shrink - 1) / 2) / shrink, UNSEEN)
        grid[..., 2:] = 1.0
        found.append((index, grid, step, shrink))
    return found


def _tile_maps(scene: Scene, x0: int, y0: int, width: int, height: int) -> list[TileMap]:
    """Maps of the views that count in a tile, the heaviest max_views of them."""
    near = _lattice_box(scene.lattice, x0, y0, width, height)
    candidates = np.flatnonzero(scene.vote[(slice(None), *near)].any(axis=(1, 2)))
    rays, checks = _tile_rays(scene.surface, x0, y0, width, height, GRID_PX)
    at = _lattice_at(scene.lattice, rays.shape[:2], x0, y0, GRID_PX)
    found = []
    for index in candidates:
        placement = scene.views[index]
        step = GRID_PX
        xy = placement.ray_to_pixel(rays)
        if _grid_error(xy, placement.ray_to_pixel(checks)) > scene.map_error_px:
            while step > 2:
                step //= 2
                finer, finer_checks = _tile_rays(scene.surface, x0, y0, width, height, step)
                xy = placement.ray_to_pixel(finer)
                if _grid_error(xy, placement.ray_to_pixel(finer_checks)) <= scene.map_error_px:
                    break
        here = at if step == GRID_PX else _lattice_at(scene.lattice, xy.shape[:2], x0, y0, step)
        central = centrality(xy, placement.size_px, scene.options.margin_px)
        ratio, sharp = _ratio(resolution(placement), _floor(scene, *here))
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
        grid[..., 2] = vote * (0.3 + 0.7 * inside) * np.clip(ratio, 0.25, 2.0)
        grid[..., 3] = member * inside * np.maximum(sharp**4, 0.002 * ratio)
        found.append((float((central * (grid[..., 2] + grid[..., 3])).sum()), int(index), grid, step, shrink))
    if not found:
        return []
    heaviest = np.max([entry[2][..., 2:].max(axis=(0, 1)) for entry in found], axis=0)
    for entry in found:  # the sampler stores both in 8 bits: use all of them
        entry[2][..., 2:] /= heaviest
    if len(found) > scene.options.max_views:
        found = sorted(sorted(found, key=lambda f: -f[0])[: scene.options.max_views], key=lambda f: f[1])
    return [entry[1:] for entry in found]


def _ratio(fineness: float, floor: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Resolution over the floor's, at most 2; and the same fading to 0 from the floor to 15 % below it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.minimum(np.where(floor > 0, fineness / floor, 1.0), 2.0)
    return ratio, ratio * np.clip((ratio - 0.85) / 0.15, 0.0, 1.0)


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


def _floor(scene: Scene, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
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
