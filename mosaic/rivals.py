"""Is there another place where two pictures agree better? A coarse sweep over shifts around an alignment.

Players whom the camera follows stand still in the picture while the ground runs through it, and lines repeat: the
alignment of either is a true minimum, and the next frame, predicted from it, starts in it again. Pixels of one coarse
level at whole shifts, truncated differences: cheap enough for every pair, and what most pixels say wins. What is found
only starts the direct estimator, whose score decides. Not found: a rival that is turned or zoomed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import normalise_homography, to_level
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray, PairFit, PairStatus
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import PreparedTemplate, prepare
from mosaic.warp import WarpFamily, nearest_state

# px; the finest level at most this wide is swept: lines of a pitch are still seen there.
LEVEL_WIDTH = 320
N_PIXELS, LEAST_PIXELS = 500, 60  # of the template's at most and at least
REACH = (0.3, 0.12)  # of the width and of the height: how far from the alignment
STEP = 2  # px of the level between shifts looked at first
TRUNCATED_GREY = 15.0  # a difference that says no more than that the place is another one
LEAST_SEEN = 0.4  # share of the pixels that a shift must leave in the picture
APART = 3  # steps between two minima
# A minimum is tried where its mean truncated difference is below this times the alignment's own.
AS_GOOD = 1.1
SURE_SCORE = 0.1  # an alignment as good as this has no rival
SAME_PLACE = 1.5  # px of the level: a minimum so near is the alignment's own
# Above it the alignment may be at the right place and bent by what moves: once more from there.
BENT_SCORE = 0.25
CLEARLY = 0.9  # of the alignment's score: more than this is no reason to leave what was predicted


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Around:
    """Minima of a sweep, lowest first. shifts_px: (k, 2) full px; costs: (k,) mean truncated grey differences."""

    shifts_px: FloatArray
    costs: FloatArray


def level_of(target: Pyramid) -> int:
    """The level that is swept: the finest below full size that is at most LEVEL_WIDTH wide."""
    narrow = (i for i, lev in enumerate(target.levels) if i > 0 and lev.shape[1] <= LEVEL_WIDTH)
    return next(narrow, len(target.levels) - 1)


def look_around(
    source: PreparedTemplate,
    target: Pyramid,
    state: Any,
    *,
    gain: float = 1.0,
    offset: float = 0.0,
    n_minima: int = 3,
) -> Around:
    """Shifts, relative to `state`, at which source's pixels agree best with target; none where texture lacks."""
    seen = _placed(source, target, state, gain, offset)
    if seen is None:
        return Around(shifts_px=np.zeros((0, 2)), costs=np.zeros(0))
    scale = target.scales[level_of(target)]
    h, w = seen[0].shape
    nx, ny = (int(share * size) // STEP for share, size in zip(REACH, (w, h), strict=True))
    costs = _sweep(*seen, nx, ny, STEP, TRUNCATED_GREY, LEAST_SEEN)
    shifts, found = [], []
    for _ in range(n_minima):
        j, i = (int(v) for v in np.unravel_index(int(np.argmin(costs)), costs.shape))
        if not np.isfinite(costs[j, i]):
            break
        cost, dx, dy = _finest(*seen, (i - nx) * STEP, (j - ny) * STEP)
        shifts.append([dx * scale[0], dy * scale[1]])
        found.append(cost)
        costs[max(0, j - APART) : j + APART + 1, max(0, i - APART) : i + APART + 1] = np.inf
    return Around(shifts_px=np.array(shifts, float).reshape(-1, 2), costs=np.array(found, float))


def cost_of(source: PreparedTemplate, target: Pyramid, state: Any, *, gain: float, offset: float) -> float:
    """The sweep's measure at a state itself; inf where it cannot be taken."""
    seen = _placed(source, target, state, gain, offset)
    return np.inf if seen is None else _finest(*seen, 0, 0)[0]


def better_of_rivals(
    source: PreparedTemplate,
    target: Pyramid,
    fit: PairFit,
    state: Any,
    base: Any,
    *,
    levels: Sequence[int],
    options: RegisterOptions | None = None,
) -> tuple[PairFit, Any]:
    """The fit, or a better one found from a rival shift of `base`.

    base: a state that is right but for a shift; not the fit's own, whose shape a wrong minimum has bent. levels: those
    of the fit, so that the scores compare. Returns (fit, state) as `align` does.
    """
    if fit.status == PairStatus.OK and fit.score < SURE_SCORE:
        return fit, state
    gain, offset = (fit.gain, fit.offset) if fit.usable else (1.0, 0.0)
    around = look_around(source, target, base, gain=gain, offset=offset)
    here = cost_of(source, target, state, gain=gain, offset=offset) if fit.usable else np.inf
    swept = level_of(target)
    # From the level of the sweep on: on coarser ones players are within reach again.
    fine = [i for i in levels if i <= swept] or list(levels)
    still = source.family.warp(base, source.prepared_wide)[0]
    for shift, cost in zip(around.shifts_px, around.costs, strict=True):
        if not cost < AS_GOOD * here:
            continue
        same_place = False
        if fit.usable:
            moved_px = _median_step(source.family.warp(state, source.prepared_wide)[0] - still)
            same_place = bool(np.abs(moved_px - shift).max() <= SAME_PLACE * target.scales[swept][0])
            if same_place and fit.score < BENT_SCORE:
                continue
        moved = shifted(source.family, base, source.prepared_wide, shift)
        other, other_state = align(
            source, target, moved, dst=fit.dst, levels=fine, options=options, route="rival"
        )
        better = other.score < (fit.score if same_place else CLEARLY * fit.score)
        if other.usable and (better or not fit.usable):
            fit, state = other, other_state
    return fit, state


def shift_starts(
    source: PreparedTemplate,
    target: Pyramid,
    state: FloatArray,
    *,
    levels: Sequence[int],
    options: RegisterOptions | None = None,
) -> Iterator[FloatArray]:
    """Homographies H_dst_src (3, 3) to start from where nothing is predicted: the minima of a sweep around `state`,
    each brought near by a homography that is pulled to what cameras do.

    Eight free parameters bend towards hoardings and players before they are near (measured on rendered pairs with
    hoardings over a tenth of the picture: 1 px wrong, and .2 px from the same shift by way of the pulled ones).
    """
    stiff = prepare(source.template, StiffHomographyFamily(size_px=target.size_px))
    for dx, dy in look_around(source, target, state).shifts_px:
        moved = normalise_homography(np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]]) @ state)
        _, near = align(stiff, target, moved, dst=1, levels=levels, options=options)
        yield near


def shifted(family: WarpFamily, state: Any, prepared: Any, shift_px: FloatArray) -> Any:
    """The state of any family that moves the prepared points nearest to where `state` does, plus the shift (2,) px."""
    where, _, _ = family.warp(state, prepared)
    return nearest_state(family, state, prepared, where + shift_px)


def _median_step(steps_px: FloatArray) -> FloatArray:
    """The median (2,) of steps (n, 2) px, of which some are NaN; NaN where all are."""
    # Of so few np.nanmedian makes a masked array, which takes longer than the warp.
    known = steps_px[np.isfinite(steps_px).all(axis=1)]
    return np.asarray(np.median(known, axis=0)) if len(known) else np.full(2, np.nan)


def _placed(
    source: PreparedTemplate, target: Pyramid, state: Any, gain: float, offset: float
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]] | None:
    """The level (h, w), NaN where masked; places of the template's pixels in it; their values in its light."""
    index = level_of(target)
    level = source.template.levels[index]
    if level is None:
        return None
    stride = max(1, len(level.src_px) // N_PIXELS)
    where, _, _ = source.family.warp(state, source.prepared[index])
    at = to_level(where[::stride], target.scales[index])
    good = np.isfinite(at).all(axis=1) & (np.abs(at) < 1e6).all(axis=1)
    if good.sum() < LEAST_PIXELS:
        return None
    x, y = np.floor(at[good] + 0.5).astype(np.int64).T
    values = (level.values[::stride][good] - np.float32(offset)) / np.float32(gain)
    return _usable(target, index), np.ascontiguousarray(x), np.ascontiguousarray(y), values


def _usable(target: Pyramid, index: int) -> NDArray[np.float32]:
    """The level (h, w), NaN where it is masked."""
    level = target.levels[index]
    if target.mask is None:
        return np.ascontiguousarray(level, np.float32)
    return _unmasked(level, target.mask)


def _finest(picture: Any, x: Any, y: Any, values: Any, dx: int, dy: int) -> tuple[float, int, int]:
    """(cost, dx, dy) of the best whole shift next to one of the sweep."""
    costs = _next_to(picture, x + dx, y + dy, values, TRUNCATED_GREY, LEAST_SEEN)
    j, i = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return float(costs[j, i]), dx + int(i) - 1, dy + int(j) - 1


@nb.njit(cache=True, nogil=True)
def _unmasked(level, mask):  # type: ignore[no-untyped-def]
    """A level (h, w) as float32, NaN where the nearest pixel of a mask of another size is 0."""
    h, w = level.shape
    mh, mw = mask.shape
    out = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            usable = mask[y * mh // h, x * mw // w] != 0
            out[y, x] = np.float32(level[y, x]) if usable else np.float32(np.nan)
    return out


@nb.njit(cache=True, nogil=True)
def _next_to(picture, x, y, values, most, least_seen):  # type: ignore[no-untyped-def]
    """`_sweep` over the shifts of a pixel and none (3, 3): without its planes, which are for many shifts."""
    h, w = picture.shape
    n = len(x)
    total = np.zeros((3, 3), np.float32)
    seen = np.zeros((3, 3), np.float32)
    top = np.float32(most)
    for k in range(n):
        for j in range(3):
            for i in range(3):
                a, b = x[k] + i - 1, y[k] + j - 1
                if a < 0 or b < 0 or a >= w or b >= h:
                    continue
                away = abs(picture[b, a] - np.float32(values[k]))
                if away < np.float32(1e9):  # not for NaN
                    total[j, i] += min(away, top)
                    seen[j, i] += np.float32(1)
    out = np.full((3, 3), np.inf)
    for j in range(3):
        for i in range(3):
            if seen[j, i] >= least_seen * n and seen[j, i] > 0:
                out[j, i] = total[j, i] / seen[j, i]
    return out


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _sweep(picture, x, y, values, nx, ny, step, most, least_seen):  # type: ignore[no-untyped-def]
    """Mean truncated difference (2 ny + 1, 2 nx + 1) of values (n,) at x + step i, y + step j; inf: hardly seen."""
    h, w = picture.shape
    n, columns = len(x), 2 * nx + 1
    far_x, far_y = nx * step, ny * step
    # Columns that a step apart follow each other, and unseen ones all around: the inner loop runs in vectors (an eighth
    # of the time of one pixel after the other).
    width = (w + 4 * far_x) // step + 1
    planes = np.full((step, h + 4 * far_y, width), np.nan, np.float32)
    for s in range(step):
        a = (s - 2 * far_x) % step  # the first column that falls into this plane
        part = picture[:, a::step]
        left = (a + 2 * far_x) // step
        planes[s, 2 * far_y : 2 * far_y + h, left : left + part.shape[1]] = part
    total = np.zeros((2 * ny + 1, columns), np.float32)
    seen = np.zeros((2 * ny + 1, columns), np.float32)
    top, one, zero = np.float32(most), np.float32(1), np.float32(0)
    for k in range(n):
        if x[k] < -far_x or x[k] >= w + far_x or y[k] < -far_y or y[k] >= h + far_y:
            continue
        value = np.float32(values[k])
        first = x[k] + far_x
        for j in range(2 * ny + 1):
            row = planes[first % step, y[k] + far_y + j * step, first // step : first // step + columns]
            sums, counts = total[j], seen[j]
            for i in range(columns):
                away = abs(row[i] - value)
                known = one if away < np.float32(1e9) else zero  # none for NaN
                sums[i] += known * (away if away < top else top)
                counts[i] += known
    out = np.full((2 * ny + 1, columns), np.inf)
    for j in range(2 * ny + 1):
        for i in range(columns):
            if seen[j, i] >= least_seen * n and seen[j, i] > 0:
                out[j, i] = total[j, i] / seen[j, i]
    return out
