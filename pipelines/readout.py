"""The rolling shutter of a shot: found from every frame's pairs, taken out of what keyframes and frames measured.

A row read later sees a turning camera further on its way. Left in, it bends the lens model and the principal point of a
pan (measured on a real soccer clip: .34 of a frame's time; out, the residual that all pairs share falls from .34 to .02
px, the stated focal error from 8 to 4 %). A pair registered through a warp without it keeps a fifth to a half of it to
itself, so keyframes are registered again through one that has it, until neither lens nor read-out moves.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.pupil import without_parallax
from calib.records import HomographyGraph, Solution
from calib.refine import refine
from calib.rolling_shutter import RollingShutter, rates_at, rolling_shutter, without_rolling_shutter
from mosaic.records import PairFit
from pipelines.bridge import Rolling, homography_graph, rolling_of
from pipelines.keyframe_graph import KeyframeResult

log = logging.getLogger(__name__)

MAX_ROUNDS = 6  # of registering keyframes and estimating again
SHARE_SETTLED = 0.01
SETTLED = 0.001  # change of mean log f at which they stop
BETTER = 0.97  # of the keyframes' chi-square: a read-out that explains less is none


def with_readout(
    result: KeyframeResult,
    fits: Sequence[PairFit],
    register: Callable[[Solution, Rolling | None], list[PairFit]],
    poses: Callable[[KeyframeResult, Solution | None], Solution],
) -> KeyframeResult:
    """The keyframes without the effect of a rolling shutter where the shot shows one; `readout` says what was found.

    fits: of frames to keyframes. register: the keyframe pairs anew, through a solution's lens and a rolling shutter.
    poses: every frame's camera, by keyframes and from an earlier track.
    """
    solution = result.solution
    if not (result.options.distortion and np.isfinite(solution.log_f).sum() >= 2):
        return result
    track = poses(result, None)
    found = _look(result, fits, track)
    plain = replace(result, readout=found)
    best = plain
    for _ in range(MAX_ROUNDS if found.found else 0):
        pairs = register(best.solution, rolling_of(found.share, track))
        graph = homography_graph(best.solution.frames, pairs, result.graph.size_px)
        if result.parallax is not None:
            graph = without_parallax(graph, best.solution, result.parallax)
        rates = rates_at(track, best.solution.frames)
        refined = refine(
            without_rolling_shutter(graph, best.solution, found.share, rates),
            start=best.solution,
            priors=solution.priors,
            options=replace(result.options, reference=best.solution.reference),
        )
        if not (np.isfinite(refined.log_f).all() and refined.chi2_dof < BETTER * solution.chi2_dof):
            return replace(plain, readout=replace(found, found=False, reason="not_better"))
        again = rolling_shutter(graph, refined, rates)
        if not again.found:  # too few keyframes to say more than the frames did
            again = found
        change = float(np.mean(refined.log_f - best.solution.log_f))
        log.debug("rolling shutter %.3f, then %.3f: log f moved by %.4f", found.share, again.share, change)
        settled = abs(change) < SETTLED and abs(again.share - found.share) < SHARE_SETTLED
        found = again
        mended = without_rolling_shutter(graph, refined, found.share, rates)
        best = replace(best, solution=refined, graph=mended, fits=tuple(pairs), readout=found)
        if settled:
            break
        track = poses(best, track)
    return best


def without_readout(graph: HomographyGraph, track: Solution, result: KeyframeResult) -> HomographyGraph:
    """A graph of frames without what keyframes' pupil and rolling shutter moved in it; track: its frames' cameras."""
    if result.parallax is not None:
        graph = without_parallax(graph, track, result.parallax)
    if result.readout_share is not None:
        graph = without_rolling_shutter(graph, track, result.readout_share)
    return graph


def _look(result: KeyframeResult, fits: Sequence[PairFit], track: Solution) -> RollingShutter:
    keyframes = set(result.solution.frames.tolist())
    graph = homography_graph(
        track.frames, [f for f in fits if f.src in keyframes and f.dst not in keyframes], result.graph.size_px
    )
    if result.parallax is not None:
        graph = without_parallax(graph, track, result.parallax)
    return rolling_shutter(graph, track)


def readout_facts(readout: RollingShutter | None) -> dict[str, Any] | None:
    """What run.json says of it: JSON-ready but for NaN; None where the shot was too little calibrated to look."""
    if readout is None:
        return None
    return {
        "found": readout.found,
        "reason": readout.reason,
        "share_of_frame": readout.share,
        "share_std": readout.share_std,
        "first_row_px": readout.px,
        "pairs": readout.n_pairs,
    }
