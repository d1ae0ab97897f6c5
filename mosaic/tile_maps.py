"""Which views count in a tile, and where each of its pixels lies in them: a scene's maps, tile by tile.

The map from a tile's pixels to a frame's is exact on a grid and linear in between, with the error checked. With it go
the view's vote and weight at the grid's points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mosaic.framestore import FrameStore
from mosaic.surface import Placement, Surface
from mosaic.views import CompositeOptions, Lattice, resolution

GRID_PX = 16  # spacing of exact map points in a tile; halved until linear interpolation is good enough
UNSEEN = np.float32(-1e9)  # a map point that the frame does not see; any mix with it lies outside the frame


TileMap = tuple[int, NDArray[np.float32], int, int]  # view, grid (rows, columns, 4), step, shrink


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What all tiles share. gains (n, 3): of the views; falloff (2,): of the lens (vignetting.py). lattice: points of
    views.lattice_of, of which floor (ny, nx) and vote (n, ny, nx), 0 = does not count, are tables. still: a plane
    (h, w) uint8 per view over its frame, at any resolution: 255 = at rest, low = something moves there; None = all
    at rest. quiet: (h, w) uint8 over the surface at any resolution, not 0 where all views are known to agree; None =
    nowhere. map_error_px: how far the interpolated map may be from the exact one, in frame px. deep: paint with all the
    bits that the store has."""

    surface: Surface
    store: FrameStore
    views: tuple[Placement, ...]
    gains: NDArray[np.float32]
    falloff: NDArray[np.float64]
    lattice: Lattice
    floor: NDArray[np.float64]
    vote: NDArray[np.float32]
    options: CompositeOptions
    still: tuple[NDArray[np.uint8], ...] | None = None
    quiet: NDArray[np.uint8] | None = None
    map_error_px: float = 0.02
    deep: bool = False


def fallback_maps(scene: Scene, x0: int, y0: int, empty: NDArray[np.bool_]) -> list[TileMap]:
    """Maps, without regard to the lattice, of views that reach empty pixels (h, w) of a tile: the finest of them."""
    height, width = empty.shape
    rays, _ = _tile_rays(scene.surface, x0, y0, width, height, GRID_PX)
    rows, columns = rays.shape[0] - 1, rays.shape[1] - 1
    padded = np.zeros((rows * GRID_PX, columns * GRID_PX), bool)
    padded[:height, :width] = empty
    wanted = np.asarray(padded.reshape(rows, GRID_PX, columns, GRID_PX).any(axis=(1, 3)))
    near = _corners_of(wanted)  # elsewhere nothing is sampled
    short = np.where(wanted, scene.options.views, 0)  # views still wanted per cell
    found: list[TileMap] = []
    looked = rays[near]
    for index in sorted(range(len(scene.views)), key=lambda i: -resolution(scene.views[i])):
        if len(found) >= scene.options.max_views or not short.any():
            break
        placement = scene.views[index]
        at = placement.ray_to_pixel(looked)
        with np.errstate(invalid="ignore"):
            inside = np.zeros(near.shape, bool)
            inside[near] = ((at >= 0) & (at <= np.array(placement.size_px) - 1)).all(axis=-1)
        reached = (inside[:-1, :-1] | inside[1:, :-1] | inside[:-1, 1:] | inside[1:, 1:]) & (short > 0)
        if not reached.any():
            continue
        short = short - reached
        xy = placement.ray_to_pixel(rays)
        step, shrink = GRID_PX, _shrink(xy, GRID_PX)
        grid = np.empty((*xy.shape[:2], 4), np.float32)
        grid[..., :2] = np.where(np.isfinite(xy), (xy - (shrink - 1) / 2) / shrink, UNSEEN)
        grid[..., 2:] = near[..., None]
        found.append((index, grid, step, shrink))
    return found


def rows_reached(grid: NDArray[np.float32], height: int) -> tuple[int, int]:
    """First row of a frame that is sampled through a grid, and one after the last; the sampler's margin included."""
    votes = grid[..., 2] > 0
    cells = np.asarray(votes[:-1, :-1] | votes[1:, :-1] | votes[:-1, 1:] | votes[1:, 1:])
    y = grid[..., 1][_corners_of(cells)]
    y = y[y > UNSEEN / 2]
    if not len(y):
        return 0, 1
    first, last = np.clip([np.floor(y.min()) - 2, np.ceil(y.max()) + 4], 0, height).astype(int)
    return (int(first), int(last)) if last > first else (0, 1)


def _corners_of(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(rows + 1, columns + 1): the corners of the cells (rows, columns) that are True."""
    rows, columns = cells.shape
    corners = np.zeros((rows + 1, columns + 1), bool)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corners[i : i + rows, j : j + columns] |= cells
    return corners


def tile_maps(scene: Scene, x0: int, y0: int, width: int, height: int) -> list[TileMap]:
    """Maps of the views that count in a tile, the heaviest max_views of them."""
    near = _lattice_box(scene.lattice, x0, y0, width, height)
    candidates = np.flatnonzero(scene.vote[(slice(None), *near)].any(axis=(1, 2)))
    levels = {GRID_PX: _Level(scene, x0, y0, width, height, GRID_PX)}
    found = []
    for index in candidates:
        placement = scene.views[index]
        level = levels[GRID_PX]
        xy, error = level.seen_by(placement)
        while error > scene.map_error_px and level.step > 2:
            step = level.step // 2
            level = levels.setdefault(step, _Level(scene, x0, y0, width, height, step))
            xy, error = level.seen_by(placement)
        grid = np.empty((*xy.shape[:2], 4), np.float32)
        shrink = _shrink(xy, level.step)
        total = _node_values(
            xy, scene.vote[index], *level.rows, *level.columns, level.floor, resolution(placement),
            *placement.size_px, scene.options.margin_px, shrink, grid,
        )  # fmt: skip
        if total > 0:
            found.append((total, (int(index), grid, level.step, shrink)))
    if not found:
        return []
    heaviest = np.max([entry[1][1][..., 2:].max(axis=(0, 1)) for entry in found], axis=0)
    for _, (_, grid, _, _) in found:  # the sampler stores both in 8 bits: use all of them
        grid[..., 2:] /= heaviest
    if scene.quiet is not None:
        _thin_where_quiet(scene, [entry[1] for entry in found], x0, y0)
        found = [entry for entry in found if (entry[1][1][..., 2] > 0).any()]
    found = sorted(found, key=lambda f: -f[0])[: scene.options.max_views]
    return sorted((entry[1] for entry in found), key=lambda m: m[0])


class _Level:
    """A tile's grid of one spacing: rays at its points and at middles of its cells, lattice positions and the floor."""

    def __init__(self, scene: Scene, x0: int, y0: int, width: int, height: int, step: int) -> None:
        self.step = step
        rays, checks = _tile_rays(scene.surface, x0, y0, width, height, step)
        self.shape = rays.shape[:2]
        # The error of the map varies slowly: every few cells tell. The last ones lie at the tile's end.
        self._some = np.ix_(
            *(np.unique(np.linspace(0, n - 1, 8).round().astype(int)) for n in checks.shape[:2])
        )
        some = checks[self._some]
        self._n_checks = some.shape[:2]
        self._rays = np.concatenate([rays.reshape(-1, 3), some.reshape(-1, 3)])
        rows, columns = _lattice_at(scene.lattice, self.shape, x0, y0, step)
        self.rows, self.columns = _split(rows, scene.floor.shape[0]), _split(columns, scene.floor.shape[1])
        self.floor = _floor(scene.floor, self.rows, self.columns)

    def seen_by(self, placement: Placement) -> tuple[NDArray[np.float64], float]:
        """Frame px (rows, columns, 2) of the points; largest distance, px, of the interpolated map from the exact."""
        both = placement.ray_to_pixel(self._rays)
        n = self.shape[0] * self.shape[1]
        xy, exact = both[:n].reshape(*self.shape, 2), both[n:].reshape(*self._n_checks, 2)
        i, j = self._some
        between = (xy[i, j] + xy[i + 1, j] + xy[i, j + 1] + xy[i + 1, j + 1]) / 4
        error = np.abs(between - exact)
        return xy, float(error[np.isfinite(error)].max(initial=0.0))


@numba.njit(cache=True, nogil=True)
def _node_values(xy, table, i0, v, j0, u, floor, fineness, width, height, margin, shrink, grid):  # type: ignore[no-untyped-def]
    """One view's vote and weight at the points of a tile's grid.

    xy (r, c, 2) frame px; table (ny, nx) its votes on the lattice, between whose rows i0 and i0 + 1 a point lies with
    fraction v (r,), columns j0, u (c,); floor (r, c) resolution; fineness of the view. Into grid (r, c, 4) float32:
    px of the frame reduced by `shrink`, vote, weight. Returns how much the view counts in all, 0 = not at all.
    """
    total = 0.0
    half_x, half_y = (width - 1) / 2, (height - 1) / 2
    for i in range(xy.shape[0]):
        for j in range(xy.shape[1]):
            x, y = xy[i, j, 0], xy[i, j, 1]
            if not (np.isfinite(x) and np.isfinite(y)):
                grid[i, j, 0], grid[i, j, 1], grid[i, j, 2], grid[i, j, 3] = UNSEEN, UNSEEN, 0.0, 0.0
                x, y = 1e9, 1e9
            else:
                grid[i, j, 0], grid[i, j, 1] = (
                    (x - (shrink - 1) / 2) / shrink,
                    (y - (shrink - 1) / 2) / shrink,
                )
            # views.centrality
            off_x, off_y = abs(x - half_x) / (half_x - margin), abs(y - half_y) / (half_y - margin)
            central = 0.0
            if off_x <= 1 and off_y <= 1:
                central = (0.08 + 0.92 * (1 - off_x**2) ** 2) * (1 - 0.5 * off_y**2)
            # Resolution over the floor's, at most 2; and the same fading to 0 from the floor to 15 % below it.
            ratio = min(fineness / floor[i, j], 2.0) if floor[i, j] > 0 else 1.0
            sharp = ratio * min(max((ratio - 0.85) / 0.15, 0.0), 1.0)
            vote, member = 0.0, 0.0
            for a in range(2):
                for b in range(2):
                    share = (v[i] if a else 1 - v[i]) * (u[j] if b else 1 - u[j])
                    value = table[i0[i] + a, j0[j] + b]
                    vote += share * value
                    member += share if value > 0 else 0.0
            # A cell cut by the frame's border must not lose its half inside because its outer corner weighs nothing;
            # the sampler tests the border itself, pixel by pixel.
            inside = max(central, 0.04)
            # To decide what stands still, who sees it best counts a little; to paint it, the sharp views count most.
            grid[i, j, 2] = vote * (0.3 + 0.7 * inside) * min(max(ratio, 0.25), 2.0)
            grid[i, j, 3] = member * inside * max(sharp**8, 0.002 * ratio)
            if central * ratio * vote > 0:
                total += central * (grid[i, j, 2] + grid[i, j, 3])
    return total


def _thin_where_quiet(scene: Scene, maps: list[TileMap], x0: int, y0: int) -> None:
    """Leave, at the grid points about which all views agree, only the heaviest quiet_views of them: the rest would be
    sampled to say the same. Ranked point by point, so that tiles next to each other take the same ones."""
    assert scene.quiet is not None
    coarse = [grid[:: GRID_PX // step, :: GRID_PX // step] for _, grid, step, _ in maps]
    weight = np.stack([g[..., 2] * g[..., 3] for g in coarse])
    if scene.still is not None:
        for row, (index, _, _, shrink) in enumerate(maps):
            weight[row] *= _looked_up(scene.still[index], coarse[row], scene.views[index].size_px, shrink)
    most = min(scene.options.quiet_views, len(maps)) - 1
    rank = -np.sort(-weight, axis=0)[most]
    height, width = scene.quiet.shape
    y = (y0 + GRID_PX * np.arange(weight.shape[1]) + 0.5) * height / scene.surface.height
    x = (x0 + GRID_PX * np.arange(weight.shape[2]) + 0.5) * width / scene.surface.width
    quiet = scene.quiet[np.minimum(y.astype(int), height - 1)][:, np.minimum(x.astype(int), width - 1)] > 0
    drop = quiet & (weight < rank)
    for (_, grid, step, _), leave in zip(maps, drop, strict=True):
        n = GRID_PX // step
        if n > 1:  # a finer grid: points between dropped ones
            leave = _between(leave, n)
        grid[..., 2:][leave] = 0.0


def _between(flags: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
    """Flags of an n times finer grid: True where all the points round it are."""
    i, j = (np.arange(n * (size - 1) + 1) for size in flags.shape)
    rows = flags[i // n] & flags[-(-i // n)]
    return np.asarray(rows[:, j // n] & rows[:, -(-j // n)])


def _looked_up(
    plane: NDArray[np.uint8], grid: NDArray[np.float32], size_px: tuple[int, int], shrink: int
) -> NDArray[np.float32]:
    """A plane over a frame, 0..1, at a map's points; 0 outside."""
    at = grid[..., :2] * shrink * [plane.shape[1] / size_px[0], plane.shape[0] / size_px[1]]
    inside = ((at >= 0) & (at < [plane.shape[1], plane.shape[0]])).all(axis=-1)
    x, y = np.where(inside[..., None], at, 0).astype(int).transpose(2, 0, 1)
    return np.where(inside, plane[y, x] / np.float32(255), np.float32(0))


def _shrink(xy: NDArray[np.float64], step: int) -> int:
    """Whole factor by which a frame is finer than the panorama here: sampling it as it is would alias."""
    with np.errstate(invalid="ignore"):
        lengths = np.linalg.norm(np.diff(xy[::3], axis=1), axis=-1) / step
    finite = lengths[np.isfinite(lengths)]
    return max(1, int(np.median(finite) + 0.3)) if len(finite) else 1


def _tile_rays(
    surface: Surface, x0: int, y0: int, width: int, height: int, step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays at every step-th pixel of a tile, up to a whole cell of GRID_PX, and at the middles of their cells."""
    x, y = (
        start + step * np.arange(-(-length // GRID_PX) * (GRID_PX // step) + 1, dtype=np.float64)
        for start, length in ((x0, width), (y0, height))
    )
    rays = surface.pixel_to_ray(np.stack(np.meshgrid(x, y), axis=-1))
    middles = surface.pixel_to_ray(np.stack(np.meshgrid(x[:-1] + step / 2, y[:-1] + step / 2), axis=-1))
    return rays, middles


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


_Split = tuple[NDArray[np.intp], NDArray[np.float64]]  # lattice index below, and fraction from there


def _split(at: NDArray[np.float64], n: int) -> _Split:
    at = np.clip(at, 0, n - 1)
    low = np.minimum(at.astype(np.intp), n - 2)
    return low, at - low


def _floor(floor: NDArray[np.float64], rows: _Split, columns: _Split) -> NDArray[np.float64]:
    """Resolution floor at lattice positions; points that nobody sees do not pull it down."""
    share = _bilinear((floor > 0).astype(np.float64), rows, columns)
    return np.where(share > 0, _bilinear(floor, rows, columns) / np.maximum(share, 1e-9), 0.0)


def _bilinear(table: NDArray[np.float64], rows: _Split, columns: _Split) -> NDArray[np.float64]:
    (i, v), (j, u) = rows, columns
    upper = table[i][:, j] * (1 - u) + table[i][:, j + 1] * u
    lower = table[i + 1][:, j] * (1 - u) + table[i + 1][:, j + 1] * u
    return upper * (1 - v)[:, None] + lower * v[:, None]
