"""Which frames to keep for a panorama, and how much each counts where. Placements in, frame numbers and weights out.

A lattice of points lies over the surface. Every point should get K views: of the finest resolution that K views
reach, seen well inside the frame, little blurred, and as far apart in time as possible, because a player who stands
in two views at the same place is the same evidence twice. One set of frames serves the whole panorama: with a set
per tile, views would come and go at tile borders and show there as steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.surface import Placement, Surface

COVER_CELLS = 600  # over the longer side of the surface: how finely coverage is looked at
SEAM_CELLS = 4  # of these at once, of frames that lie across a seam
STRIP_VIEWS = (2, 7)  # least and most of a strip: two that disagree say so at least, a median of 7 is robust
# Views of a place where it is known who shows it clear, and moments at which it is wanted clear: a median of 7 is
# robust, and 7 views are within .05 dB of 25 where all agree.
CLEAR_VIEWS = 7
LEAST_CLEAR = 0.1  # a view that shows less of the ground about a point is of no use there
# Share of a picture below which it is not stored for the ground that it alone shows: a player in a wide shot, 25 x 60
# of 1280 x 720 px.
BODY_SHARE = 1 / 600
# Variance of the point spread of a frame that does not move, px^2: its pixels (1/12), its lens and its coder.
STILL_SPREAD_PX2 = 1 / 3
MOMENT_FRAMES = 6  # views nearer than this say the same about a place
LEAST_RATIO = 0.08  # of the resolution floor: a view coarser than this does not even vote


@dataclass(frozen=True, slots=True, kw_only=True)
class CompositeOptions:
    """views: K, good views wanted at each point (measured: 15 to 25, more buys nothing). tile_px: side of the tiles
    worked on at a time. finer: zoom ratio from which a sharper view displaces a coarser one. min_span: frames that
    the K sharpest views of a point must span before coarser ones are left out (4 s at 25 fps: a player has moved).
    min_gap: frames between views below which one more of the same place is not worth storing. strip, strip_gap: a frame
    that is wanted for less than this share of a picture is stored only where a point has less than one view (seven are
    enough) per strip_gap frames: in .5 s a runner has left his place. Without it, 200 of a clip's 240 frames served
    the last 4 % of its panorama: strips that a zoom passes by.
    pool: frames kept, as a multiple of K times (panorama area / frame area). margin_px, feather: border of a frame
    that is not used, and share of its width over which its weight rises. cubic: Catmull-Rom, else linear.
    floor, cap, doubt: grey levels, see blend.robust_value. max_views: most views of one tile (memory).
    threads: tiles worked on at once. memory_bytes: an image larger than this lives in a file in the scratch folder.
    gains: level the exposure of the views and the lens's falloff. motion_rounds: rounds of learning
    what bodies look like and of deciding what the ground is (moving.py): the third and fourth change .1 dB; 0 = none.
    together: decide for all pixels at once what is seen side by side (states.py), not for each by itself.
    quiet_views: views sampled where all agree about what they show (moving.py): 7 to 25 differ by .05 dB there, and
    half of the time goes into sampling.
    detail: share of the fine detail that frames' pixels average away and that is given back (detail.py); 0 = none.
    max_candidates: frames looked at when planning; a longer clip is thinned, the least blurred of each group stays.
    """

    views: int = 17
    tile_px: int = 512
    finer: float = 1.3
    min_span: int = 100
    min_gap: float = 3.0
    strip: float = 0.05
    strip_gap: float = 12.0
    pool: float = 2.5
    margin_px: float = 3.0
    feather: float = 0.06
    cubic: bool = True
    floor: float = 3.0
    cap: float = 10.0
    doubt: float = 6.0
    max_views: int = 56
    threads: int = 2
    memory_bytes: int = 200_000_000
    max_candidates: int = 1200
    gains: bool = True
    motion_rounds: int = 2
    together: bool = True
    quiet_views: int = 9
    detail: float = 0.2

    def __post_init__(self) -> None:
        if not 1 <= self.views <= self.max_views <= 255:
            raise ValueError(
                f"views {self.views} and max_views {self.max_views}: need 1 <= views <= max_views <= 255"
            )
        if self.tile_px < 32 or self.tile_px % 16 or self.threads < 1:
            raise ValueError(
                f"tile_px {self.tile_px} must be a multiple of 16 from 32, threads {self.threads} >= 1"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """Points over a surface: x_px (nx,), y_px (ny,), rays (ny * nx, 3) row by row."""

    x_px: NDArray[np.float64]
    y_px: NDArray[np.float64]
    rays: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownGround:
    """Where some frames of a shot show the ground. frames (n,), ascending; clear (n, p): of each the cells of the
    surface, all of one size, where nobody stands before it. vote (n,), 0..1: how much a frame's resolution lets it
    count. cells_seen: that a frame covers, whoever stands there."""

    frames: NDArray[np.int64]
    clear: NDArray[np.bool_]
    vote: NDArray[np.float32]
    cells_seen: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPlan:
    """Frames to store for a panorama, ascending. n_views (ny, nx): good views per lattice point. n_candidates: how
    many frames were looked at. limit: most frames that this panorama's area allows."""

    frames: tuple[int, ...]
    n_views: NDArray[np.int32]
    n_candidates: int
    limit: int

    def bytes_needed(self, size_px: tuple[int, int]) -> int:
        """Scratch space for the frames as 8-bit RGB, masks not counted."""
        return len(self.frames) * size_px[0] * size_px[1] * 3


def lattice_of(surface: Surface, n_points: int = 1200) -> Lattice:
    """About n_points points over the surface, its four corners and its middle lines among them, not closer than 24 px
    where there is room."""
    spacing = max(24.0, float(np.sqrt(surface.width * surface.height / n_points)))
    # Three at least: the sides of a panorama 20 px high lie in the border that no frame is believed in.
    axes = [
        np.linspace(0, n - 1, max(min(n, 3), 2, int(np.ceil((n - 1) / spacing)) + 1))
        for n in (surface.width, surface.height)
    ]
    xy = np.stack(np.meshgrid(axes[0], axes[1]), axis=-1).reshape(-1, 2)
    return Lattice(x_px=axes[0], y_px=axes[1], rays=surface.pixel_to_ray(xy))


def resolution(placement: Placement) -> float:
    """Resolution of a frame in px per radian, lessened by its motion blur: by how much wider that makes its point
    spread along the motion."""
    return float(placement.px_per_rad / np.sqrt(1.0 + placement.blur_px**2 / 12 / STILL_SPREAD_PX2))


def centrality(xy: NDArray[np.float64], size_px: tuple[int, int], margin_px: float) -> NDArray[np.float32]:
    """0..1: how well a frame sees points at its pixels xy (..., 2); 0 outside, NaN pixels included.

    Falls towards the sides, because distortion, vignetting and the parallax of a camera whose pupil lies in front
    of the pan axis all grow there: the views that agree best about a point are those that look at it.
    """
    half = (np.array(size_px, dtype=np.float64) - 1) / 2
    if half.min() <= margin_px:
        return np.zeros(xy.shape[:-1], np.float32)
    off = np.abs(xy - half) / (half - margin_px)
    with np.errstate(invalid="ignore"):
        inside = (off <= 1).all(axis=-1)
        value = (0.08 + 0.92 * (1 - off[..., 0] ** 2) ** 2) * (1 - 0.5 * off[..., 1] ** 2)
    return np.where(inside, value, 0.0).astype(np.float32)


def resolution_floor(
    sees: NDArray[np.bool_],
    fineness: NDArray[np.float64],
    time: NDArray[np.float64],
    options: CompositeOptions,
) -> NDArray[np.float64]:
    """Per point, the coarsest resolution that still counts as sharp. sees (n, p), fineness and time (n,) -> (p,).

    It is the best over `finer`, or less where fewer than K views, or views of less than min_span frames, reach it.
    """
    order = np.argsort(-fineness, kind="stable")
    seen, ordered, when = sees[order], fineness[order], time[order]
    floor = np.zeros(sees.shape[1])
    for point in np.flatnonzero(seen.any(axis=0)):
        rows = np.flatnonzero(seen[:, point])
        times = when[rows]
        span = np.maximum.accumulate(times) - np.minimum.accumulate(times)
        enough = (np.arange(1, len(rows) + 1) >= options.views) & (span >= min(options.min_span, span[-1]))
        last = int(np.argmax(enough)) if enough.any() else len(rows) - 1
        floor[point] = min(ordered[rows[0]] / options.finer, ordered[rows[last]])
    return floor


def choose_frames(
    quality: NDArray[np.float32],
    time: NDArray[np.float64],
    n_views: int,
    limit: int,
    *,
    min_gap: float = 0.0,
    start: Sequence[int] = (),
    strip: float = 0.0,
    strip_gap: float = 12.0,
) -> tuple[list[int], NDArray[np.int32]]:
    """Greedy choice of rows so that every column gets n_views entries, far apart in time.

    quality (n, p), 0 = does not count. Each step takes the row with the largest sum over the columns still short of
    views, of quality times the square root of the time to the nearest view that the column has (the root: the
    first seconds matter most, a player seldom stays longer). A column seen for a short while only wants a view per
    min_gap frames: more of the same moment would fill the store for a strip at the border. So does a row that
    serves fewer columns than the share `strip` of the most that any row has: it is taken for those only that have
    less than one view per moment of strip_gap frames. Ends when every column has what it wants, or at `limit` rows.
    Rows of `start` are taken first. Returns the rows in the order chosen and the count per column.
    """
    n, p = quality.shape
    count = np.zeros(p, np.int32)
    sees = quality > 0
    if not sees.any():
        return [], count
    first = np.where(sees, time[:, None], np.inf).min(axis=0)
    last = np.where(sees, time[:, None], -np.inf).max(axis=0)
    span = np.where(np.isfinite(first), last - first, 0.0)
    wanted = np.minimum(n_views, sees.sum(axis=0)).astype(np.int32)
    if min_gap > 0:
        wanted = np.minimum(wanted, 1 + span // min_gap).astype(np.int32)
    few = np.minimum(wanted, _n_moments(sees, time, strip_gap).clip(*STRIP_VIEWS))
    narrow = strip * sees.sum(axis=1).max()
    value = quality.copy()
    apart = np.full((n, p), np.sqrt(max(float(np.ptp(time)), 1.0)), np.float32)
    open_columns = np.arange(p)  # the columns of value and apart: finished ones are dropped now and then
    chosen: list[int] = []
    given = list(start)
    while len(chosen) < limit:
        if given:
            best = given.pop(0)
        else:
            gain = np.einsum("fp,fp->f", value, apart)
            best = int(np.argmax(gain))
            if not gain[best] > 0:
                break
            open_here = np.flatnonzero(value[best] > 0)
            if len(open_here) < narrow:
                there = open_columns[open_here]
                enough = open_here[count[there] >= few[there]]
                value[:, enough] = 0
                if len(enough) == len(open_here):
                    continue
        chosen.append(best)
        count[sees[best]] += 1
        touched = np.flatnonzero(sees[best, open_columns])
        nearer = np.sqrt(np.abs(time - time[best])).astype(np.float32)
        apart[:, touched] = np.minimum(apart[:, touched], nearer[:, None])
        value[best] = 0
        done = count[open_columns] >= wanted[open_columns]
        value[:, touched[done[touched]]] = 0
        if done.sum() > len(open_columns) // 4:
            keep = ~done
            open_columns, value, apart = open_columns[keep], value[:, keep].copy(), apart[:, keep].copy()
    return chosen, count


def _n_moments(sees: NDArray[np.bool_], time: NDArray[np.float64], gap: float) -> NDArray[np.int_]:
    """In how many stretches of `gap` frames each column of sees (n, p) is seen, (p,)."""
    stretch = np.floor(time / gap)
    return np.sum([sees[stretch == k].any(axis=0) for k in np.unique(stretch)], axis=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rating:
    """How well n frames see p lattice points. quality (n, p), 0 = does not count. floor (p,): coarsest resolution that
    counts, px/rad, 0 where nobody looks. rare (n, p): True where a frame is much sharper than the floor, but for so
    short a moment that coarser frames count beside it."""

    quality: NDArray[np.float32]
    floor: NDArray[np.float64]
    rare: NDArray[np.bool_]


def rate_views(placements: Sequence[Placement], lattice: Lattice, options: CompositeOptions) -> Rating:
    """Rate placements at the lattice points: centrality, and no coarser than the resolution floor."""
    fineness = np.array([resolution(p) for p in placements])
    time = np.array([p.frame for p in placements], dtype=np.float64)
    central = np.stack(
        [centrality(p.ray_to_pixel(lattice.rays), p.size_px, options.margin_px) for p in placements]
    )
    sees = central > 0
    floor = resolution_floor(sees, fineness, time, options)
    best = np.where(sees, fineness[:, None], 0.0).max(axis=0)
    enough = sees & (fineness[:, None] >= 0.999 * floor)
    rare = sees & (fineness[:, None] * options.finer >= best) & (floor < 0.9 * best / options.finer)
    # Mild: the centre is preferred, but not so much that the views crowd in the moments of one pass.
    return Rating(
        quality=np.where(enough, 0.4 + 0.6 * central, 0.0).astype(np.float32), floor=floor, rare=rare
    )


def select_views(
    rating: Rating,
    placements: Sequence[Placement],
    options: CompositeOptions,
    *,
    n_views: int,
    min_gap: float = 0.0,
) -> tuple[list[int], NDArray[np.int32], int]:
    """Indices of the placements to use, the views per lattice point, and the most that the area allows.

    First a third of K views from short moments of closer zoom, for detail that no other frame has; then n_views far
    apart in time, which say what stands still.
    """
    limit = frame_limit(rating.quality, options)
    time = np.array([p.frame for p in placements], dtype=np.float64)
    rare = np.where(rating.rare, rating.quality, np.float32(0))
    sharp, _ = choose_frames(rare, time, -(-options.views // 3), limit, min_gap=min_gap)
    chosen, count = choose_frames(
        rating.quality, time, n_views, limit, min_gap=min_gap, start=sharp,
        strip=options.strip, strip_gap=options.strip_gap,
    )  # fmt: skip
    return chosen, count, limit


def share_views(
    placements: Sequence[Placement],
    rating: Rating,
    lattice: Lattice,
    scale_px: float,
    options: CompositeOptions,
    clear: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Votes 0..1 of the views at the lattice points, (n, ny, nx), 0 = does not count; interpolated in between.

    At most K views a point (a third of K from rare close-ups first), far apart in time, and half as many coarser ones,
    which may be the only ones to show the ground. Views of one moment share
    a vote: a player who stands still for two seconds is one observation, however often he was filmed meanwhile.
    A point that fewer than K see also takes the frames that nearly reach it, nearest first: a frame
    that covers a part of a lattice cell may see none of its corners. scale_px: px per radian of the surface.
    clear (n, p), 0..1: how much of the ground about a point a view shows, where that is known; where the views taken
    show less than a third of K between them, others that show it are taken as well.
    """
    ny, nx = len(lattice.y_px), len(lattice.x_px)
    time = np.array([p.frame for p in placements], dtype=np.float64)
    cell = 1.5 * max(np.diff(lattice.x_px).max(), np.diff(lattice.y_px).max())
    reach = np.stack(
        [_inside_px(p.ray_to_pixel(lattice.rays), p.size_px) * scale_px / p.px_per_rad for p in placements]
    )
    fine = np.array([resolution(p) for p in placements])[:, None] >= 0.85 * rating.floor
    near = np.where((rating.quality == 0) & fine & (reach < 0), np.maximum(1 + reach / cell, 0.0), 0.0)
    shape = (len(placements), ny, nx)
    coarse = np.where(
        (reach > options.margin_px) & ~fine, np.sqrt(clipped_ratio(placements, rating.floor)), 0.0
    )
    quality, rare, near = rating.quality.reshape(shape), rating.rare.reshape(shape), near.reshape(shape)
    coarse = coarse.reshape(shape)
    taken = np.zeros(shape, bool)
    before = np.zeros(shape[:2], bool)
    for column in range(nx):
        # What the neighbour took is preferred: fewer different frames in a tile.
        liked = quality[:, :, column] * np.where(before, np.float32(1.5), np.float32(1))
        here = _spread_in_time(
            liked * rare[:, :, column], time, -(-options.views // 3), np.zeros(shape[:2], bool)
        )
        here = _spread_in_time(liked, time, options.views, here)
        here = _spread_in_time(near[:, :, column], None, options.views, here)
        before = here
        # Coarser or blurred views of other moments cannot add detail, but may be the only ones that show the ground.
        wanted = here.sum(axis=0) + -(-options.views // 2)
        here = _spread_in_time(coarse[:, :, column], time, wanted, here)
        if clear is not None:
            shown = clear.reshape(shape)[:, :, column]
            least = -(-options.views // 3)
            more = np.where((here * shown).sum(axis=0) < least, least, 0)
            any_view = np.maximum(quality, coarse)[:, :, column] * np.where(shown > LEAST_CLEAR, shown, 0)
            here = _spread_in_time(any_view, time, here.sum(axis=0) + more, here)
        taken[:, :, column] = here
    return _independence(taken.reshape(len(placements), -1), time, options.min_span).reshape(shape)


def clipped_ratio(placements: Sequence[Placement], floor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Resolution of each frame over the floor at each point (n, p), at most 1; 0 below LEAST_RATIO."""
    fineness = np.array([resolution(p) for p in placements])[:, None]
    ratio = np.minimum(fineness / np.maximum(floor, 1e-9), 1.0)
    return np.where(ratio < LEAST_RATIO, 0.0, ratio)


def _independence(taken: NDArray[np.bool_], time: NDArray[np.float64], span: float) -> NDArray[np.float32]:
    """Vote (n, p) of each view taken: 1 / (1 + sum over the others of exp(-time apart / span))."""
    alike = np.exp(-np.abs(time[:, None] - time) / span).astype(np.float32)
    return np.where(taken, 1 / np.maximum(alike @ taken.astype(np.float32), 1.0), 0.0).astype(np.float32)


def _spread_in_time(
    quality: NDArray[np.floating],
    time: NDArray[np.float64] | None,
    n_views: int | NDArray[np.int_],
    taken: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Fill every column of `taken` (n, p) up to n_views, each time by the largest quality x root of the time to the
    nearest one taken (time None: by quality alone). Returns the fuller (n, p)."""
    taken = taken.copy()
    columns = np.arange(taken.shape[1])
    apart = np.ones(taken.shape)
    if time is not None:
        gap = np.abs(time[:, None] - time)
        apart *= max(float(np.ptp(time)), 1.0)
        for row in np.flatnonzero(taken.any(axis=1)):
            apart[:, taken[row]] = np.minimum(apart[:, taken[row]], gap[:, row, None])
    for _ in range(int(np.max(n_views))):
        score = np.where(taken, 0.0, quality * np.sqrt(apart))
        best = score.argmax(axis=0)
        useful = (score[best, columns] > 0) & (taken.sum(axis=0) < n_views)
        if not useful.any():
            break
        rows, where = best[useful], columns[useful]
        taken[rows, where] = True
        if time is not None:
            apart[:, where] = np.minimum(apart[:, where], gap[:, rows])
    return taken


def _inside_px(xy: NDArray[np.float64], size_px: tuple[int, int]) -> NDArray[np.float64]:
    """Distance (...,) of frame pixels to the frame's border, px, negative outside, -inf where not defined."""
    half = (np.array(size_px, dtype=np.float64) - 1) / 2
    return np.nan_to_num((half - np.abs(xy - half)).min(axis=-1), nan=-np.inf, neginf=-np.inf, posinf=-np.inf)


def plan_views(
    placements: Sequence[Placement],
    surface: Surface,
    options: CompositeOptions | None = None,
    shown: ShownGround | None = None,
) -> ViewPlan:
    """Which frames a second pass over the clip has to keep. Cost and result are bounded by the panorama's area.

    placements: approximate ones will do, composite() looks again at the final ones. shown: what is known of where
    bodies stand (glances.py). With it as many views are planned as suffice where all agree, and then frames that
    show the ground where those hide it, no more in all than K views everywhere would take. No frames: none sees a
    point of the surface within its margin (a panorama a few pixels high). Raises ValueError when there is no
    placement.
    """
    options = options or CompositeOptions()
    candidates = _thin([p for p in placements if np.isfinite(p.px_per_rad)], options.max_candidates)
    if not candidates:
        raise ValueError("no placement to plan a panorama for")
    lattice = lattice_of(surface)
    rating = rate_views(candidates, lattice, options)
    outlines = _Outlines(candidates, surface)

    def chosen_for(n_views: int) -> tuple[set[int], NDArray[np.int32], int]:
        chosen, count, limit = select_views(
            rating, candidates, options, n_views=n_views, min_gap=options.min_gap
        )
        if chosen:
            chosen = [*chosen, *_cover_rest(outlines, chosen, limit // 2)]
        return {candidates[i].frame for i in chosen}, count, limit

    frames, count, limit = chosen_for(options.views)
    if frames and shown is not None:
        most, n_views = len(frames), min(options.views, CLEAR_VIEWS)
        frames, count, _ = chosen_for(n_views)
        frames.update(show_rest(shown, sorted(frames), n_views, most - len(frames)))
    return ViewPlan(
        frames=tuple(sorted(frames)),
        n_views=count.reshape(len(lattice.y_px), len(lattice.x_px)),
        n_candidates=len(candidates),
        limit=limit,
    )


def show_rest(shown: ShownGround, chosen: Sequence[int], n_views: int, limit: int) -> list[int]:
    """Further frames of `shown`, `limit` at most, so that every cell is seen clear at n_views moments, or at as many as
    there are.

    chosen: frames that are stored anyway, ascending; each is taken to show what the nearest in time of `shown` does.
    The first moment tells most: a cell counts by one over the moments that it has. Ends where no frame is worth a body.
    """
    if not len(shown.frames):
        return []
    rows = sorted({int(np.argmin(np.abs(shown.frames - frame))) for frame in chosen})
    wanted = np.minimum(n_views, _n_moments_clear(shown.frames, shown.clear))
    wanting = np.flatnonzero(_n_moments_clear(shown.frames[rows], shown.clear[rows]) < wanted)
    clear, wanted = shown.clear[:, wanting], wanted[wanting]  # the others need not be looked at again
    have = np.zeros(len(wanting), np.int32)
    # What each would add: nothing where a view of the same moment is clear as well.
    new = shown.vote[:, None] * clear

    def take(row: int) -> None:
        have[new[row] > 0] += 1
        same = np.abs(shown.frames - shown.frames[row]) < MOMENT_FRAMES
        new[same] *= ~clear[row]

    for row in rows:
        take(row)
    added: list[int] = []
    while len(added) < limit:
        gain = new @ np.where(have < wanted, 1 / (1 + have), 0).astype(np.float32)
        best = int(np.argmax(gain))
        if gain[best] < BODY_SHARE * shown.cells_seen:
            break
        take(best)
        added.append(int(shown.frames[best]))
    return added


def _n_moments_clear(frames: NDArray[np.int64], clear: NDArray[np.bool_]) -> NDArray[np.int32]:
    """At how many moments each column of clear (n, p) is set; frames (n,), ascending."""
    count = np.zeros(clear.shape[1], np.int32)
    last = np.full(clear.shape[1], -(10**9), np.int64)
    for frame, here in zip(frames, clear, strict=True):
        new = here & (frame - last >= MOMENT_FRAMES)
        count += new
        last[new] = frame
    return count


class _Outlines:
    """The cells of a surface that each placement covers, drawn when they are asked for, once."""

    def __init__(self, placements: Sequence[Placement], surface: Surface) -> None:
        self._placements, self._surface = placements, surface
        self._step = max(surface.width, surface.height) / COVER_CELLS
        self.shape = (int(np.ceil(surface.height / self._step)), int(np.ceil(surface.width / self._step)))
        self._bits: dict[int, NDArray[np.uint8]] = {}  # 10 kB each

    def __len__(self) -> int:
        return len(self._placements)

    def bits(self, i: int) -> NDArray[np.uint8]:
        """The cells that the i-th placement covers, row by row, packed."""
        if i not in self._bits:
            own = np.zeros(self.shape, np.uint8)
            _draw_outline(own, self._placements[i], self._surface, self._step)
            self._bits[i] = np.packbits(own)
        return self._bits[i]


def _cover_rest(outlines: _Outlines, chosen: Sequence[int], limit: int) -> list[int]:
    """Further placements, `limit` at most, that see what none of the chosen ones does: strips between lattice points,
    and what only a coarse or blurred frame reaches."""
    missed = ~np.bitwise_or.reduce([outlines.bits(i) for i in chosen])
    gains: list[tuple[int, NDArray[np.intp]]] = []
    for i in sorted(set(range(len(outlines))) - set(chosen)):
        new = outlines.bits(i) & missed
        if new.any():
            gains.append((i, np.flatnonzero(np.unpackbits(new))))
    open_cells = np.unpackbits(missed).view(bool)
    added: list[int] = []
    while gains and len(added) < limit:
        counts = [int(open_cells[cells].sum()) for _, cells in gains]
        best = int(np.argmax(counts))
        if counts[best] == 0:
            break
        added.append(gains[best][0])
        open_cells[gains[best][1]] = False
    return added


def _draw_outline(cells: NDArray[np.uint8], placement: Placement, surface: Surface, step: float) -> None:
    """Set the cells, `step` panorama px wide, that a frame covers; none where its border leaves the surface."""
    width, height = placement.size_px
    u = np.linspace(0, 1, 9)[:-1]
    zero, one = np.zeros_like(u), np.ones_like(u)
    border = np.concatenate(
        [np.stack(p, axis=-1) for p in ((u, zero), (one, u), (1 - u, one), (zero, 1 - u))]
    )
    at = surface.ray_to_pixel(placement.pixel_to_ray(border * [width - 1.0, height - 1.0])) / step
    if not np.isfinite(at).all():
        return
    sides = np.linalg.norm(at - np.roll(at, 1, axis=0), axis=1)
    if sides.max() < max(cells.shape) / 2:
        cv2.fillPoly(cells, [np.rint(at - 0.5).astype(np.int32)], 1)
        return
    # Across the seam of a full turn, or where Pannini's surface runs to infinity: the outline encloses nothing there.
    rows, columns = (np.arange(0, n, SEAM_CELLS) for n in cells.shape)
    xy = np.stack(np.meshgrid(columns, rows), axis=-1) + SEAM_CELLS / 2
    seen = _inside_px(placement.ray_to_pixel(surface.pixel_to_ray(xy * step)), placement.size_px) >= 0
    whole = seen.astype(np.uint8).repeat(SEAM_CELLS, axis=0).repeat(SEAM_CELLS, axis=1)
    np.maximum(cells, whole[: cells.shape[0], : cells.shape[1]], out=cells)


def frame_limit(quality: NDArray[np.float32], options: CompositeOptions) -> int:
    """Most frames to keep: pool x K x (points seen by anyone / points seen by a frame)."""
    per_frame = (quality > 0).sum(axis=1)
    if not per_frame.any():
        return 0
    frames_wide = float((quality > 0).any(axis=0).sum() / np.median(per_frame[per_frame > 0]))
    return int(np.ceil(options.pool * options.views * max(1.0, frames_wide)))


def _thin(placements: Sequence[Placement], limit: int) -> list[Placement]:
    """At most `limit` placements, evenly over time; of each group the least blurred."""
    ordered = sorted(placements, key=lambda p: p.frame)
    if len(ordered) <= limit:
        return ordered
    cuts = np.linspace(0, len(ordered), limit + 1).astype(int)
    return [min(ordered[a:b], key=lambda p: p.blur_px) for a, b in pairwise(cuts)]
