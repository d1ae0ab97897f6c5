"""Where a refinement begins: from scratch by many starts, of which the best is followed, or from another solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from calib import linear
from calib.edges import find_bad_edges, linked_frames
from calib.problem import Loss, Packed, PriorTerms, State, linearise, robust_scale, whitened_squares
from calib.records import Priors, Solution, StartResult
from calib.refine_options import RefineOptions, free_columns
from calib.solver import Layout, NormalEquations, Result, minimise

Array = NDArray[np.float64]
# Frames: beyond it the starts are tried on some of the frames, the rest is chained on (dense solver).
SCOUT_ABOVE = 140
N_SCOUTS = 100


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


def from_scratch(
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


def warm(
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
