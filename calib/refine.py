"""Maximum likelihood over a graph: log f and R of every frame, principal point and distortion of the shot.

refine() finds the optimum from scratch (multistart) or from a given solution, drops edges that contradict the rest,
and returns error bars that count an edge, not a cell, as the independent unit. Never raises on singular systems.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from calib import linear
from calib.covariance import summarise
from calib.problem import (
    Loss,
    Packed,
    PriorTerms,
    State,
    linearise,
    pack,
    robust_scale,
    whitened_squares,
)
from calib.records import HomographyGraph, Lens, Priors, Solution, StartResult
from calib.solver import Layout, NormalEquations, Result, minimise

Array = NDArray[np.float64]
# The loss scale is the fixed point of fit and median residual, so that it does not depend on where a fit began.
MAX_LOOKS = 10
WORST_FIRST = 0.4
SCOUT_ABOVE = (
    140  # frames: beyond it the starts are tried on some of the frames, the rest is chained on (dense solver)
)
N_SCOUTS = 100
THIN_ABOVE = 200_000  # points
WARM_DAMPING = 1e-7  # beside an optimum: full steps, and damping only where one fails


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineOptions:
    """How refine() works.

    reference: frame with R = I (None: the first of the graph). distortion: False fixes k1 at the priors' mean (for
    comparison only: without it f is 40 % short on real pictures). free_pp: False holds the principal point at its
    prior. zoom_for_c1: log zoom range below which c1 stays at its prior mean. robust: 'huber' or 'tukey' (Tukey after
    Huber has converged). huber: threshold in sigmas times the robust scale. bad_edge: an edge whose median residual
    exceeds this many times the graph's is dropped. tolerance, max_steps: the keyframe graph's valley is flat, an early
    stop looks like many optima. hopeless_sigma: formal sigma of the leading start from which on only the three best
    starts are followed (nothing is observable, and the valley has no end).
    k1_trials, focal_trials_w, focal_k1: the starts. thin: points an edge in the first, coarse look at a start.
    """

    reference: int | None = None
    distortion: bool = True
    free_pp: bool = True
    zoom_for_c1: float = 0.05
    robust: str = "huber"
    huber: float = 3.0
    bad_edge: float = 5.0
    tolerance: float = 1e-10
    max_steps: int = 400
    k1_trials: tuple[float, ...] = tuple(np.round(np.arange(-0.06, 0.0601, 0.01), 3).tolist())
    focal_trials_w: tuple[float, ...] = (0.6, 0.9, 1.35, 2.0, 3.0, 4.5)
    focal_k1: tuple[float, ...] = (-0.03, 0.0, 0.03)
    thin: int = 10
    hopeless_sigma: float = 0.15


def free_columns(priors: Priors, options: RefineOptions, zoom_range: float) -> NDArray[np.bool_]:
    """Which of pp_x, pp_y, log aspect, c0, c1 move."""
    k1 = options.distortion
    return np.array(
        [
            options.free_pp,
            options.free_pp,
            priors.aspect_std > 0,
            k1,
            k1 and zoom_range >= options.zoom_for_c1,
        ]
    )


def linked_frames(packed: Packed, ok: NDArray[np.bool_], reference: int) -> NDArray[np.bool_]:
    """Frames (n,) that accepted edges join to the reference row."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    return np.asarray(label == label[reference])


def largest_component(packed: Packed, ok: NDArray[np.bool_]) -> tuple[int, int]:
    """Number of frames and first row of the largest set of frames that accepted edges join."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    best = int(np.argmax(np.bincount(label)))
    return int(np.sum(label == best)), int(np.flatnonzero(label == best)[0])


def linked_to(packed: Packed, ok: NDArray[np.bool_], roots: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Frames (n,) that accepted edges join to any of the root frames (n,) bool."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    return np.isin(label, np.unique(label[roots]))


def find_bad_edges(
    e2: Array, packed: Packed, limit: float, fitted: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Edges (E,) whose median whitened residual is beyond `limit` times the graph's median (at least the stated noise).

    The median of an edge ignores players and boards that move; a wrong registration moves all of its points.
    fitted: the edges that made this fit; of those only the worst go (WORST_FIRST of the largest), because a wrong
    edge drags its neighbours along.
    """
    e = np.sqrt(np.where(packed.dof > 0, np.minimum(e2, 1e12), np.nan))
    known = packed.dof.sum(1) > 0
    median = np.full(packed.n_edges, np.inf)
    median[known] = np.nanmedian(e[known], axis=1)
    used = known if fitted is None else known & fitted
    typical = max(float(np.median(median[used])) if used.any() else 1.0, 1.0)
    bad = median > limit * typical
    if fitted is not None and (bad & used).any():
        bad &= ~used | (median > WORST_FIRST * median[bad & used].max())
    return bad


def multistart_states(
    packed: Packed, tree: list[linear.TreeEdge], root: int, priors: Priors, options: RefineOptions
) -> tuple[list[str], State, float]:
    """Names, states and the valid share of the linear equations of all starts."""
    pp, W = priors.pp_mean_px(packed.size_px), packed.size_px[0]
    trials = np.array(options.k1_trials if options.distortion else (0.0,))
    trials = trials + (priors.c0_mean if options.distortion else 0.0)
    H = linear.ideal_homographies(packed, trials, pp, priors.aspect)
    log_root, share = linear.root_focals(packed, tree, root, H)
    good = np.flatnonzero(np.isfinite(log_root) & (np.abs(log_root) < np.log(40)))

    def shared(k1: Array) -> Array:
        out = np.zeros((len(k1), 5))
        out[:, :2], out[:, 2], out[:, 3], out[:, 4] = pp, np.log(priors.aspect), k1, priors.c1_mean
        if not options.distortion:
            out[:, 3] = priors.c0_mean
        return out

    names = [f"k1={trials[g]:+.3f}" for g in good]
    states = [linear.states_from_roots(packed, tree, root, H[good], log_root[good], shared(trials[good]))]
    focal = np.repeat(options.focal_trials_w, len(options.focal_k1))
    k1 = np.tile(options.focal_k1, len(options.focal_trials_w))
    if not options.distortion:
        focal, k1 = np.array(options.focal_trials_w), np.zeros(len(options.focal_trials_w))
    nearest = np.argmin(np.abs(trials[None, :] - k1[:, None]), axis=1)
    grid = linear.states_from_roots(packed, tree, root, H[nearest], np.log(focal), shared(k1))
    # The grid is over the mean focal, not over that of whichever frame happens to be the root.
    shift = np.log(focal) - (grid.log_f.mean(1) - np.log(W))
    grid = linear.states_from_roots(packed, tree, root, H[nearest], np.log(focal) + shift, shared(k1))
    names += [f"f={f:.2f}W k1={k:+.2f}" for f, k in zip(focal, k1, strict=True)]
    states.append(grid)
    for known in priors.known_focals:
        names.append("known focal")
        states.append(grid.pick(np.array([int(np.argmin(np.abs(focal * W - known.f_px)))])))
    joined = State(*(np.concatenate([getattr(s, f) for s in states]) for f in ("log_f", "R", "shared")))
    return names, joined, float(share[good].max()) if len(good) else 0.0


def formal_sigma(layout: Layout, terms: PriorTerms, result: Result) -> float:
    """Formal standard deviation of mean log f at a result's first start; inf when singular."""
    u = np.zeros(layout.size)
    u[0 : 4 * layout.n : 4] = 1 / layout.n
    equations = NormalEquations(layout, terms, result.state, result.lin)
    try:
        return float(np.sqrt(max(float(u @ equations.solve_for(u)), 0.0)))
    except np.linalg.LinAlgError:
        return float("inf")


def _distinct(cost: Array, mean_log_f: Array, c0: Array) -> NDArray[np.int64]:
    """Starts to follow to the end: every finite one that is not already at the same point as a better one."""
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable").tolist():
        if not np.isfinite(cost[k]):
            break
        same = [
            j for j in kept
            if abs(mean_log_f[j] - mean_log_f[k]) < 2e-3 and abs(c0[j] - c0[k]) < 1e-3
            and cost[k] - cost[j] < 1e-3 * cost[j]
        ]  # fmt: skip
        if not same:
            kept.append(k)
    return np.array(kept, int)


def _from_scratch(
    packed: Packed, reference: int, frames: NDArray[np.int64], prior_args: tuple, options: RefineOptions
) -> tuple[State, NDArray[np.bool_], NDArray[np.bool_], tuple[StartResult, ...], float, Array] | None:
    """Best state (S = 1), accepted edges, free columns, starts, valid share, loss scale; None: nothing is possible."""
    priors, size_px = prior_args
    trusted = linear.consistent_edges(packed, frames)
    linked = linked_frames(packed, trusted, reference)
    # A frame that only doubtful edges reach keeps them: the fit decides.
    trusted |= ~(linked[packed.ia] & linked[packed.ib])
    tree = linear.spanning_tree(packed, reference, frames, trusted)
    names, states, share = multistart_states(packed, tree, reference, priors, options)
    zoom_range = float(np.median(np.ptp(states.log_f, axis=1)))
    free = free_columns(priors, options, zoom_range)
    terms = PriorTerms(priors, size_px, frames, free)
    coarse = packed.select(trusted).thin(options.thin)
    layout = Layout(coarse, reference, free)

    # 1. A coarse look: few points an edge, the scale that each start has itself.
    scale = robust_scale(whitened_squares(coarse, states), coarse.dof)
    result = minimise(
        coarse, layout, terms, states, Loss("huber", scale, options.huber), max_steps=8, tolerance=1e-3
    )
    e2 = whitened_squares(coarse, result.state)
    scale = robust_scale(e2, coarse.dof)
    result = minimise(
        coarse,
        layout,
        terms,
        result.state,
        Loss("huber", scale, options.huber),
        max_steps=100,
        tolerance=1e-8,
    )
    # One scale for all, that of the best: only then are their costs comparable.
    scale = robust_scale(result.lin.e2, coarse.dof)
    alive = np.flatnonzero(np.isfinite(result.cost))
    if not len(alive):
        return None
    leader = alive[np.argmin(scale[alive])]
    e2_leader = whitened_squares(packed, result.state.pick(np.array([leader])))[0]
    ok = ~find_bad_edges(e2_leader, packed, options.bad_edge, trusted)
    ok = ok if ok.any() and linked_frames(packed, ok, reference).all() else trusted
    common = Loss("huber", np.full(len(alive), scale[leader]), options.huber)
    here = result.state.pick(alive)
    fine = packed.select(ok)
    layout = Layout(fine, reference, free)
    cost = linearise(fine, here, common).cost + terms.cost(here)
    kept = _distinct(cost, here.log_f.mean(1), here.shared[:, 3])
    if not len(kept):
        return None  # every start is an impossible camera for the full set of points
    if len(kept) > 3:
        leading = minimise(
            fine,
            layout,
            terms,
            here.pick(kept[:1]),
            common.pick(kept[:1]),
            max_steps=30,
            tolerance=options.tolerance,
        )
        if formal_sigma(layout, terms, leading) > options.hopeless_sigma:
            kept = kept[:3]
    # 2. Every distinct survivor on all points, to the end, before any two are compared.
    final = minimise(
        fine,
        layout,
        terms,
        here.pick(kept),
        common.pick(kept),
        max_steps=options.max_steps,
        tolerance=options.tolerance,
    )
    best = int(np.argmin(final.cost))
    W = size_px[0]
    starts = tuple(
        StartResult(
            name=names[alive[k]], mean_log_f_over_w=float(final.state.log_f[j].mean() - np.log(W)),
            c0=float(final.state.shared[j, 3]), cost=float(final.cost[j]), converged=bool(final.converged[j]),
        )
        for j, k in enumerate(kept)
    )  # fmt: skip
    return final.state.pick(np.array([best])), ok, free, starts, share, np.array([scale[leader]])


def _warm(
    packed: Packed,
    reference: int,
    frames: NDArray[np.int64],
    start: Solution,
    prior_args: tuple,
    options: RefineOptions,
) -> tuple[State, NDArray[np.bool_], Array]:
    """State (S = 1) from a solution, frames missing in it chained on; free columns; loss scale."""
    priors, _ = prior_args
    state = state_from_solution(packed, frames, start, reference)
    free = free_columns(priors, options, float(np.ptp(state.log_f)))
    if not free[4]:
        state.shared[:, 3] += (state.shared[:, 4] - priors.c1_mean) * float(
            state.log_f.mean() - packed.log_width
        )
        state.shared[:, 4] = priors.c1_mean
    if not options.distortion:
        state.shared[:, 3] = priors.c0_mean
    scale = robust_scale(whitened_squares(packed, state), packed.dof)
    return state, free, scale


def state_from_solution(packed: Packed, frames: NDArray[np.int64], start: Solution, reference: int) -> State:
    """State (S = 1) of a packed graph's frames: known cameras taken over, the others chained from them."""
    n = packed.n_frames
    log_f, R = np.full((1, n), np.nan), np.full((1, n, 3, 3), np.nan)
    rows = {frame: k for k, frame in enumerate(start.frames.tolist())}
    for k, frame in enumerate(frames.tolist()):
        if frame in rows:
            log_f[0, k], R[0, k] = start.log_f[rows[frame]] - packed.log_width, start.R[rows[frame]]
    known = np.flatnonzero(np.isfinite(log_f[0]) & np.isfinite(R[0]).all((-1, -2)))
    lens = start.lens
    if not len(known):
        known = np.array([reference])
        log_f[0, reference], R[0, reference] = np.log(1.3), np.eye(3)
    if len(known) < n:
        k1 = np.array([float(lens.k1_half(np.mean(log_f[0, known]) + packed.log_width))])
        tree = linear.spanning_tree(packed, known, frames, few_steps=True)
        used = np.array(sorted({step.edge for step in tree}), int)
        H = np.full((1, packed.n_edges, 3, 3), np.nan)
        if len(used):
            H[:, used] = linear.ideal_homographies(packed.select(used), k1, lens.pp_px, lens.aspect)
        linear.chain(tree, np.where(np.isfinite(H), H, np.eye(3)), log_f, R)
    lost = ~(np.isfinite(log_f[0]) & np.isfinite(R[0]).all((-1, -2)))
    log_f[0, lost], R[0, lost] = np.mean(log_f[0, known]), np.eye(3)
    if np.isfinite(R[0, reference]).all():
        R = R @ R[:, [reference]].swapaxes(-1, -2)
    shared = np.array([[*lens.pp_px, np.log(lens.aspect), lens.c0, lens.c1]])
    return State(log_f + packed.log_width, R, shared)


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
    in_reach = linked_frames(everything, everything.dof.sum(1) >= 8, row)
    if in_reach.sum() < 2:
        return nothing(graph, priors, reference_frame, "no_edges")
    inside = in_reach[everything.ia] & in_reach[everything.ib] & (everything.dof.sum(1) >= 8)
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
    starts: tuple[StartResult, ...] = ()
    share = float("nan")
    if start is None:
        found = _from_scratch(packed, row, frames, prior_args, options)
        if found is None:
            return nothing(graph, priors, reference_frame, "no_possible_start")
        state, ok, free, starts, share, scale = found
    else:
        state, free, scale = _warm(packed, row, frames, start, prior_args, options)
        ok = np.ones(packed.n_edges, bool)
    terms = PriorTerms(priors, graph.size_px, frames, free)
    result, ok, loss = polish(packed, row, terms, state, ok, scale, free, options)
    linked = linked_frames(packed, ok, row)
    if 2 * linked.sum() < packed.n_frames:
        other = largest_component(packed, ok)
        if other[0] > linked.sum():
            moved = replace(options, reference=int(frames[other[1]]))
            return refine(graph, start=start, priors=priors, options=moved)
    solution = summarise(packed, frames, row, terms, result, ok, loss, linked, priors, starts, share)
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


def find_bridge(e2: Array, packed: Packed, ok: NDArray[np.bool_], tried: NDArray[np.bool_], row: int) -> int:
    """The least bad rejected edge between the linked frames and others, -1 for none or when all were tried.

    Where three frames hang on one triangle, a wrong edge makes all three edges look wrong; each gets one chance.
    """
    linked = linked_frames(packed, ok, row)
    crossing = np.flatnonzero((linked[packed.ia] != linked[packed.ib]) & ~tried & ~ok)
    if not len(crossing):
        return -1
    # The shortest first: what was tracked over fewer frames is more likely right.
    span = np.abs(packed.ia[crossing] - packed.ib[crossing])
    median = np.median(np.where(packed.dof[crossing] > 0, e2[crossing], np.inf), axis=1)
    return int(crossing[np.lexsort((median, span))[0]])


def linked_pairs(packed: Packed, ok: NDArray[np.bool_], row: int) -> NDArray[np.bool_]:
    """Edges (E,) both of whose frames accepted edges join to the reference."""
    linked = linked_frames(packed, ok, row)
    return linked[packed.ia] & linked[packed.ib]


def scouts(packed: Packed, row: int) -> NDArray[np.int64]:
    """Rows of N_SCOUTS frames, the reference row among them, that edges join to each other: those with most edges.

    In a graph of all frames these are the keyframes. Where they do not hang together, those nearest to the reference.
    """
    n = packed.n_frames
    degree = np.bincount(np.concatenate([packed.ia, packed.ib]), minlength=n).astype(float)
    degree[row] = np.inf
    inside = np.zeros(n, bool)
    inside[np.argsort(-degree, kind="stable")[:N_SCOUTS]] = True
    joined = linked_frames(packed, inside[packed.ia] & inside[packed.ib], row)
    if (joined & inside).sum() < N_SCOUTS // 2:
        link = coo_array((np.ones(packed.n_edges), (packed.ia, packed.ib)), shape=(n, n)).tocsr()
        order, _ = breadth_first_order(link, row, directed=False)
        return np.sort(order[:N_SCOUTS]).astype(np.int64)
    return np.flatnonzero(joined & inside)


def nothing(graph: HomographyGraph, priors: Priors, reference: int, stop: str) -> Solution:
    """The Solution that says nothing: NaN cameras and the reason in `stop`."""
    n, E = len(graph.frames), len(graph.edges)
    nan = np.full(n, np.nan)
    lens = Lens(
        size_px=graph.size_px, pp_px=priors.pp_mean_px(graph.size_px), aspect=priors.aspect, c0=priors.c0_mean
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
