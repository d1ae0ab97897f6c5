"""Direct registration of two pictures: coarse to fine, robust, verified, with an honest local measurement.

The estimator is written against a warp family (warp.py) and a kernel (kernel_numba.py, kernel_torch.py). What it
hands on is the residual-flow grid: where each textured cell was found, whatever the family could express.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic import kernels
from mosaic.coords import anchor_information, default_anchors, fit_homography_to_flow
from mosaic.photometric import estimate_gain
from mosaic.pyramid import Pyramid
from mosaic.records import N_CELLS, FloatArray, FlowGrid, PairFit, PairStatus
from mosaic.solve import newton_step, step_in_sigmas
from mosaic.template import PreparedTemplate, mask_arguments


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterOptions:
    """How a pair is aligned and judged.

    max_steps: Gauss-Newton steps per level from the finest on. stop_sigmas: a level ends when a step is below this
    share of its own standard deviation (the next one would be far smaller); stop_sigmas_coarse: of coarse levels, which
    only hand on. min_overlap, min_inliers: shares of informative pixels. score_ok, score_weak: largest residual scale
    against that of shifted pictures. cell_floor_px: error of a cell's place that is not noise (crowd, codec;
    real-footage.md 6.3). cell_max_px: directions less certain are dropped. cell_linear_px: residual flow beyond which
    it is no measurement, found in flow_passes local steps. correlation: variance inflation of a cell, whose residuals
    are correlated between pixels. kernel: see kernels.py.
    """

    max_steps: tuple[int, ...] = (4, 5, 6, 8, 10, 10)
    stop_sigmas: float = 0.3
    stop_sigmas_coarse: float = 1.0
    min_pixels: int = 60
    min_overlap: float = 0.2
    min_inliers: float = 0.25
    score_ok: float = 0.6
    score_weak: float = 0.8
    cell_floor_px: float = 0.1
    cell_max_px: float = 1.0
    cell_linear_px: float = 4.0
    flow_passes: int = 4
    correlation: float = 4.0
    kernel: kernels.KernelName = "numba"


@dataclass(slots=True)
class _Linearised:
    """One evaluation of a level at a state (internal to the loop)."""

    dst: FloatArray
    J: NDArray[np.float32]
    residual: NDArray[np.float32]
    G: NDArray[np.float32]
    scale: float
    n_valid: int


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
    masks = mask_arguments(target)
    state = start
    gain, offset = 1.0, 0.0
    n_steps = 0
    for index in levels:
        gain, offset = _gain(source, target, state, masks, options)
        coarsest = index == levels[0] and len(levels) > 1 and index >= 2
        stop = options.stop_sigmas if index == levels[-1] else options.stop_sigmas_coarse
        result = _align_level(source, target, index, state, gain, offset, masks, not coarsest, stop, options)
        if result is None:
            return _failed(template.frame, dst, template.size_px, "no_texture", route, n_steps), start
        state, steps, fine = result
        n_steps += steps
        if not np.isfinite(fine.scale):
            return _failed(template.frame, dst, template.size_px, "diverged", route, n_steps), start
    finest = levels[-1]
    return _judge(
        source, target, finest, state, fine, gain, offset, masks, n_steps, dst, route, options
    ), state


def _gain(
    source: PreparedTemplate, target: Pyramid, state: Any, masks: tuple[Any, ...], options: RegisterOptions
) -> tuple[float, float]:
    kernel = kernels.load(options.kernel)
    template = source.template
    where, _, _ = source.family.warp(state, source.prepared_wide)
    index = min(template.wide_level, len(target.levels) - 1)
    seen = kernel.sample(target.levels[index], *target.scales[index], where, *masks)
    gain, offset = estimate_gain(template.wide_values, seen)
    return float(gain), float(offset)


def _evaluate(
    source: PreparedTemplate,
    target: Pyramid,
    index: int,
    state: Any,
    gain: float,
    offset: float,
    masks: tuple[Any, ...],
    kernel: Any,
) -> _Linearised:
    level = source.template.levels[index]
    assert level is not None  # the caller chose a built level
    where, J, A = source.family.warp(state, source.prepared[index])
    residual, G = kernel.linearise(
        target.levels[index],
        *target.scales[index],
        where,
        A,
        level.values,
        level.gradients,
        gain,
        offset,
        *masks,
    )
    valid = np.isfinite(residual)
    n_valid = int(valid.sum())
    scale = float("nan")
    if n_valid:
        scale = robust_scale(np.abs(residual[valid]))
    return _Linearised(dst=where, J=J, residual=residual, G=G, scale=scale, n_valid=n_valid)


# The scale comes from the 30 % quantile, not the median: players hold most of the strong gradients where the pitch
# shows none, and up to two thirds of the chosen pixels may move on their own.
SCALE_QUANTILE = 0.3
NORMAL_QUANTILE = 0.38532  # of |x|, x standard normal


def robust_scale(absolute: NDArray[np.float32]) -> float:
    """Standard deviation of the agreeing pixels from |residuals| (n,), grey levels; at least 0.5 (quantisation)."""
    k = int(SCALE_QUANTILE * len(absolute))
    return max(float(np.partition(absolute, k)[k]) / NORMAL_QUANTILE, 0.5)


def _align_level(
    source: PreparedTemplate,
    target: Pyramid,
    index: int,
    state: Any,
    gain: float,
    offset: float,
    masks: tuple[Any, ...],
    tukey: bool,
    stop_sigmas: float,
    options: RegisterOptions,
) -> tuple[Any, int, _Linearised] | None:
    """Steps on one level; None without texture. Accepts a step only if the robust scale does not grow."""
    level = source.template.levels[index]
    if level is None or len(level.src_px) < options.min_pixels:
        return None
    kernel = kernels.load(options.kernel)
    now = _evaluate(source, target, index, state, gain, offset, masks, kernel)
    steps = 0
    damping = 0.0
    for _ in range(options.max_steps[min(index, len(options.max_steps) - 1)]):
        if now.n_valid < options.min_pixels:
            now.scale = float("nan")
            return state, steps, now
        weight = kernel.robust_weights(now.residual, np.float32(now.scale), tukey)
        N, b, _ = kernel.accumulate(now.residual, now.G, now.J, weight)
        step = newton_step(N, b, damping)
        if step is None:
            now.scale = float("nan")
            return state, steps, now
        trial_state = source.family.update(state, step)
        trial = _evaluate(source, target, index, trial_state, gain, offset, masks, kernel)
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


def _judge(
    source: PreparedTemplate,
    target: Pyramid,
    index: int,
    state: Any,
    fine: _Linearised,
    gain: float,
    offset: float,
    masks: tuple[Any, ...],
    n_steps: int,
    dst: int,
    route: str,
    options: RegisterOptions,
) -> PairFit:
    template = source.template
    level = template.levels[index]
    assert level is not None
    n = len(level.src_px)
    overlap = fine.n_valid / max(n, 1)
    if fine.n_valid < options.min_pixels or overlap < options.min_overlap:
        return _failed(template.frame, dst, template.size_px, "low_overlap", route, n_steps)
    kernel = kernels.load(options.kernel)
    score = _score(target, index, fine, level.values, gain, offset, masks, kernel)
    weight = kernel.robust_weights(fine.residual, np.float32(fine.scale), True)
    # Inliers against a fixed bound too: a scale that has grown to swallow everything must not pass.
    inliers = float((weight > 0.1).sum()) / fine.n_valid
    reason = ""
    status = PairStatus.OK
    if not score < options.score_weak:
        return _failed(template.frame, dst, template.size_px, "score", route, n_steps, score=score)
    if inliers < options.min_inliers:
        return _failed(template.frame, dst, template.size_px, "few_inliers", route, n_steps, score=score)
    if score > options.score_ok:
        status, reason = PairStatus.WEAK, "score"
    _, _, A = source.family.warp(state, source.prepared[index])
    flow = _flow_grid(source, target, index, state, fine, A, gain, offset, masks, options, kernel)
    if len(flow.cell) < 6:
        return _failed(template.frame, dst, template.size_px, "no_texture", route, n_steps, score=score)
    H, info9 = fit_homography_to_flow(
        flow.src_px, flow.dst_px, flow.info, _warp_homography(level.src_px, fine.dst)
    )
    anchors = default_anchors(template.size_px)
    return PairFit(
        src=template.frame,
        dst=dst,
        H_dst_src=H,
        status=status,
        reason=reason,
        overlap=overlap,
        rms_grey=fine.scale,
        score=score,
        gain=gain,
        offset=offset,
        n_steps=n_steps,
        route=route,
        flow=flow,
        anchors_px=anchors,
        info=anchor_information(H, info9, anchors),
    )


def _warp_homography(src: FloatArray, dst: FloatArray) -> FloatArray:
    """The homography closest to the family's own warp, from some of its points: start of the fit to the flow."""
    good = np.flatnonzero(np.isfinite(dst).all(axis=1))
    some = good[:: max(1, len(good) // 64)]
    H, _ = cv2.findHomography(src[some], dst[some], 0)
    return np.eye(3) if H is None else np.asarray(H, np.float64)


_SHIFTS = np.array([[13.0, 5.0], [-13.0, -5.0], [7.0, -11.0], [-7.0, 11.0]])


def _score(
    target: Pyramid,
    index: int,
    fine: _Linearised,
    values: NDArray[np.float32],
    gain: float,
    offset: float,
    masks: tuple[Any, ...],
    kernel: Any,
) -> float:
    """Residual scale over the residual scale of the same pair shifted by a dozen pixels (the null)."""
    stride = max(1, len(values) // 1500)
    dst, t = fine.dst[::stride], values[::stride]
    shift_scale = max(1.0, target.size_px[0] / 1280.0)
    null = []
    for shift in _SHIFTS * shift_scale:
        seen = kernel.sample(target.levels[index], *target.scales[index], dst + shift, *masks)
        null.append(np.abs(t - gain * seen - offset))
    values_null = np.concatenate(null)
    values_null = values_null[np.isfinite(values_null)]
    if len(values_null) < 40:
        return float("nan")
    aligned = robust_scale(np.abs(fine.residual[np.isfinite(fine.residual)]))
    return aligned / robust_scale(values_null)


def _flow_grid(
    source: PreparedTemplate,
    target: Pyramid,
    index: int,
    state: Any,
    fine: _Linearised,
    A: FloatArray,
    gain: float,
    offset: float,
    masks: tuple[Any, ...],
    options: RegisterOptions,
    kernel: Any,
) -> FlowGrid:
    """Residual flow per cell with its anisotropic information (real-footage.md 6.3).

    Several local passes, each resampled at the flow found so far: robust weights at the family's own warp would
    down-weight just those pixels that disagree with it, and so pull the measurement towards the model (measured: half
    of a wrong lens' flow was lost, and the focal with it).
    """
    level = source.template.levels[index]
    assert level is not None
    shift = np.zeros((N_CELLS, 2))
    moved = fine.dst
    residual, G = fine.residual, fine.G
    scale = fine.scale
    for _ in range(options.flow_passes):
        weight = kernel.robust_weights(residual, np.float32(scale), True)
        sums, b, S, counts = kernel.accumulate_cells(
            residual, G, weight, level.src_px, moved, level.cell, N_CELLS
        )
        values, vectors = np.linalg.eigh(sums)
        values = np.maximum(values, 1e-12)
        std2 = options.correlation * scale**2 / values
        known = std2 < options.cell_max_px**2
        along = np.einsum("cji,cj->ci", vectors, b)
        step = np.einsum("cij,cj->ci", vectors, np.where(known, along / values, 0.0))
        shift = shift + np.clip(step, -1.5, 1.5)
        moved = fine.dst + shift[level.cell]
        residual, G = kernel.linearise(
            target.levels[index],
            *target.scales[index],
            moved,
            A,
            level.values,
            level.gradients,
            gain,
            offset,
            *masks,
        )
        finite = np.abs(residual[np.isfinite(residual)])
        if len(finite) < options.min_pixels:
            return FlowGrid.empty()
        scale = robust_scale(finite)
    info = np.where(known, 1.0 / (std2 + options.cell_floor_px**2), 0.0)
    keep = (S[:, 0] > 0) & (counts[:, 1] >= 6) & known.any(axis=1)
    # A shift beyond the linear range is no measurement, nor is one that still moves.
    keep &= (np.abs(shift).max(axis=1) <= options.cell_linear_px) & (np.abs(step).max(axis=1) < 0.25)
    if not keep.any():
        return FlowGrid.empty()
    src_px = S[keep, 1:3] / S[keep, 0:1]
    # The warp of the centroid, not the centroid of the warped pixels: over a cell of 240 px a pan of 8 degrees bends
    # the warp by .3 px, always to the same side (measured: 1.6 % of focal).
    where, _, _ = source.family.warp(state, source.family.prepare(src_px))
    return FlowGrid(
        src_px=src_px,
        dst_px=where + shift[keep],
        info=np.einsum("cij,cj,ckj->cik", vectors, info, vectors)[keep],
        weight=(counts[:, 1] / np.maximum(counts[:, 0], 1.0))[keep],
        cell=np.flatnonzero(keep),
    )


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
