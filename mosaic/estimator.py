"""Direct registration of two pictures: coarse to fine, robust, verified, with an honest local measurement.

The estimator is written against a warp family (warp.py) and a kernel (kernel_numba.py, kernel_torch.py). What it
hands on is the residual-flow grid: where each textured cell was found, whatever the family could express.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic import kernels
from mosaic.coords import anchor_information, default_anchors, fit_homography_to_flow
from mosaic.flow import measure_flow
from mosaic.level import LevelPair, Linearised, RegisterOptions
from mosaic.photometric import estimate_gain
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray, FlowGrid, PairFit, PairStatus
from mosaic.solve import newton_step, step_in_sigmas
from mosaic.template import PreparedTemplate, mask_arguments
from mosaic.verdict import alignment_score, pixel_information, regional_evidence
from mosaic.warp import WarpFamily

__all__ = ["RegisterOptions", "align", "cost_at", "costs_around", "judge_minority", "settle"]


def align(
    source: PreparedTemplate,
    target: Pyramid,
    start: Any,
    *,
    dst: int,
    levels: Sequence[int] | None = None,
    options: RegisterOptions | None = None,
    route: str = "predicted",
) -> tuple[PairFit, Any]:
    """Align a template with a picture, from a start state of the family.

    levels: from coarse to fine; default every level that the template has, coarsest first. Returns (fit, state): the
    verified PairFit and the family's state at the end. Never raises on bad pictures: the fit says what failed.
    """
    options = options or RegisterOptions()
    template = source.template
    if levels is None:
        levels = [i for i in range(len(template.levels) - 1, -1, -1) if template.levels[i] is not None]
    state = start
    n_steps = 0
    pair = _pair(source, target, levels[0], options)
    for index in levels:
        pair.index = index
        # From coarse values whatever the level: in between nothing is new.
        if index in (levels[0], levels[-1]):
            pair.gain, pair.offset = _gain(pair, state)
        coarsest = index == levels[0] and len(levels) > 1 and index >= 2
        stop = options.stop_sigmas if index == levels[-1] else options.stop_sigmas_coarse
        result = _align_level(pair, state, not coarsest, stop, options)
        if result is None:
            return _failed(template.frame, dst, template.size_px, "no_texture", route, n_steps), start
        state, steps, fine = result
        n_steps += steps
        if not np.isfinite(fine.scale):
            return _failed(template.frame, dst, template.size_px, "diverged", route, n_steps), start
    state, steps, fine = _polish(pair, state, fine, options)
    return _judge(pair, state, fine, n_steps + steps, dst, route, options), state


def _asked(family: WarpFamily, method: str) -> Any:
    """A method that only some families have (PulledWarp, ProjectiveFamily), or None.

    By name: asking a protocol takes .2 ms, longer than a small kernel."""
    return getattr(family, method, None)


def _pair(source: PreparedTemplate, target: Pyramid, index: int, options: RegisterOptions) -> LevelPair:
    return LevelPair(
        source, target, index, 1.0, 0.0, mask_arguments(target), kernels.load(options.kernel),
        _asked(source.family, "pull"),
    )  # fmt: skip


def _gain(pair: LevelPair, state: Any) -> tuple[float, float]:
    template, target = pair.source.template, pair.target
    where, _, _ = pair.source.family.warp(state, pair.source.prepared_wide)
    index = min(template.wide_level, len(target.levels) - 1)
    seen = pair.kernel.sample(target.levels[index], *target.scales[index], where, *pair.masks)
    gain, offset = estimate_gain(template.wide_values, seen)
    return float(gain), float(offset)


def _align_level(
    pair: LevelPair, state: Any, tukey: bool, stop_sigmas: float, options: RegisterOptions
) -> tuple[Any, int, Linearised] | None:
    """Steps on one level; None without texture. Accepts a step only if the robust scale does not grow."""
    level = pair.source.template.levels[pair.index]
    if level is None or len(level.src_px) < options.min_pixels:
        return None
    kernel = pair.kernel
    now = pair.evaluate(state)
    steps = 0
    damping = 0.0
    for _ in range(options.max_steps[min(pair.index, len(options.max_steps) - 1)]):
        if now.n_valid < options.min_pixels:
            now.scale = float("nan")
            return state, steps, now
        weight = kernel.robust_weights(now.residual, np.float32(now.scale), tukey)
        N, b = _normal_equations(pair, state, now, weight, now.scale)
        step = newton_step(N, b, damping)
        if step is None:
            now.scale = float("nan")
            return state, steps, now
        trial_state = pair.source.family.update(state, step)
        trial = pair.evaluate(trial_state)
        steps += 1
        # The residual scale is the merit: unlike a robust cost it does not change meaning with its own scale.
        if trial.n_valid < 0.7 * now.n_valid or not trial.scale <= 1.05 * now.scale:
            damping = 1.0 if damping == 0.0 else damping * 10.0
            if damping > 100.0:
                break
            continue
        small = step_in_sigmas(N, step, now.scale**2) < stop_sigmas
        state, now = trial_state, trial
        damping *= 0.1
        if small:
            break
    return state, steps, now


def _normal_equations(
    pair: LevelPair, state: Any, at: Linearised, weight: NDArray[np.float32], scale: float
) -> tuple[FloatArray, FloatArray]:
    """N (p, p) and b (p,) of the pixels, and of what the family knows beforehand, in grey levels^2."""
    N, b, _ = pair.kernel.accumulate(at.residual, at.G, at.J, weight)
    if pair.pull is not None:
        P, g = pair.pull(state)
        N, b = N + scale**2 * P, b - scale**2 * g
    return N, b


# The scale is this much too large before the finest level is done again with a smaller one.
_OUTLIERS = 1.15


def _polish(
    pair: LevelPair, state: Any, fine: Linearised, options: RegisterOptions
) -> tuple[Any, int, Linearised]:
    """Steps at the scale of the pixels that agree, held fixed, as long as Tukey's cost falls.

    Players, crowd and whatever else moves widen the robust scale, and with it they keep a pull on the alignment: the
    scale that is right to find it is too wide to finish it (an MM-estimator: Yohai 1987).
    """
    fine.sigma = pair.kernel.inlier_scale(fine.residual, fine.scale)
    if not fine.sigma * _OUTLIERS < fine.scale:
        return state, 0, fine
    return _descend(pair, state, fine, options.polish_steps, 1, options)


def _descend(
    pair: LevelPair, state: Any, now: Linearised, max_steps: int, tries: int, options: RegisterOptions
) -> tuple[Any, int, Linearised]:
    """Steps at the scale now.sigma, held fixed, as long as Tukey's cost falls; tries: of ever shorter steps."""
    kernel = pair.kernel
    steps = 0
    cost = kernel.tukey_cost(now.residual, now.sigma)
    while steps < max_steps:
        weight = kernel.robust_weights(now.residual, np.float32(now.sigma), True)
        N, b = _normal_equations(pair, state, now, weight, now.sigma)
        step = newton_step(N, b, 0.0)
        if step is None:
            break
        for attempt in range(tries):
            trial_state = pair.source.family.update(state, step / 3**attempt)
            trial = pair.evaluate(trial_state)
            steps += 1
            after = kernel.tukey_cost(trial.residual, now.sigma)
            good = trial.n_valid >= options.min_pixels and after < cost
            if good:
                break
        if not good:
            break
        trial.sigma = now.sigma
        state, now, cost = trial_state, trial, after
        if step_in_sigmas(N, step, now.sigma**2) < options.stop_sigmas:
            break
    return state, steps, now


def settle(
    source: PreparedTemplate,
    target: Pyramid,
    start: Any,
    *,
    levels: Sequence[int],
    greys: Sequence[float],
    options: RegisterOptions,
    pull: Callable[[Any], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[Any, int]:
    """Steps from a good start on the pixels that agree to within a deviation fixed beforehand, greys: one a level.

    Where most pixels belong to things that move, no quantile of the residuals is the noise: the scale that `align`
    finds is theirs, and it drifts away from the truth itself (measured: 40 % players in either picture, 60 frames
    apart, 5 % to 20 % of the pixels still: 2 to 50 px; at 2 grey levels .1 to .7 px). pull: what else is known of the
    state (pulled.PulledWarp), in place of what the family knows.
    Returns (state, steps); the start where a level lacks texture.
    """
    pair = _pair(source, target, levels[0], options)
    pair.pull = pull or pair.pull
    state, n_steps = start, 0
    for index, grey in zip(levels, greys, strict=True):
        pair.index = index
        level = source.template.levels[index]
        if level is None or len(level.src_px) < options.min_pixels:
            return start, n_steps
        pair.gain, pair.offset = _gain(pair, state)
        now = pair.evaluate(state)
        now.sigma = grey
        state, steps, now = _descend(pair, state, now, options.max_steps[0], 3, options)
        n_steps += steps
    return state, n_steps


def cost_at(
    source: PreparedTemplate, target: Pyramid, state: Any, grey: float, options: RegisterOptions
) -> tuple[float, float]:
    """(Tukey's cost 0..1, deviation of the pixels that agree) of the finest level at a state.

    grey: the deviation that the cost is for, and the largest that is believed of the pixels that agree."""
    pair = _pair(source, target, 0, options)
    pair.gain, pair.offset = _gain(pair, state)
    residual = pair.evaluate(state).residual
    return float(pair.kernel.tukey_cost(residual, grey)), float(pair.kernel.inlier_scale(residual, grey))


def costs_around(
    source: PreparedTemplate,
    target: Pyramid,
    state: Any,
    shifts_px: FloatArray,
    *,
    level: int,
    grey: float,
    n_pixels: int,
    options: RegisterOptions,
) -> FloatArray:
    """Tukey's cost 0..1 at the deviation grey, of some n_pixels of a level, at a state and each of shifts (k, 2)."""
    pair = _pair(source, target, level, options)
    gain, offset = _gain(pair, state)
    pixels = pair.pixels
    stride = max(1, len(pixels.values) // n_pixels)
    where, _, _ = source.family.warp(state, source.prepared[level])
    residuals = pair.kernel.shifted_residuals(
        *pair.picture, where, shifts_px, stride, pixels.values, gain, offset, *pair.masks
    ).reshape(len(shifts_px), -1)
    return np.array([pair.kernel.tukey_cost(some, grey) for some in residuals])


def judge_minority(
    source: PreparedTemplate,
    target: Pyramid,
    state: Any,
    *,
    dst: int,
    grey: float,
    options: RegisterOptions,
    route: str,
    n_steps: int,
    supported: bool,
) -> PairFit:
    """The verified PairFit of a state that only a part of the pixels may agree with, to within a deviation.

    Judged like any other, but where the score or the share of agreeing pixels refuses it, it is weak (`minority`) if
    regions all over the overlap agree better than shifted, or supported: something else than pixels speaks for it.
    """
    pair = _pair(source, target, 0, options)
    pair.gain, pair.offset = _gain(pair, state)
    fine = pair.evaluate(state)
    fine.sigma = pair.kernel.inlier_scale(fine.residual, grey)
    return _judge(pair, state, fine, n_steps, dst, route, options, minority=True, supported=supported)


def _judge(
    pair: LevelPair,
    state: Any,
    fine: Linearised,
    n_steps: int,
    dst: int,
    route: str,
    options: RegisterOptions,
    minority: bool = False,
    supported: bool = False,
) -> PairFit:
    template = pair.source.template
    level, kernel = pair.pixels, pair.kernel
    n = len(level.src_px)
    overlap = fine.n_valid / max(n, 1)
    if fine.n_valid < options.min_pixels or overlap < options.min_overlap:
        return _failed(template.frame, dst, template.size_px, "low_overlap", route, n_steps)
    score = alignment_score(pair, fine)
    weight = kernel.robust_weights(fine.residual, np.float32(fine.scale), True)
    # Inliers against a fixed bound too: a scale that has grown to swallow everything must not pass.
    inliers = float((weight > 0.1).sum()) / fine.n_valid
    reason = ""
    status = PairStatus.OK
    refused = (
        "score" if not score < options.score_weak else "few_inliers" if inliers < options.min_inliers else ""
    )
    if minority and (refused or score > options.score_ok):
        needed = options.evidence if refused else options.evidence_scored
        refused = "" if supported or regional_evidence(pair, fine) > needed else refused or "score"
        status, reason = PairStatus.WEAK, "minority"
    if refused:
        return _failed(template.frame, dst, template.size_px, refused, route, n_steps, score=score)
    if score > options.score_ok and not reason:
        status, reason = PairStatus.WEAK, "score"
    if minority and status == PairStatus.OK:
        # Most pixels agree after all: their noise, which is more than `grey` where pictures are coded, is the measure
        # (chi-square / 8 of pairs at CRF 23 to 35 was two to four times that of other routes).
        minority, fine.sigma = False, kernel.inlier_scale(fine.residual, fine.scale)
    # A minority's own noise, not the scale of what moves.
    flow = measure_flow(pair, state, replace(fine, scale=fine.sigma) if minority else fine, options)
    if len(flow.cell) < 6 and not supported:
        return _failed(template.frame, dst, template.size_px, "no_texture", route, n_steps, score=score)
    anchors = default_anchors(template.size_px)
    homography = _asked(pair.source.family, "homography")
    if homography is not None:
        # The pixels know the homography better than the grid does, whose cells all have a floor that is not noise
        # (measured at 1080p with 11 % players: corners .009 px against .09 px).
        H = homography(state)
        info = pixel_information(pair, state, fine, anchors, options.noise_ratio)
    else:
        start = _warp_homography(level.src_px, fine.dst)
        H, info9 = fit_homography_to_flow(flow.src_px, flow.dst_px, flow.info, start)
        info = anchor_information(H, info9, anchors)
    return PairFit(
        src=template.frame,
        dst=dst,
        H_dst_src=H,
        status=status,
        reason=reason,
        overlap=overlap,
        rms_grey=fine.scale,
        score=score,
        gain=pair.gain,
        offset=pair.offset,
        n_steps=n_steps,
        route=route,
        flow=flow,
        anchors_px=anchors,
        info=info,
    )


def _warp_homography(src: FloatArray, dst: FloatArray) -> FloatArray:
    """The homography closest to the family's own warp, from some of its points: start of the fit to the flow."""
    good = np.flatnonzero(np.isfinite(dst).all(axis=1))
    some = good[:: max(1, len(good) // 24)]
    H, _ = cv2.findHomography(src[some], dst[some], 0)
    return np.eye(3) if H is None else np.asarray(H, np.float64)


def _failed(
    src: int,
    dst: int,
    size_px: tuple[int, int],
    reason: str,
    route: str,
    n_steps: int,
    score: float = float("nan"),
) -> PairFit:
    return PairFit(
        src=src,
        dst=dst,
        H_dst_src=np.full((3, 3), np.nan),
        status=PairStatus.FAILED,
        reason=reason,
        overlap=0.0,
        rms_grey=float("nan"),
        score=score,
        gain=float("nan"),
        offset=float("nan"),
        n_steps=n_steps,
        route=route,
        flow=FlowGrid.empty(),
        anchors_px=default_anchors(size_px),
        info=np.zeros((8, 8)),
    )
