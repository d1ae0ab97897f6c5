"""Paints a scene tile by tile: samples and blends the views that its maps name (tile_maps.py)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.blend import Blended, blend_stack
from mosaic.canvas import Canvas
from mosaic.framestore import eight_bits
from mosaic.sampling import sample_view
from mosaic.tile_maps import Scene, TileMap, fallback_maps, rows_reached, tile_maps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layers:
    """image (h, w, 3), n_seen, spread, support (h, w), all uint8; deep (h, w, 3) uint16 or None: see blend.Blended."""

    image: NDArray[np.uint8]
    n_seen: NDArray[np.uint8]
    spread: NDArray[np.uint8]
    support: NDArray[np.uint8]
    deep: NDArray[np.uint16] | None


def paint(scene: Scene, canvas: Canvas, progress: Callable[[float], None] | None = None) -> Layers:
    """All tiles of a scene. progress: called with 0..1 from worker threads, one at a time."""
    surface, step = scene.surface, scene.options.tile_px
    size = (surface.height, surface.width)
    layers = Layers(
        image=canvas.zeros((*size, 3)),
        n_seen=canvas.zeros(size),
        spread=canvas.zeros(size),
        support=canvas.zeros(size),
        deep=canvas.zeros((*size, 3), np.uint16) if scene.deep else None,
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
            layers.image[box], layers.n_seen[box], layers.spread[box], layers.support[box] = result[:4]
            if layers.deep is not None and result.deep is not None:
                layers.deep[box] = result.deep
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
) -> Blended | None:
    """One tile; None where no view reaches it."""
    tile = _blended(scene, tile_maps(scene, x0, y0, width, height), width, height, backwards, local)
    empty = tile.n_seen == 0
    if empty.any():
        # The lattice's rules leave out who sees a place too coarsely, or in a strip between its points.
        others = fallback_maps(scene, x0, y0, empty)
        if others:
            filling = _blended(scene, others, width, height, backwards, local)
            for layer, fill in zip(tile, filling, strict=True):
                if layer is not None and fill is not None:
                    layer[empty] = fill[empty]
    return tile if tile.n_seen.any() else None


def _blended(
    scene: Scene, maps: list[TileMap], width: int, height: int, backwards: bool, local: threading.local
) -> Blended:
    """The views in `maps` over one tile."""
    options = scene.options
    if not maps:
        plain = np.zeros((3, height, width), np.uint8)
        deep = np.zeros((height, width, 3), np.uint16) if scene.deep else None
        nothing = np.zeros((height, width, 3), np.uint8)
        return Blended(image=nothing, n_seen=plain[0], spread=plain[1], support=plain[2], deep=deep)
    side, most = options.tile_px, options.max_views
    if not hasattr(local, "stack"):  # one stack per thread, used again for every tile
        local.stack = np.empty(most * 3 * side * side, np.uint8)
        local.flags = np.empty((2, most * side * side), np.uint8)
        local.fine = np.empty(most * 3 * side * side, np.uint8) if scene.deep else None
    n, area = len(maps), width * height
    stack = local.stack[: n * 3 * area].reshape(n, 3, height, width)
    vote, weight = (plane[: n * area].reshape(n, height, width) for plane in local.flags)
    fine = None if local.fine is None else local.fine[: n * 3 * area].reshape(n, 3, height, width)
    everywhere = np.full((1, 1), 255, np.uint8)
    strongest = max(float(grid[..., 3].max()) for _, grid, _, _ in maps)
    for row in reversed(range(n)) if backwards else range(n):
        index, grid, step, shrink = maps[row]
        # Views that hardly count in the mean only help to find the median: linear is good enough, at half the time.
        cubic = options.cubic and float(grid[..., 3].max()) > 0.2 * strongest
        rgb, trust, top, high = _picture(scene, maps[row], local)
        sample_view(
            rgb, top, high, everywhere if trust is None else trust,
            everywhere if scene.still is None else scene.still[index], grid, step,
            scene.gains[index] / np.float32(257 if scene.deep else 1), scene.falloff.astype(np.float32),
            np.float32(max(options.margin_px / shrink, 2.0)), np.float32(max(1.0, options.feather * rgb.shape[1])),
            cubic, stack[row], vote[row], weight[row], None if fine is None else fine[row],
        )  # fmt: skip
    return blend_stack(stack, vote, weight, fine, floor=options.floor, cap=options.cap, doubt=options.doubt)


def _picture(
    scene: Scene, mapped: TileMap, local: threading.local
) -> tuple[NDArray[Any], NDArray[np.uint8] | None, int, int]:
    """Of a view's frame the rows that its map reaches, its trust plane, the first of these rows, the frame's height.

    A tile needs half of a frame or less, and other frames than the tiles around: read into one buffer per thread,
    that takes a third of the time of whole frames through a cache."""
    index, grid, _, shrink = mapped
    store, frame = scene.store, scene.views[index].frame
    if shrink > 1:
        reduced = store.get(frame, shrink, deep=scene.deep)
        return reduced.rgb, reduced.trust, 0, reduced.rgb.shape[0]
    width, height = store.size_px
    if not hasattr(local, "rows"):
        local.rows = np.empty(height * width * 3, np.uint16 if store.deep else np.uint8)
    first, last = rows_reached(grid, height)
    picture = store.rows(frame, first, last, local.rows)
    return picture if scene.deep else eight_bits(picture), store.trust(frame), first, height
