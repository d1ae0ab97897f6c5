"""The scene as a minority: where players or hoardings hold most of the pixels that an alignment goes by.

Several homographies from weak features, each fitted to what those before it leave over, and from the alignment that
there is; each settled on the pixels that agree to within a fixed deviation, first as a homography that cameras make;
and the one that most pixels agree with. Used where nothing else convinces: the features alone take .3 s at 640 px.
Where that fails too, what features of hardly any contrast agree on, if they are many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mosaic.coords import transfer
from mosaic.estimator import RegisterOptions, cost_at, judge_minority, settle
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray, PairFit, PairStatus
from mosaic.rescue import FeatureStart
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import PreparedTemplate, prepare
from mosaic.warp import WarpFamily

# Grey levels. Two pictures of one scene, smoothed and sampled, differ by 1 to 3 where nothing moves (noise of 2); the
# first two are for starts of some pixels. In 84 pairs with 40 % players 2 ended nearer to the truth than 4 did.
AGREE_GREY, NEAR_GREYS = 2.0, (5.0, 4.0)
# Of two alignments: with so many times more agreement the one is better whatever else is said of it.
CLEARLY_MORE = 1.1
KEPT = 0.9  # of its matches that a start keeps while it settles
# Matches that agree as a camera would move them: fewer do not say that the scene is the same
# (measured: 20 of 108 pairs of different scenes had any such matches, 31 at most).
SUPPORT = 40
# Of a match alone: SIFT's places are not better than that, and those of one place at several scales err together
# (chi-square / 8 of 20 pairs 2 to 4 without TOGETHER).
LEAST_STD_PX, TOGETHER = 0.2, 4.0
RAYLEIGH = 1.1774  # median of the length of a vector whose two coordinates have the deviation 1
CONTRADICTED = 1.25  # times as far from the matches as their own homography
# So many times the agreement of pixels is worth what matches hold: eight free parameters bend to what moves. Hoardings
# that run, with matches of their own, have about half the agreement of the scene.
HELD = 1.3


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A homography H_dst_src and how many matches of features hold it."""

    H: FloatArray
    support: int


def best_minority(
    source: PreparedTemplate,
    target: Pyramid,
    starts: Iterable[FeatureStart],
    before: FloatArray | None,
    *,
    levels: tuple[int, ...],
    options: RegisterOptions,
) -> tuple[PairFit, float] | None:
    """The homography that most pixels agree with, as a fit, and the deviation at which it was compared; None: no start.

    source: bound to a family whose state is the homography. starts: of features. before: H_dst_src (3, 3) of the
    alignment that there is, or None. levels: (1, 0) or (0,).
    """
    stiff = prepare(source.template, StiffHomographyFamily(size_px=target.size_px))
    candidates: list[_Candidate] = []
    n_steps = 0

    def settled(start: FeatureStart, ladder: tuple[int, ...]) -> FloatArray:
        nonlocal n_steps
        state = start.H_dst_src
        for bound, some, greys in (
            (stiff, ladder, NEAR_GREYS[-len(ladder) :]),
            (stiff, (0,), (AGREE_GREY,)),
            (source, (0,), (AGREE_GREY,)),
        ):
            state, steps = settle(
                bound,
                target,
                state,
                levels=some,
                greys=greys,
                options=options,
                pull=_pull(bound.family, start),
            )
            n_steps += steps
        return state

    if before is not None:
        none = np.zeros((0, 2))
        alone = FeatureStart(H_dst_src=before, src_px=none, dst_px=none, within_px=1.0)
        candidates.append(_Candidate(settled(alone, levels), 0))
    for start in starts:
        candidates.append(_Candidate(start.H_dst_src, len(start.src_px)))
        # On the half level players are within reach again, on the finest alone the answer may not be.
        for ladder in {levels, (0,)}:
            H = settled(start, ladder)
            # The pixels may refine what the matches found, not leave it.
            support = start.support(H)
            if support >= KEPT * len(start.src_px):
                candidates.append(_Candidate(H, support))
    if not candidates:
        return None
    # Weak ground agrees with anything to within AGREE_GREY: the least noise that an alignment shows is the measure.
    grey = min(cost_at(source, target, c.H, AGREE_GREY, options)[1] for c in candidates)

    def worth(candidate: _Candidate) -> float:
        held = HELD if candidate.support >= SUPPORT else 1.0
        return held * (1.0 - cost_at(source, target, candidate.H, grey, options)[0])

    best = max(candidates, key=worth)
    fit = judge_minority(
        source, target, best.H, dst=1, grey=AGREE_GREY, options=options, route="minority", n_steps=n_steps,
        supported=best.support >= SUPPORT,
    )  # fmt: skip
    return fit, grey


def of_matches(
    source: PreparedTemplate, target: Pyramid, start: FeatureStart, best: PairFit, options: RegisterOptions
) -> PairFit:
    """The best fit or, where matches of features contradict it or no score holds it, what they hold alone, weak.

    The few pixels that are still do not refine matches there: they spoil them (measured with 40 % players, 60 frames
    apart: starts of .3, .5 and .9 px from 225, 277 and 120 matches settled at 1.6, 2.6 and 2.7 px). Where a score holds
    a minority it is the better one: 17 pairs were .07 px off, and .24 px by their matches.
    """
    if len(start.src_px) < SUPPORT:
        return best
    H = start.H_dst_src
    away_px = _typical_px(start, H)
    held = best.usable and best.score <= options.score_weak
    if held and _typical_px(start, best.H_dst_src) < CONTRADICTED * away_px:
        return best
    fit = judge_minority(
        source, target, H, dst=1, grey=AGREE_GREY, options=options, route="matches", n_steps=best.n_steps,
        supported=True,
    )  # fmt: skip
    if not fit.usable:
        return best
    family = StiffHomographyFamily(size_px=target.size_px)
    _, J, _ = family.warp(H, family.prepare(start.src_px))
    std_px = max(away_px / RAYLEIGH, LEAST_STD_PX)
    N = family.pull(H)[0] + np.einsum("nik,nil->kl", J, J, dtype=np.float64) / (TOGETHER * std_px**2)
    J8 = family.warp(H, family.prepare(fit.anchors_px))[1].reshape(8, 8).astype(np.float64)
    info = np.asarray(np.linalg.inv(J8 @ np.linalg.inv(N) @ J8.T), np.float64)
    return replace(fit, status=PairStatus.WEAK, reason="minority", info=info)


def _typical_px(start: FeatureStart, H: FloatArray) -> float:
    """Median distance of the matches from where a homography puts them."""
    return float(np.median(np.linalg.norm(transfer(H, start.src_px) - start.dst_px, axis=1)))


def _pull(family: WarpFamily, start: FeatureStart) -> Callable[[Any], tuple[FloatArray, FloatArray]]:
    """What the matches of a start know of a state, and the family; see pulled.PulledWarp.pull.

    Beside the few pixels of a scene that is seen between players they keep the far corners (60 frames apart a start
    .7 px off ended 3.2 px off without them).
    """
    own = getattr(family, "pull", None)
    std_px = start.within_px / 2

    def pull(state: Any) -> tuple[FloatArray, FloatArray]:
        p = family.n_parameters
        P, g = (np.zeros((p, p)), np.zeros(p)) if own is None else own(state)
        if len(start.src_px):
            where, J, _ = family.warp(state, family.prepare(start.src_px))
            J64 = J.astype(np.float64)
            away = np.nan_to_num(where - start.dst_px)
            P = P + np.einsum("nik,nil->kl", J64, J64) / std_px**2
            g = g + np.einsum("nik,ni->k", J64, away) / std_px**2
        return P, g

    return pull


def agreement(
    source: PreparedTemplate, target: Pyramid, fit: PairFit, grey: float, options: RegisterOptions
) -> float:
    """How much of the finest level agrees with a fit to within a deviation, 0 to 1 (Tukey's)."""
    return 1.0 - cost_at(source, target, fit.H_dst_src, grey, options)[0] if fit.usable else 0.0
