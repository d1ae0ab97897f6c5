"""Poses of the frames between keyframes, with the keyframes and the lens held: 4 unknowns a frame, O(n).

Edges may link a frame to a held keyframe or to another free frame. The linear system is block-sparse; error bars come
from a block-tridiagonal recursion over groups of frames as wide as the longest link.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from calib.covariance import edge_statistics
from calib.edges import common_variance, find_bad_edges, linked_to
from calib.problem import Loss, Packed, State, linearise, pack, robust_scale, whitened_squares
from calib.records import HomographyGraph, Solution
from calib.selected_inverse import inverse_diagonal_blocks
from calib.starts import state_from_solution

Array = NDArray[np.float64]
MAX_BAND = 12  # frames: links between free frames that reach further get their error bars from single solves


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """How solve_poses() works: huber in sigmas times the robust scale; bad_edge as in RefineOptions. error_bars: off
    leaves the sigmas of the solved frames NaN, for a third of the time less."""

    huber: float = 3.0
    bad_edge: float = 6.0
    max_steps: int = 30
    tolerance: float = 1e-6
    error_bars: bool = True


class _PoseSystem:
    """Normal equations of the free frames: block rows in frame order."""

    def __init__(self, packed: Packed, free: NDArray[np.bool_]) -> None:
        self.free = np.flatnonzero(free)
        position = np.full(packed.n_frames, -1)
        position[self.free] = np.arange(len(self.free))
        self.pa, self.pb = position[packed.ia], position[packed.ib]
        both = (self.pa >= 0) & (self.pb >= 0)
        self.both = np.flatnonzero(both)
        self.band = int(np.abs(self.pa[both] - self.pb[both]).max(initial=1))
        self.size = 4 * len(self.free)

    def assemble(self, blocks: Array, gradient: Array) -> tuple[Array, Array, Array]:
        """Diagonal blocks (n, 4, 4), gradients (n, 4) and coupling blocks (k, 4, 4) of the free pairs (rows of a)."""
        n = len(self.free)
        diagonal, right = np.zeros((n, 4, 4)), np.zeros((n, 4))
        for where, part in ((self.pa, slice(0, 4)), (self.pb, slice(4, 8))):
            use = where >= 0
            for i in range(4):
                right[:, i] += np.bincount(where[use], gradient[use, part.start + i], n)
                for j in range(4):
                    diagonal[:, i, j] += np.bincount(
                        where[use], blocks[use, part.start + i, part.start + j], n
                    )
        return diagonal, right, blocks[self.both, 0:4, 4:8]

    def matrix(self, diagonal: Array, coupling: Array) -> sp.csc_array:
        """The sparse matrix (4 n, 4 n)."""
        n = len(self.free)
        four = np.arange(4)

        def entries(rows: NDArray[np.int64], cols: NDArray[np.int64]) -> tuple[Array, Array]:
            r = np.broadcast_to(4 * rows[:, None, None] + four[:, None], (len(rows), 4, 4))
            c = np.broadcast_to(4 * cols[:, None, None] + four[None, :], (len(rows), 4, 4))
            return r.ravel(), c.ravel()

        index = np.arange(n, dtype=np.int64)
        a, b = self.pa[self.both], self.pb[self.both]
        parts = [(*entries(index, index), diagonal), (*entries(a, b), coupling)]
        parts.append((*entries(b, a), np.swapaxes(coupling, 1, 2)))
        rows, cols = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        values = np.concatenate([p[2].ravel() for p in parts])
        return sp.coo_array((values, (rows, cols)), shape=(self.size, self.size)).tocsc()


def _iterate(
    packed: Packed, system: _PoseSystem, state: State, loss: Loss, options: PoseOptions
) -> tuple[State, float, bool, int, sp.csc_array | None]:
    """Levenberg-Marquardt on the free frames: state, cost, converged, steps, undamped matrix at the end."""
    lin = linearise(packed, state, loss, pose_only=True)
    cost, damping, shared = float(lin.cost[0]), 1e-6, np.zeros_like(state.shared)
    if not np.isfinite(cost):
        return state, cost, False, 0, None
    step_count = 0
    matrix, converged = None, False
    for step_count in range(1, options.max_steps + 1):
        diagonal, right, coupling = system.assemble(lin.blocks[0], lin.gradient[0])
        matrix = system.matrix(diagonal, coupling)
        damped = (matrix + sp.diags_array(damping * matrix.diagonal() + 1e-12)).tocsc()
        try:
            step = spla.splu(damped, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
                right.ravel()
            )
        except RuntimeError:
            return state, cost, False, step_count, None
        step = step.reshape(-1, 4)
        # Frames are nearly independent: each is clamped by itself.
        largest = np.maximum(np.abs(step[:, 0]) / 0.3, np.abs(step[:, 1:]).max(1) / 0.2)
        step = step / np.maximum(largest, 1.0)[:, None]
        full = np.zeros((1, packed.n_frames, 4))
        full[0, system.free] = step
        trial = state.moved(full, shared)
        new = linearise(packed, trial, loss, pose_only=True)
        if float(new.cost[0]) <= cost:
            change = (cost - float(new.cost[0])) / max(cost, 1e-300)
            state, lin, cost = trial, new, float(new.cost[0])
            damping = max(damping * 0.1, 1e-12)
            if change < options.tolerance and largest.max() < 1:
                converged = True
                break
        else:
            if np.abs(np.sum(step * right)) < 1e-12 * max(cost, 1.0):
                converged = True
                break
            damping = max(damping, 1e-8) * 100
            if damping > 1e8:
                break
    diagonal, _, coupling = system.assemble(lin.blocks[0], lin.gradient[0])
    return state, cost, converged, step_count, system.matrix(diagonal, coupling)


def solve_poses(
    graph: HomographyGraph,
    held: Solution,
    *,
    options: PoseOptions | None = None,
    start: Solution | None = None,
) -> Solution:
    """Cameras of all frames of `graph`: those in `held` as they are there, the others solved against them.

    graph: frames and edges; edges may join free frames. held: keyframes, lens and their error bars. start: an earlier
    solution of these frames in the same world axes to begin from; without it, or for frames that it lacks, they are
    chained on from the held ones.
    Returns a Solution over graph.frames. sigma_log_f is the own error of the pose combined with the held frames' error
    (interpolated in frame number); sigma_log_zoom likewise. Frames without a path to a held frame are NaN rows.
    Raises ValueError when none of the graph's frames is held.
    """
    options = options or PoseOptions()
    rows = {frame: k for k, frame in enumerate(held.frames.tolist()) if np.isfinite(held.log_f[k])}
    is_held = np.array([frame in rows for frame in graph.frames.tolist()])
    if not is_held.any():
        raise ValueError("solve_poses() needs at least one frame of the graph in `held`")
    packed = pack(graph)
    useful = packed.dof.sum(1) >= 6
    packed = packed.select(useful)
    reference = int(np.flatnonzero(is_held)[0])
    state = _initial(packed, graph, held, reference, start)
    free = ~is_held
    reach = linked_to(packed, np.ones(packed.n_edges, bool), is_held)
    free &= reach
    ok = reach[packed.ia] & reach[packed.ib]
    n_steps, converged, cost, matrix = 0, True, 0.0, None
    system = _PoseSystem(packed.select(ok), free)
    loss = Loss("huber", np.ones(1), options.huber)
    for _ in range(5):
        fit = ok & (free[packed.ia] | free[packed.ib])
        if not fit.any():
            break
        chosen = packed.select(fit)
        scale = robust_scale(whitened_squares(chosen, state), chosen.dof)
        loss = Loss("huber", scale, options.huber)
        system = _PoseSystem(chosen, free)
        state, cost, converged, steps, matrix = _iterate(chosen, system, state, loss, options)
        n_steps += steps
        # Judged anew each time: an edge that a wrong one had pulled away comes back.
        now = ~find_bad_edges(whitened_squares(packed, state)[0], packed, options.bad_edge, ok)
        reach = linked_to(packed, now, is_held)
        now &= reach[packed.ia] & reach[packed.ib]
        if (now == ok).all():
            break
        ok, free = now, ~is_held & reach
    return _summarise(
        graph, held, packed, useful, state, is_held, free, ok, system, matrix if options.error_bars else None, loss,
        cost, converged, n_steps,
    )  # fmt: skip


def _initial(
    packed: Packed, graph: HomographyGraph, held: Solution, reference: int, start: Solution | None
) -> State:
    """State with the held cameras in their own gauge (reference of `held`), the others from `start` or chained."""
    first = int(graph.frames[reference])
    known = start is not None and first in start.frames and np.isfinite(start.log_f[start.index(first)])
    source = replace(start, lens=held.lens) if start is not None and known else held
    state = state_from_solution(packed, graph.frames, source, reference)
    # state_from_solution puts the reference row at I; go back to the held world axes.
    log_f, R = state.log_f, state.R @ source.R[source.index(first)]
    rows = {frame: k for k, frame in enumerate(held.frames.tolist()) if np.isfinite(held.log_f[k])}
    for k, frame in enumerate(graph.frames.tolist()):
        if frame in rows:
            log_f[0, k], R[0, k] = held.log_f[rows[frame]], held.R[rows[frame]]
    return State(log_f, R, state.shared)


def _summarise(
    graph: HomographyGraph, held: Solution, packed: Packed, useful: NDArray[np.bool_], state: State,
    is_held: NDArray[np.bool_], free: NDArray[np.bool_], ok: NDArray[np.bool_], system: _PoseSystem,
    matrix: sp.csc_array | None, loss: Loss, cost: float, converged: bool, n_steps: int,
) -> Solution:  # fmt: skip
    n = len(graph.frames)
    chi2, kappa, _, rms_edge = edge_statistics(packed, state, loss)
    own = np.full((n, 4, 4), np.nan)
    own[is_held] = 0.0
    fit = ok & (free[packed.ia] | free[packed.ib])
    dof = max(float(packed.dof[fit].sum()) - 4 * int(free.sum()), 1.0)
    with np.errstate(all="ignore"):
        chi2_dof = float(np.nansum((chi2 * packed.dof.sum(1))[fit]) / dof) if fit.any() else float("nan")
    # An edge's errors are common to its cells: kappa, where the data show it; at least chi2.
    inflate = common_variance(kappa[fit], chi2_dof)
    if matrix is not None and len(system.free):
        try:
            if system.band <= MAX_BAND:
                blocks = inverse_diagonal_blocks(matrix, system.band)
            else:
                lu = spla.splu(matrix.tocsc())
                blocks = np.stack(
                    [
                        lu.solve(np.eye(system.size, 4, -4 * k))[4 * k : 4 * k + 4]
                        for k in range(system.size // 4)
                    ]
                )
            own[system.free] = blocks * inflate
        except (np.linalg.LinAlgError, RuntimeError):
            converged = False
    rows = np.array([held.index(f) if h else -1 for f, h in zip(graph.frames.tolist(), is_held, strict=True)])
    fine = np.isfinite(held.log_f)
    order = np.argsort(held.frames[fine])

    def common(values: Array) -> Array:
        return np.interp(graph.frames, held.frames[fine][order], values[fine][order])

    sigma_log_f = np.sqrt(common(held.sigma_log_f) ** 2 + own[:, 0, 0])
    sigma_zoom = np.sqrt(common(held.sigma_log_zoom) ** 2 + own[:, 0, 0])
    cov_rot = own[:, 1:, 1:].copy()
    cov_rot[is_held] = held.cov_rot[rows[is_held]]
    log_f, R = state.log_f[0].copy(), state.R[0].copy()
    lost = ~is_held & ~free
    for values in (log_f, R, sigma_log_f, sigma_zoom, cov_rot):
        values[lost] = np.nan
    rms = np.full(n, np.nan)
    total, count = np.zeros(n), np.zeros(n)
    good = ok & np.isfinite(rms_edge)
    for index in (packed.ia[good], packed.ib[good]):
        total += np.bincount(index, rms_edge[good] ** 2, n)
        count += np.bincount(index, minlength=n)
    rms[count > 0] = np.sqrt(total[count > 0] / count[count > 0])

    def per_edge(values: Array) -> Array:
        out = np.full(len(graph.edges), np.nan)
        out[useful] = values
        return out

    edge_ok = np.zeros(len(graph.edges), bool)
    edge_ok[useful] = ok
    return replace(
        held, frames=graph.frames, log_f=log_f, R=R, sigma_log_f=sigma_log_f, sigma_log_zoom=sigma_zoom,
        cov_rot=cov_rot, edge_chi2=per_edge(chi2), edge_kappa=per_edge(kappa), edge_ok=edge_ok, rms_px=rms,
        chi2_dof=chi2_dof, converged=converged, stop="converged" if converged else "max_steps",
        n_steps=n_steps, cost=cost, starts=(),
    )  # fmt: skip
