"""Maximum likelihood over a graph: log f and R of every frame, principal point and distortion of the shot.

refine() finds the optimum from scratch (multistart) or from a given solution, drops edges that contradict the rest,
and returns error bars that count an edge, not a cell, as the independent unit. Never raises on singular systems.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.covariance import summarise
from calib.edges import find_bad_edges, find_bridge, largest_component, linked_frames, linked_pairs
from calib.problem import Loss, Packed, PriorTerms, State, pack, robust_scale, whitened_squares
from calib.records import HomographyGraph, Lens, Priors, Solution
from calib.refine_options import RefineOptions
from calib.solver import Layout, Result, minimise
from calib.starts import SCOUT_ABOVE, from_scratch, scouts, warm

__all__ = ["RefineOptions", "nothing", "polish", "refine"]

Array = NDArray[np.float64]
# The loss scale is the fixed point of fit and median residual, so that it does not depend on where a fit began.
MAX_LOOKS = 10
THIN_ABOVE = 200_000  # points
# Known directions of an edge: a frame's focal and rotation are four, and one more shows when they are wrong.
LEAST_DIRECTIONS = 5
WARM_DAMPING = 1e-7  # beside an optimum: full steps, and damping only where one fails


def refine(
    graph: HomographyGraph,
    *,
    start: Solution | None = None,
    priors: Priors | None = None,
    options: RefineOptions | None = None,
) -> Solution:
    """Maximum-likelihood cameras of a graph of homographies; multistart when `start` is None.

    graph: keyframes and their edges (raw px). start: an earlier solution; frames missing in it are chained on.
    Returns a Solution; frames that no accepted edge links to the reference are NaN rows; on data that cannot be solved
    converged is False and sigmas are NaN. A reference whose edges all prove wrong gives way to a frame of the largest
    linked set (Solution.reference says which). Raises ValueError for a reference that is not in the graph, or no frame.
    Source: calibration.md 6 and 7.3; real-footage.md 2 for the stopping rule.
    """
    priors, options = priors or Priors(), options or RefineOptions()
    frames = graph.frames
    if not len(frames):
        raise ValueError("a graph without frames")
    reference_frame = int(frames[0]) if options.reference is None else options.reference
    if reference_frame not in set(frames.tolist()):
        raise ValueError(f"reference frame {reference_frame} is not in the graph")
    everything = pack(graph)
    row = int(np.flatnonzero(frames == reference_frame)[0])
    in_reach = linked_frames(everything, everything.dof.sum(1) >= LEAST_DIRECTIONS, row)
    if in_reach.sum() < 2:
        return nothing(graph, priors, reference_frame, "no_edges")
    inside = in_reach[everything.ia] & in_reach[everything.ib] & (everything.dof.sum(1) >= LEAST_DIRECTIONS)
    if not in_reach.all():
        part = HomographyGraph(
            frames=frames[in_reach],
            edges=tuple(e for e, k in zip(graph.edges, inside, strict=True) if k),
            size_px=graph.size_px,
        )
        return _spread(refine(part, start=start, priors=priors, options=options), graph, inside)
    packed = everything.select(inside)
    if start is None and packed.n_frames > SCOUT_ABOVE:
        chosen = frames[scouts(packed, row)]
        first = refine(
            graph.subgraph(chosen), priors=priors, options=replace(options, reference=reference_frame)
        )
        if np.isfinite(first.log_f).sum() >= 2:
            whole = refine(graph, start=first, priors=priors, options=options)
            return replace(whole, starts=first.starts, linear_valid=first.linear_valid)
    prior_args = (priors, graph.size_px)
    if start is None:
        begun = from_scratch(packed, row, frames, prior_args, options)
        if begun is None:
            return nothing(graph, priors, reference_frame, "no_possible_start")
    else:
        begun = warm(packed, row, frames, start, prior_args, options)
    packed, free = begun.packed, begun.free
    terms = PriorTerms(priors, graph.size_px, frames, free, packed.log_f_pp)
    result, ok, loss = polish(packed, row, terms, begun.state, begun.ok, begun.scale, free, options)
    linked = linked_frames(packed, ok, row)
    if 2 * linked.sum() < packed.n_frames:
        other = largest_component(packed, ok)
        if other[0] > linked.sum():
            moved = replace(options, reference=int(frames[other[1]]))
            return refine(graph, start=start, priors=priors, options=moved)
    solution = summarise(
        packed, frames, row, terms, result, ok, loss, linked, priors, begun.starts, begun.valid_share
    )
    return solution if inside.all() else _spread(solution, graph, inside)


def polish(
    packed: Packed, row: int, terms: PriorTerms, state: State, ok: NDArray[np.bool_], scale: Array,
    free: NDArray[np.bool_], options: RefineOptions,
) -> tuple[Result, NDArray[np.bool_], Loss]:  # fmt: skip
    """Re-estimate scale and bad edges around one state until both stay, then iterate to the end."""
    n_steps, tried = 0, np.zeros(packed.n_edges, bool)
    # Thousands of frames: a quarter of the points brings them as near as the last steps on all points need.
    large = packed.n_edges * packed.dof.shape[1] > THIN_ABOVE

    def chosen_by(ok: NDArray[np.bool_]) -> tuple[Packed, Layout, NDArray[np.bool_]]:
        some = packed.select(ok)
        return some.thin(options.thin) if large else some, Layout(some, row, free), ok

    chosen, layout, of = chosen_by(ok)
    for look in range(MAX_LOOKS):
        loss = Loss("huber", scale, options.huber)
        if (of != ok).any():
            chosen, layout, of = chosen_by(ok)
        rough = minimise(
            chosen, layout, terms, state, loss, max_steps=options.max_steps, tolerance=1e-6,
            damping0=1e-4 if look == 0 else WARM_DAMPING,
        )  # fmt: skip
        n_steps += int(rough.n_steps[0])
        state = rough.state
        e2 = whitened_squares(packed, state)
        now = ~find_bad_edges(e2[0], packed, options.bad_edge, ok)
        bridge = find_bridge(e2[0], packed, now, tried, row)
        if bridge >= 0:
            now[bridge] = tried[bridge] = True
        else:
            now &= linked_pairs(packed, now, row)
        now = now if now.any() else ok
        new_scale = robust_scale(e2[:, now], packed.dof[now])
        settled = bool((now == ok).all()) and abs(float(new_scale[0] / scale[0]) - 1) < 1e-4
        ok = now
        if settled or look == MAX_LOOKS - 1:
            break
        scale = new_scale
    loss = Loss(options.robust, scale, options.huber)
    chosen = packed.select(ok)
    layout = layout if (of == ok).all() else Layout(chosen, row, free)
    result = minimise(
        chosen, layout, terms, state, loss, max_steps=options.max_steps, tolerance=options.tolerance,
        damping0=WARM_DAMPING,
    )  # fmt: skip
    result.n_steps[0] += n_steps
    return result, ok, loss


def nothing(graph: HomographyGraph, priors: Priors, reference: int, stop: str) -> Solution:
    """The Solution that says nothing: NaN cameras and the reason in `stop`."""
    n, E = len(graph.frames), len(graph.edges)
    nan = np.full(n, np.nan)
    lens = Lens(
        size_px=graph.size_px,
        pp_px=priors.pp_mean_px(graph.size_px),
        aspect=priors.aspect,
        c0=priors.c0_mean,
        k2=priors.k2_mean,
    )
    return Solution(
        frames=graph.frames, log_f=nan, R=np.full((n, 3, 3), np.nan), lens=lens, reference=reference,
        sigma_log_f=nan, sigma_log_zoom=nan, cov_rot=np.full((n, 3, 3), np.nan), sigma_mean_log_f=np.nan,
        sigma_mean_formal=np.nan, lens_std={}, chi2_dof=np.nan, s10_px=0.0, edge_chi2=np.full(E, np.nan),
        edge_kappa=np.full(E, np.nan), edge_ok=np.zeros(E, bool), rms_px=nan, converged=False, stop=stop,
        n_steps=0, cost=np.nan, priors=priors,
    )  # fmt: skip


def _spread(part: Solution, graph: HomographyGraph, inside: NDArray[np.bool_]) -> Solution:
    """A solution of some frames and edges, in the rows of the whole graph."""
    rows = {frame: k for k, frame in enumerate(part.frames.tolist())}
    n = len(graph.frames)
    index = np.array([rows.get(frame, -1) for frame in graph.frames.tolist()])

    def per_frame(values: Array) -> Array:
        out = np.full((n, *values.shape[1:]), np.nan)
        out[index >= 0] = values[index[index >= 0]]
        return out

    def per_edge(values: NDArray[Any], empty: float) -> NDArray[Any]:
        out = np.full(len(graph.edges), empty, dtype=values.dtype)
        out[inside] = values
        return out

    return replace(
        part, frames=graph.frames, log_f=per_frame(part.log_f), R=per_frame(part.R),
        sigma_log_f=per_frame(part.sigma_log_f), sigma_log_zoom=per_frame(part.sigma_log_zoom),
        cov_rot=per_frame(part.cov_rot), rms_px=per_frame(part.rms_px), edge_chi2=per_edge(part.edge_chi2, np.nan),
        edge_kappa=per_edge(part.edge_kappa, np.nan), edge_ok=per_edge(part.edge_ok, False),
    )  # fmt: skip
