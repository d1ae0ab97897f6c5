"""Where a refinement begins: from scratch by many starts, of which the best is followed, or from another solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from calib import linear
from calib.camera import N_SHARED, N_WIDE
from calib.edges import find_bad_edges, linked_frames
from calib.problem import Loss, Packed, PriorTerms, State, linearise, robust_scale, whitened_squares
from calib.records import Priors, Solution, StartResult
from calib.refine_options import RefineOptions, free_columns
from calib.solver import Layout, NormalEquations, Result, minimise

Array = NDArray[np.float64]
# Frames: beyond it the starts are tried on some of the frames, the rest is chained on (dense solver).
SCOUT_ABOVE = 140
N_SCOUTS = 100


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beginning:
    """Where refine() goes on: packed edges, state (one start), accepted edges (E,), free shared columns, loss scale.

    scale (1,); starts: what a multistart found; valid_share: share of the edges with a valid linear focal, NaN without
    a multistart.
    """

    packed: Packed
    state: State
    ok: NDArray[np.bool_]
    free: NDArray[np.bool_]
    scale: Array
    starts: tuple[StartResult, ...] = ()
    valid_share: float = float("nan")


def about_mean(packed: Packed, state: State, mean_log_f: float) -> tuple[Packed, State]:
    """The same cameras with their principal point given at mean_log_f, where its prior holds (the wider lens only)."""
    if state.shared.shape[1] == N_SHARED:
        return packed, state
    shared = state.shared.copy()
    shared[:, :2] += shared[:, 6:8] * (mean_log_f - packed.log_f_pp)
    return replace(packed, log_f_pp=mean_log_f), State(state.log_f, state.R, shared)


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
        out = np.zeros((len(k1), N_WIDE if priors.wide else N_SHARED))
        if priors.wide:
            out[:, N_SHARED] = priors.k2_mean
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


def from_scratch(
    packed: Packed, reference: int, frames: NDArray[np.int64], prior_args: tuple, options: RefineOptions
) -> Beginning | None:
    """The best of many starts, followed to the end; None: nothing is possible."""
    priors, size_px = prior_args
    trusted = linear.consistent_edges(packed, frames)
    linked = linked_frames(packed, trusted, reference)
    # A frame that only doubtful edges reach keeps them: the fit decides.
    trusted |= ~(linked[packed.ia] & linked[packed.ib])
    tree = linear.spanning_tree(packed, reference, frames, trusted)
    names, states, share = multistart_states(packed, tree, reference, priors, options)
    zoom_range = float(np.median(np.ptp(states.log_f, axis=1)))
    free = free_columns(priors, options, zoom_range)
    coarse = packed.select(trusted).thin(options.thin)
    # 1. A coarse look: few points an edge, the scale that each start has itself; the usual lens (the wider one's other
    # unknowns stay at their prior means) finds the basin.
    usual = free & (np.arange(len(free)) < N_SHARED)
    terms = PriorTerms(priors, size_px, frames, usual, packed.log_f_pp)
    layout = Layout(coarse, reference, usual)
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
    packed, here = about_mean(packed, result.state.pick(alive), float(result.state.log_f[leader].mean()))
    fine, terms = packed.select(ok), PriorTerms(priors, size_px, frames, free, packed.log_f_pp)
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
    return Beginning(
        packed=packed, state=final.state.pick(np.array([best])), ok=ok, free=free, scale=np.array([scale[leader]]),
        starts=starts, valid_share=share,
    )  # fmt: skip


def warm(
    packed: Packed,
    reference: int,
    frames: NDArray[np.int64],
    start: Solution,
    prior_args: tuple,
    options: RefineOptions,
) -> Beginning:
    """A solution's cameras, frames missing in it chained on."""
    priors, _ = prior_args
    state = state_from_solution(packed, frames, start, reference, wide=priors.wide)
    packed, state = about_mean(packed, state, float(state.log_f.mean()))
    free = free_columns(priors, options, float(np.ptp(state.log_f)))
    if not free[4]:
        state.shared[:, 3] += (state.shared[:, 4] - priors.c1_mean) * float(
            state.log_f.mean() - packed.log_width
        )
        state.shared[:, 4] = priors.c1_mean
    if not options.distortion:
        state.shared[:, 3] = priors.c0_mean
    if priors.wide:  # what is held is held at its prior, whatever the solution had
        held = ~free & (np.arange(len(free)) >= N_SHARED)
        state.shared[:, held] = np.array([*np.zeros(N_SHARED), priors.k2_mean, 0.0, 0.0])[held]
    scale = robust_scale(whitened_squares(packed, state), packed.dof)
    return Beginning(packed=packed, state=state, ok=np.ones(packed.n_edges, bool), free=free, scale=scale)


def state_from_solution(
    packed: Packed, frames: NDArray[np.int64], start: Solution, reference: int, *, wide: bool | None = None
) -> State:
    """State (S = 1) of a packed graph's frames: known cameras taken over, the others chained from them.

    wide: whether with the wider lens' unknowns (None: as the solution's lens has them).
    """
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
            pp = lens.pp(np.mean(log_f[0, known]) + packed.log_width)
            H[:, used] = linear.ideal_homographies(packed.select(used), k1, pp, lens.aspect)
        linear.chain(tree, np.where(np.isfinite(H), H, np.eye(3)), log_f, R)
    lost = ~(np.isfinite(log_f[0]) & np.isfinite(R[0]).all((-1, -2)))
    log_f[0, lost], R[0, lost] = np.mean(log_f[0, known]), np.eye(3)
    if np.isfinite(R[0, reference]).all():
        R = R @ R[:, [reference]].swapaxes(-1, -2)
    return State(log_f + packed.log_width, R, lens.shared(packed.log_f_pp, wide=wide)[None])


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
