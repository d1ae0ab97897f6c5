"""Two pictures, one homography: `register`, for whoever has no clip and no camera, only two images.

The direct estimator over all levels from a start or from identity; where that fails, again from phase correlation, from
features, then from the shifts at which most pixels agree, and at last for a scene that only a minority of the pixels
shows (minority.py). Whatever the start, the result is the direct estimator's and has to pass its score or, as a weak
pair, show that the minority is a scene; only where no pixels hold it, but many features do, it is theirs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mosaic.bent import other_motions
from mosaic.blur import equally_sharp
from mosaic.coded import blockiness
from mosaic.coords import level_matrix, level_scale, normalise_homography, transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.finish import finished
from mosaic.gray import as_gray, as_mask, as_planes, white_of
from mosaic.kernels import KernelName
from mosaic.level import rough
from mosaic.minority import AGREE_GREY, CLEARLY_MORE, HELD, agreement, best_minority, of_matches
from mosaic.pyramid import Pyramid, build_pyramid, n_levels_for
from mosaic.records import PAIR_REASONS, FloatArray, PairFit, PairStatus
from mosaic.rescue import (
    FAINT_CONTRAST,
    match_features,
    phase_correlation,
    small_gray,
    weak_feature_starts,
)
from mosaic.rivals import shift_starts
from mosaic.template import PreparedTemplate, SelectionOptions, build_template, prepare
from mosaic.turning import IMPOSSIBLE, contradiction, held, nearest_turn
from mosaic.warp import HomographyFamily

REASONS = {
    **PAIR_REASONS,
    "asymmetric": "the pictures the other way round give another homography",
    "bent": "no camera that turns and zooms makes this homography, and a part of the picture does not agree with it",
    "inconsistent": "too many parts of the picture were found elsewhere than the homography puts them",
    "minority": "only a minority of the pixels agree, though in regions all over the overlap or with many features",
    "uncertain": "the pixels leave the homography open: the stated error of its anchors is large",
}

# Failures that say nothing about the pair: a picture that sees five times more cannot be the template of the other.
_NO_VERDICT = ("low_overlap", "no_texture")

# Cells of a small picture have few pixels: at 480 and 640 px right pairs (under 1 px of 1280) have up to .40 of them
# away, wrong ones (over 4 px) .55 and more (40 rendered pairs from several starts, players 10 to 40 %).
SMALL, SMALL_AWAY = 0.75, 0.1

FINE_PX = 1280  # width of the pictures of the second look for features
N_FAINT = 12000  # features of the last look, of FAINT_CONTRAST

_RANK = {PairStatus.OK: 0, PairStatus.WEAK: 1, PairStatus.FAILED: 2, PairStatus.SKIPPED: 3}


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """How two pictures are registered.

    selection, estimator: which pixels, and how they are aligned and judged; four times as many as for a frame of a
    video and to the end, since two pictures can wait for it (measured: half the error). match_blur: make pictures of
    clearly unequal sharpness equal, and align them again (blur.py). rescue: try phase correlation and features where
    the direct start does not convince. smooth: the 3x3 blur that unbiased sampling wants; off for pictures that are
    soft already. symmetric_px: how far from where it began the way from a to b and back may end, rms over the measured
    cells, px of a, before the pair is weak; None: not checked. The score alone passes pairs in which most of the strong
    gradients belong to things that move by themselves.
    turning: hold what the pixels leave open by what a camera does that turns and zooms about the middle of its picture
    (turning.py): a pull, not a wall; where it cannot be what a camera does and a part of the picture disagrees too,
    look for another motion (bent.py), else say `bent`. Off to leave all eight parameters to the pixels.
    finish: end with steps on pictures that are smoothed more, and alike in the scene (finish.py).
    cell_px, max_away: a pair is weak where more than that share of the cells was found farther than cell_px from where
    the homography puts them; max_std_px: or where the anchors' stated error is larger. sure_score, sure_away,
    sure_std_px: when no other start is tried; else the best of all starts is taken, by status and score (measured on
    160 hard pairs, with the checks above: 11 wrong answers called ok before, 2 after, both 2.0 px off). Pixels of a
    picture 1280 wide, in proportion for others (below 960 px of width max_away is SMALL_AWAY larger).
    """

    selection: SelectionOptions = field(
        default_factory=lambda: SelectionOptions(n_per_level=(24000, 8000, 2000, 1000, 600, 400))
    )
    estimator: RegisterOptions = field(
        default_factory=lambda: RegisterOptions(
            max_steps=(8, 6, 6, 8, 10, 10), stop_sigmas=0.05, polish_steps=8, score_ok=0.4
        )
    )
    rescue: bool = True
    smooth: bool = True
    symmetric_px: float | None = 1.0
    match_blur: bool = True
    turning: bool = True
    finish: bool = True
    cell_px: float = 0.5
    max_away: float = 0.3
    max_std_px: float = 0.4
    sure_score: float = 0.3
    sure_away: float = 0.15
    sure_std_px: float = 0.15


def register(
    a: Any,
    b: Any,
    *,
    mask_a: Any = None,
    mask_b: Any = None,
    start: ArrayLike | None = None,
    kernel: KernelName | None = None,
    white: float | None = None,
    options: PairOptions | None = None,
) -> PairFit:
    """Homography from picture a to picture b (8 parameters), verified; a failure is a status with a reason.

    a, b: numpy (h, w) or RGB (h, w, 3), or torch (H, W), (C, H, W), (1, C, H, W); uint8, uint16 or float. They may
    differ in size. white: the value of white; default by type, floats 1 or 255 (gray.white_of). mask_a, mask_b:
    (h, w), True = usable. start: H_b_a (3, 3) to begin with, raw px; default the map that lays one frame over the
    other. kernel: 'numba' (default) or 'torch', the readable reference: equal within 1e-3 px, slower.

    Returns PairFit with src = 0 (a), dst = 1 (b): H_dst_src maps px of a into b, det 1, NaN when failed. reason: a
    code of REASONS. route says which start it came from: 'start', 'identity', 'phase correlation', 'features',
    'fine features', 'shift', 'minority' or 'matches' (minority.py), 'other motion' (bent.py), with ', blur matched'
    behind it where that was done; n_steps counts all that were tried.
    Raises ValueError or TypeError for pictures, masks or a start of the wrong shape, type or value.
    """
    options = options or PairOptions()
    if kernel is not None:
        options = replace(options, estimator=replace(options.estimator, kernel=kernel))
    planes = as_planes(a), as_planes(b)
    value = white_of(*planes) if white is None else float(white)
    if not value > 0:
        raise ValueError(f"white must be positive, got {value}")
    gray = as_gray(planes[0], value), as_gray(planes[1], value)
    n_levels = min(n_levels_for((p.shape[1], p.shape[0])) for p in gray)
    source, target = (
        replace(
            build_pyramid(
                g, n_levels=n_levels, smooth=options.smooth, mask=as_mask(m, (g.shape[1], g.shape[0]))
            ),
            blocks=blockiness(g),
        )
        for g, m in zip(gray, (mask_a, mask_b), strict=True)
    )
    return register_pyramids(source, target, start=_checked(start), options=options)


def register_pyramids(
    source: Pyramid, target: Pyramid, *, start: FloatArray | None = None, options: PairOptions | None = None
) -> PairFit:
    """`register` for pyramids of equally many levels."""
    options = options or PairOptions()
    template = build_template(source, 0, options=options.selection)
    # The increments act in the picture that they move points in.
    prepared = prepare(template, HomographyFamily(size_px=target.size_px))
    enough = options.estimator.min_pixels
    # A coarse level too poor to align on is passed over; on the finest level the estimator itself says no_texture.
    levels = [i for i in range(len(template.levels) - 1, 0, -1) if _n_pixels(prepared, i) >= enough] + [0]
    best = _best_of_starts(source, target, prepared, levels, start, options)
    if options.turning and options.rescue:
        best = _unbent(source, target, prepared, best, levels, options)
    # What no pixels hold they would spoil once more (two of 45 pairs with 40 % players: .2 and .3 px became 20 and 19).
    if options.match_blur and best.route != "matches":
        best, source, target = _equally_sharp(source, target, best, levels, options)
    # Doubted ones may drift: their pixels' robust scale is that of what moves. Noise alone makes a score high.
    if options.finish and best.usable and (best.status == PairStatus.OK or best.reason == "score"):
        best = finished(best, source, target, options.selection, options.estimator)
    return _held(best, source, target, options) if options.turning else best


def _unbent(
    source: Pyramid,
    target: Pyramid,
    prepared: PreparedTemplate,
    best: PairFit,
    levels: list[int],
    options: PairOptions,
) -> PairFit:
    """The best fit or, where no camera makes its homography, one that a camera makes and that pixels agree with too.

    Both end as the pixels leave them, free: what only the nearest turn has, they lead back.
    """
    sizes = source.size_px, target.size_px
    if not contradiction(best, *sizes) > IMPOSSIBLE:
        return best
    turn = nearest_turn(best, *sizes)
    if turn is None:
        return best
    found: list[PairFit] = []
    n_steps = best.n_steps
    for fit in other_motions(prepared, target, turn, levels=tuple(levels), options=options.estimator):
        n_steps += fit.n_steps
        if fit.usable and not contradiction(fit, *sizes) > IMPOSSIBLE:
            found.append(_judged(fit, options))
    if not found:
        return replace(best, n_steps=n_steps)
    agreed = [agreement(prepared, target, f, AGREE_GREY, options.estimator) for f in (*found, best)]
    most = int(np.argmax(agreed[:-1]))
    if not HELD * agreed[most] > agreed[-1]:
        return replace(best, n_steps=n_steps)
    fit, steps = _both_ways(found[most], _reverse(source, target, options), source, options)
    return replace(fit, n_steps=n_steps + steps)


def _equally_sharp(
    source: Pyramid, target: Pyramid, best: PairFit, levels: list[int], options: PairOptions
) -> tuple[PairFit, Pyramid, Pyramid]:
    """The fit, or the better one of the pictures made equally sharp; with the pictures that it is of."""
    if not best.usable:
        return best, source, target
    equal = equally_sharp(source, target, best.H_dst_src, best.gain, best.offset)
    if equal is None:
        return best, source, target
    again, _ = align(
        prepare(build_template(equal[0], 0, options=options.selection), HomographyFamily(size_px=target.size_px)),
        equal[1], best.H_dst_src, dst=1, levels=[i for i in (1, 0) if i in levels], options=options.estimator,
        route=best.route + ", blur matched",
    )  # fmt: skip
    again = replace(_judged(again, options), n_steps=best.n_steps + again.n_steps)
    return (again, *equal) if _order(again) < _order(best) else (best, source, target)


def _held(fit: PairFit, source: Pyramid, target: Pyramid, options: PairOptions) -> PairFit:
    """The fit with what turning cameras do; no longer `uncertain` where that was all that spoke against it.

    Weak where no camera makes it and not all of the picture agrees with it: two motions bend a homography, whereas a
    plane that another camera saw agrees with its own everywhere.
    """
    sizes = source.size_px, target.size_px
    bent = contradiction(fit, *sizes) > IMPOSSIBLE and not _is_sure(fit, options)
    fit = held(fit, *sizes)
    if fit.reason == "uncertain":
        fit = _judged(replace(fit, status=PairStatus.OK, reason=""), options)
    return (
        replace(fit, status=PairStatus.WEAK, reason="bent") if bent and fit.status == PairStatus.OK else fit
    )


def _best_of_starts(
    source: Pyramid,
    target: Pyramid,
    prepared: PreparedTemplate,
    levels: list[int],
    start: FloatArray | None,
    options: PairOptions,
) -> PairFit:
    """The first fit that convinces, else the best of all starts."""
    enough = options.estimator.min_pixels
    best: PairFit | None = None
    reverse: PreparedTemplate | None = None
    n_steps = 0
    for route, H in _starts(source, target, prepared, start, options):
        for some in _ladders(route, levels):
            fit, _ = align(prepared, target, H, dst=1, levels=some, options=options.estimator, route=route)
            n_steps += fit.n_steps
            fit = _judged(fit, options)
            alone = fit.info
            if fit.usable and options.symmetric_px is not None:
                if reverse is None:
                    reverse = _reverse(source, target, options)
                fit, steps = _both_ways(fit, reverse, source, options)
                n_steps += steps
            if best is None or _order(fit) < _order(best):
                best = fit
            if _is_sure(replace(fit, info=alone), options):
                return replace(best, n_steps=n_steps)
            if fit.reason == "no_texture" and _n_pixels(prepared, 0) < enough:
                return replace(best, n_steps=n_steps)
    assert best is not None  # identity is always tried
    if not options.rescue or _n_pixels(prepared, 0) < enough:
        return replace(best, n_steps=n_steps)
    found, steps = _of_minority(source, target, prepared, best, options)
    if found.status != PairStatus.OK and not found.score <= options.estimator.score_ok:
        found = _of_faint_matches(source, target, prepared, found, options)
    return replace(found, n_steps=n_steps + steps)


def _of_faint_matches(
    source: Pyramid, target: Pyramid, prepared: PreparedTemplate, best: PairFit, options: PairOptions
) -> PairFit:
    """The best fit or, where features of ever so little contrast agree on one, theirs."""
    small = _without_masked(source, FINE_PX), _without_masked(target, FINE_PX)
    starts = weak_feature_starts(
        *small, source.size_px, target.size_px, n_features=N_FAINT, n_starts=1, contrast=FAINT_CONTRAST
    )
    for start in starts:
        return of_matches(prepared, target, start, best, options.estimator)
    return best


def _of_minority(
    source: Pyramid, target: Pyramid, prepared: PreparedTemplate, best: PairFit, options: PairOptions
) -> tuple[PairFit, int]:
    """The best fit or, where more pixels agree with it, one that a minority of them holds; and the steps it took."""
    small = _without_masked(source, FINE_PX), _without_masked(target, FINE_PX)
    starts = weak_feature_starts(*small, source.size_px, target.size_px)
    levels = (
        (1, 0) if len(source.levels) > 1 and _n_pixels(prepared, 1) >= options.estimator.min_pixels else (0,)
    )
    before = best.H_dst_src if best.usable else None
    answer = best_minority(prepared, target, starts, before, levels=levels, options=options.estimator)
    if answer is None:
        return best, 0
    found, grey = answer
    steps = found.n_steps
    if not found.usable:
        return best, steps
    found = _judged(found, options)
    if options.symmetric_px is not None:
        found, more = _both_ways(found, _reverse(source, target, options), source, options)
        steps += more
    now, then = (agreement(prepared, target, f, grey, options.estimator) for f in (found, best))
    clearly = CLEARLY_MORE if _RANK[found.status] > _RANK[best.status] else 1.0
    return (found if now > clearly * then else best), steps


def _scaling(source: Pyramid, target: Pyramid) -> FloatArray:
    """Area scaling of the one frame to the size of the other: identity for equal sizes."""
    return level_matrix(level_scale(target.size_px, source.size_px))


def _ladders(route: str, levels: list[int]) -> list[list[int]]:
    """Levels to align on, in the order to be tried.

    A start that may be good begins fine: on a coarse level players are still within reach of each other's pixels and
    draw it away (measured: 40 % players, a start 2.4 px off; from the coarsest level 7 px, from the half .05 px).
    """
    return (
        [[1, 0], levels]
        if route in ("start", "features", "fine features", "shift") and levels[0] > 1 and 1 in levels
        else [levels]
    )


def _scale_px(fit: PairFit) -> float:
    """Pixel of a picture 1280 wide, in pixels of this one."""
    return float((fit.anchors_px[:, 0].max() - fit.anchors_px[:, 0].min()) / (0.8 * 1280))


def _share_away(fit: PairFit, cell_px: float) -> float:
    """Share of the cells that were found farther than cell_px from where the homography puts them."""
    away = fit.flow.dst_px - transfer(fit.H_dst_src, fit.flow.src_px)
    return float(np.mean(np.linalg.norm(away, axis=1) > cell_px * _scale_px(fit)))


def _anchor_std_px(fit: PairFit) -> float:
    """Rms stated error of an anchor's coordinate; inf where it is not determined."""
    if not np.linalg.cond(fit.info) < 1e12:
        return float("inf")
    return float(np.sqrt(np.trace(np.linalg.inv(fit.info)) / len(fit.info)))


def _is_sure(fit: PairFit, options: PairOptions) -> bool:
    """No other start needs to be tried."""
    return (
        fit.status == PairStatus.OK
        and fit.score <= options.sure_score
        and _share_away(fit, options.cell_px) <= options.sure_away
        and _anchor_std_px(fit) <= options.sure_std_px * _scale_px(fit)
    )


def _judged(fit: PairFit, options: PairOptions) -> PairFit:
    """The fit, weak where its own statistics do not speak for it."""
    if fit.status != PairStatus.OK:
        return fit
    small = SMALL_AWAY if _scale_px(fit) < SMALL else 0.0
    if _share_away(fit, options.cell_px) > options.max_away + small:
        return replace(fit, status=PairStatus.WEAK, reason="inconsistent")
    if _anchor_std_px(fit) > options.max_std_px * _scale_px(fit):
        return replace(fit, status=PairStatus.WEAK, reason="uncertain")
    return fit


def _both_ways(
    fit: PairFit, reverse: PreparedTemplate, source: Pyramid, options: PairOptions
) -> tuple[PairFit, int]:
    """The fit, weak if b to a, started from its inverse, does not lead back; and the steps that took.

    Its information is divided by d' info d / 8, d the distance of the anchors from where the way back puts them, if
    that is over 1: a smear that is not the same in both pictures pulls the two ways apart, and no residual shows it.
    """
    levels = [i for i in (1, 0) if _n_pixels(reverse, i) >= options.estimator.min_pixels]
    if not levels or options.symmetric_px is None or not len(fit.flow.cell):
        return fit, 0
    back, _ = align(
        reverse, source, normalise_homography(np.linalg.inv(fit.H_dst_src)), dst=0, levels=levels,
        options=rough(options.estimator),
    )  # fmt: skip
    if back.reason in _NO_VERDICT:
        return fit, back.n_steps
    away = transfer(back.H_dst_src, transfer(fit.H_dst_src, fit.flow.src_px)) - fit.flow.src_px
    if back.usable:
        other = normalise_homography(np.linalg.inv(back.H_dst_src))
        d = (transfer(fit.H_dst_src, fit.anchors_px) - transfer(other, fit.anchors_px)).ravel()
        apart = float(d @ fit.info @ d) / len(d)
        fit = replace(fit, info=fit.info / max(1.0, apart)) if np.isfinite(apart) else fit
    if back.usable and np.sqrt(np.mean(np.sum(away**2, axis=1))) <= options.symmetric_px * _scale_px(fit):
        return fit, back.n_steps
    return replace(fit, status=PairStatus.WEAK, reason="asymmetric"), back.n_steps


def _reverse(source: Pyramid, target: Pyramid, options: PairOptions) -> PreparedTemplate:
    """The second picture as the template, for the way back."""
    return prepare(
        build_template(target, 1, options=options.selection), HomographyFamily(size_px=source.size_px)
    )


def _order(fit: PairFit) -> tuple[int, float]:
    """The better of two fits comes first: by status, then by score (unknown last)."""
    return _RANK[fit.status], fit.score if np.isfinite(fit.score) else np.inf


def _n_pixels(prepared: PreparedTemplate, index: int) -> int:
    level = prepared.template.levels[index]
    return 0 if level is None else len(level.src_px)


def _checked(start: ArrayLike | None) -> FloatArray | None:
    if start is None:
        return None
    H = np.asarray(start, np.float64)
    if H.shape != (3, 3):
        raise ValueError(f"start must be a homography (3, 3), got {H.shape}")
    H = normalise_homography(H)
    if not np.isfinite(H).all():
        raise ValueError("start must be finite and regular")
    return H


def _starts(
    source: Pyramid,
    target: Pyramid,
    prepared: PreparedTemplate,
    start: FloatArray | None,
    options: PairOptions,
) -> Iterator[tuple[str, FloatArray]]:
    """Routes and their starts H_b_a, the cheap ones first; a later one is only made when it is asked for."""
    scaling = _scaling(source, target)
    if start is not None:
        yield "start", start
    yield "identity", normalise_homography(scaling)
    if not options.rescue:
        return
    estimator = options.estimator
    small_a, small_b = _without_masked(source), _without_masked(target)
    # Both rescues measure as if b had the size of a.
    H, _ = phase_correlation(small_a, small_b, source.size_px)
    yield "phase correlation", normalise_homography(scaling @ H)
    found = match_features(small_a, small_b, source.size_px)
    if found is not None:
        yield "features", normalise_homography(scaling @ found)
    # Players on 40 % of the picture leave few features of the scene: a second look, at twice the size (1 s at 1080p).
    fine_a, fine_b = _without_masked(source, FINE_PX), _without_masked(target, FINE_PX)
    if fine_a.shape[1] > small_a.shape[1]:
        found = match_features(fine_a, fine_b, source.size_px, n_features=5000)
        if found is not None:
            yield "fine features", normalise_homography(scaling @ found)
    # Where things that move hold most corners and most of the spectrum, the still scene may hold most pixels.
    levels = [i for i in (1, 0) if i < len(source.levels) and _n_pixels(prepared, i) >= estimator.min_pixels]
    for H in shift_starts(prepared, target, normalise_homography(scaling), levels=levels, options=estimator):
        yield "shift", H


def _without_masked(pyramid: Pyramid, width_px: int = 640) -> NDArray[np.uint8]:
    """The small picture for a rescue, masked pixels filled in from around them.

    A masked graphic stands still in both pictures: left in, it makes the peak at zero and matches its own features.
    """
    small = small_gray(pyramid, width_px)
    if pyramid.mask is None:
        return small
    h, w = small.shape
    usable = cv2.resize(pyramid.mask, (w, h), interpolation=cv2.INTER_NEAREST)
    if usable.all() or not usable.any():
        return small
    hidden = cv2.dilate((1 - usable).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(cv2.inpaint(small, hidden, 3, cv2.INPAINT_TELEA), np.uint8)
