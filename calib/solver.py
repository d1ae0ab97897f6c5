"""Levenberg-Marquardt over a batch of starts: assemble, damp, step, accept or reject, stop.

Unknowns: 4 per frame (log f, left rotation increment) and the free ones of the shared 5 (8: the wider lens). Below
DENSE_BELOW pose unknowns the normal matrix is dense (one Cholesky per start); above, block-sparse frames with a
bordered Schur complement.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from calib.lines import LineTerm
from calib.problem import Linearised, Loss, Packed, PriorTerms, State, linearise
from calib.selected_inverse import DenseCovariance, SelectedCovariance

Array = NDArray[np.float64]
DENSE_BELOW = 600  # pose unknowns, four a frame
MAX_LOG_F_STEP = 0.5  # of one step
MAX_ROTATION_STEP = 0.3  # rad, of one step


class Layout:
    """Which unknown is where: 4 n pose entries, then s = 5 or 8 shared; `active` (4 n + s,) False = held (gauge, lens).

    free_shared (s,): which of the shared ones move.
    """

    def __init__(
        self,
        packed: Packed,
        reference: int,
        free_shared: NDArray[np.bool_],
        held: NDArray[np.bool_] | None = None,
    ) -> None:
        n = packed.n_frames
        self.n, self.n_shared = n, len(free_shared)
        self.size = 4 * n + self.n_shared
        self.active = np.ones(self.size, bool)
        self.active[4 * reference + 1 : 4 * reference + 4] = False
        self.active[4 * n :] = np.asarray(free_shared, bool)
        if held is not None:
            self.active[: 4 * n] &= ~np.repeat(held, 4)
        a = 4 * packed.ia[:, None] + np.arange(4)
        b = 4 * packed.ib[:, None] + np.arange(4)
        shared = np.broadcast_to(4 * n + np.arange(self.n_shared), (packed.n_edges, self.n_shared))
        self.columns = np.concatenate([a, b, shared], 1)  # (E, 8 + s)
        self.dense = 4 * n < DENSE_BELOW
        self._gather: sp.csr_array | None = None
        self._pattern: tuple[Any, ...] | None = None

    def vector(self, per_edge: Array) -> Array:
        """Sum of per-edge vectors (S, E, 8 + s) into (S, 4 n + s)."""
        flat = self.columns.ravel()
        return np.stack([np.bincount(flat, row.ravel(), self.size) for row in per_edge])

    def matrices(self, blocks: Array) -> Array:
        """Sum of per-edge blocks (S, E, 8 + s, 8 + s) into dense (S, N, N)."""
        if self._gather is None:
            # float summation through one sparse matrix: much faster than np.add.at, fixed order.
            rows = (self.columns[:, :, None] * self.size + self.columns[:, None, :]).ravel()
            self._gather = sp.csr_array(
                (np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(self.size**2, len(rows))
            )
        out = self._gather @ blocks.reshape(len(blocks), -1).T
        return np.ascontiguousarray(out.T).reshape(-1, self.size, self.size)

    def sparse(self, blocks: Array) -> tuple[sp.csc_array, Array, Array]:
        """Sums of one start's blocks (E, 8 + s, 8 + s): active poses (p, p) sparse, poses by shared (4 n, s), (s, s).

        Frame blocks are summed per frame and per pair of frames; where they go in the matrix is worked out once.
        """
        if self._pattern is None:
            self._pattern = self._make_pattern()
        by_a, by_b, swap, by_pair, place, indices, pointers = self._pattern
        E, k = blocks.shape[:2]
        a = (by_a @ blocks[:, 0:4].reshape(E, -1)).reshape(-1, 4, k)
        b = (by_b @ blocks[:, 4:8].reshape(E, -1)).reshape(-1, 4, k)
        diagonal, border = a[..., 0:4] + b[..., 4:8], a[..., 8:] + b[..., 8:]
        coupling = np.where(swap[:, None, None], blocks[:, 4:8, 0:4], blocks[:, 0:4, 4:8])
        pair = (by_pair @ coupling.reshape(E, -1)).reshape(-1, 4, 4)
        values = np.concatenate([diagonal.ravel(), pair.ravel(), np.swapaxes(pair, 1, 2).ravel()])
        A = sp.csc_array((values[place], indices, pointers), shape=(len(pointers) - 1,) * 2)
        return A, border.reshape(4 * self.n, self.n_shared), blocks[:, 8:, 8:].sum(0)

    def _make_pattern(self) -> tuple[Any, ...]:
        n = self.n
        ia, ib = self.columns[:, 0] // 4, self.columns[:, 4] // 4
        swap = ia > ib
        low, high = np.minimum(ia, ib), np.maximum(ia, ib)
        keys, slot = np.unique(low * n + high, return_inverse=True)
        rows = np.concatenate([np.arange(n), keys // n, keys % n])
        cols = np.concatenate([np.arange(n), keys % n, keys // n])
        order = np.lexsort((cols, rows))
        # A matrix of running numbers instead of values: after all conversions its data say where each value goes.
        numbers = np.arange(1, 16 * len(rows) + 1, dtype=float).reshape(-1, 4, 4)[order]
        starts = np.searchsorted(rows[order], np.arange(n + 1))
        poses = np.flatnonzero(self.active[: 4 * n])
        whole = sp.bsr_array((numbers, cols[order], starts), shape=(4 * n, 4 * n)).tocsc()
        part = whole[:, poses].tocsr()[poses].tocsc()
        part.sort_indices()
        place = np.rint(part.data).astype(np.int64) - 1

        def sums(group: NDArray[np.int64], n_groups: int) -> sp.csr_array:
            edges = np.arange(len(group))
            return sp.csr_array((np.ones(len(group)), (group, edges)), shape=(n_groups, len(group)))

        return sums(ia, n), sums(ib, n), swap, sums(slot, len(keys)), place, part.indices, part.indptr


class NormalEquations:
    """Normal matrix of one state for every start, with its priors; `solve` damps it, `inverse` gives the covariance."""

    def __init__(self, layout: Layout, priors: PriorTerms, state: State, lin: Linearised) -> None:
        self.layout, self.priors = layout, priors
        n, N = layout.n, layout.size
        self.gradient = layout.vector(lin.gradient)
        self.gradient[:, 4 * n :] += priors.shared_gradient(state)
        self.gradient[:, 0 : 4 * n : 4] += priors.mean_gradient(state)[:, None] / n
        for row, value, weight in zip(
            priors.known_row, priors.known_log_f, priors.known_precision, strict=True
        ):
            self.gradient[:, 4 * row] += weight * (value - state.log_f[:, row])
        # Straight lines: terms in log f of a frame and the shared unknowns.
        lines = priors.line_terms(state)
        for row, term in lines:
            self.gradient[:, 4 * row] += term.gradient[:, 0]
            self.gradient[:, 4 * n :] += term.gradient[:, 1:]
        self.gradient[:, ~layout.active] = 0.0
        self.extra = np.zeros(N)
        self.extra[4 * n :] = priors.precision
        np.add.at(self.extra, 4 * priors.known_row, priors.known_precision)
        self.mean_weight = priors.mean_precision / n**2
        if layout.dense:
            A = layout.matrices(lin.blocks)
            A[:, np.arange(N), np.arange(N)] += self.extra
            for row, term in lines:
                place = np.array([4 * row, *range(4 * n, N)])
                A[:, place[:, None], place[None, :]] += term.block
            lam = np.arange(0, 4 * n, 4)
            A[:, lam[:, None], lam[None, :]] += self.mean_weight
            held = ~layout.active
            A[:, held, :] = 0.0
            A[:, :, held] = 0.0
            A[:, held, held] = 1.0
            self.dense: Array | None = A
            self.diagonal = np.diagonal(A, axis1=1, axis2=2).copy()
        else:
            self.dense = None
            self._sparse(lin, lines)

    def _sparse(self, lin: Linearised, lines: list[tuple[int, LineTerm]]) -> None:
        layout = self.layout
        n, N = layout.n, layout.size
        keep = np.flatnonzero(layout.active)
        self.poses, self.lens = keep[keep < 4 * n], keep[keep >= 4 * n]
        A, border, shared = layout.sparse(lin.blocks[0])
        for row, term in lines:
            self.extra[4 * row] += term.block[0, 0, 0]
            border[4 * row] += term.block[0, 0, 1:]
            shared += term.block[0, 1:, 1:]
        self.A = (A + sp.diags_array(self.extra[self.poses])).tocsc()
        shared = shared + np.diag(self.extra[4 * n :])
        u = (self.poses % 4 == 0).astype(float)[:, None]
        # The mean-log-f prior is rank one: as a bordered variable it keeps A sparse.
        self.B = np.hstack([border[self.poses][:, self.lens - 4 * n], u])
        k = len(self.lens)
        self.D = np.zeros((k + 1, k + 1))
        self.D[:k, :k] = shared[np.ix_(self.lens - 4 * n, self.lens - 4 * n)]
        self.D[k, k] = -1 / self.mean_weight
        self.diagonal = np.ones((1, N))
        self.diagonal[0, self.poses] = self.A.diagonal()
        self.diagonal[0, self.lens] = np.diagonal(self.D)[:k]

    def solve(self, start: int, damping: float) -> Array:
        """Damped step (4 n + s,) of one start. Raises numpy.linalg.LinAlgError when the matrix is singular."""
        return self.solve_for(self.gradient[start], start, damping)

    def solve_for(self, right: Array, start: int = 0, damping: float = 0.0) -> Array:
        """(damped matrix)^-1 right, both (4 n + s,). Raises numpy.linalg.LinAlgError when the matrix is singular."""
        scale = 1 / np.sqrt(np.maximum(self.diagonal[start], 1e-300))
        if self.dense is not None:
            M = self.dense[start] * scale[:, None] * scale[None, :]
            M[np.diag_indices_from(M)] += damping
            factor = scipy.linalg.cho_factor(M, lower=True, overwrite_a=True, check_finite=False)
            return scale * scipy.linalg.cho_solve(factor, scale * right, check_finite=False)
        step = np.zeros(self.layout.size)
        solution = self._bordered(damping, right[np.concatenate([self.poses, self.lens])][:, None])
        step[np.concatenate([self.poses, self.lens])] = solution[:, 0]
        return step

    def _bordered(self, damping: float, right: Array) -> Array:
        k, p = len(self.lens), len(self.poses)
        A = (self.A + sp.diags_array(damping * self.A.diagonal())).tocsc()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                factor = spla.splu(
                    A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
        except (RuntimeError, Warning) as error:
            raise np.linalg.LinAlgError(str(error)) from error
        Y = factor.solve(np.hstack([self.B, right[:p]]))
        YB, Yg = Y[:, : k + 1], Y[:, k + 1 :]
        D = self.D.copy()
        D[np.arange(k), np.arange(k)] *= 1 + damping
        lower = np.vstack([right[p:], np.zeros((1, right.shape[1]))]) - self.B.T @ Yg
        shared = np.linalg.solve(D - self.B.T @ YB, lower)
        return np.vstack([Yg - YB @ shared, shared[:k]])

    def covariance_parts(self) -> DenseCovariance | SelectedCovariance:
        """What error bars need of the inverse of the undamped matrix of the first start; linear in n when sparse.

        Raises numpy.linalg.LinAlgError when singular.
        """
        layout = self.layout
        if self.dense is not None:
            return DenseCovariance(self.covariance(), layout.n)
        ia, ib = layout.columns[:, 0] // 4, layout.columns[:, 4] // 4
        # All unknowns again: held ones as empty rows.
        n = layout.n
        spread = sp.csc_array(
            (np.ones(len(self.poses)), (self.poses, np.arange(len(self.poses)))),
            shape=(4 * n, len(self.poses)),
        )
        k = len(self.lens)
        border, shared = np.zeros((4 * n, layout.n_shared)), np.eye(layout.n_shared)
        border[np.ix_(self.poses, self.lens - 4 * n)] = self.B[:, :k]
        shared[np.ix_(self.lens - 4 * n, self.lens - 4 * n)] = self.D[:k, :k]
        full = sp.block_array([[spread @ self.A @ spread.T, border], [border.T, shared]]).tocsc()
        return SelectedCovariance(full, layout.active, layout.n, ia, ib, self.mean_weight)

    def covariance(self, start: int = 0) -> Array:
        """Inverse of the undamped matrix, (4 n + s, 4 n + s), zero rows for held unknowns: for small n, and tests.

        Raises numpy.linalg.LinAlgError when singular.
        """
        N = self.layout.size
        active = self.layout.active
        out = np.zeros((N, N))
        if self.dense is not None:
            scale = 1 / np.sqrt(np.maximum(self.diagonal[start][active], 1e-300))
            M = self.dense[start][np.ix_(active, active)] * scale[:, None] * scale[None, :]
            if not np.isfinite(M).all():
                raise np.linalg.LinAlgError("normal equations are not finite")
            factor = scipy.linalg.cho_factor(M, lower=True)
            inverse = scipy.linalg.cho_solve(factor, np.eye(len(M)))
            out[np.ix_(active, active)] = inverse * scale[:, None] * scale[None, :]
            return out
        order = np.concatenate([self.poses, self.lens])
        out[np.ix_(order, order)] = self._bordered(0.0, np.eye(len(order)))
        return out


NOTHING_TO_GAIN = 1e-7  # of the cost: some 1e-4 of one chi-square unit on a keyframe graph


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """All starts after the iteration: cost (S,), converged (S,), n_steps (S,), stop reasons, last linearisation."""

    state: State
    cost: Array
    converged: NDArray[np.bool_]
    n_steps: NDArray[np.int64]
    stop: list[str]
    lin: Linearised


def minimise(
    packed: Packed,
    layout: Layout,
    priors: PriorTerms,
    state: State,
    loss: Loss,
    *,
    max_steps: int,
    tolerance: float,
    damping0: float = 1e-4,
) -> Result:
    """Levenberg-Marquardt on every start at once; each has its own damping and stops by itself.

    Stops on an accepted step whose relative cost change is below `tolerance`, or when the predicted decrease is
    below rounding. A rejected step leaves the estimate untouched. Never raises on singular systems.
    """
    S, n = len(state.log_f), layout.n
    lin = linearise(packed, state, loss)
    cost = lin.cost + priors.cost(state)
    damping = np.full(S, damping0)
    steps, converged = np.zeros(S, int), np.zeros(S, bool)
    stop = ["max_steps"] * S
    running = np.isfinite(cost)
    for k in np.flatnonzero(~running):
        stop[k] = "impossible_start"
    log_f, R, shared = state.log_f.copy(), state.R.copy(), state.shared.copy()
    blocks, gradient, e2 = lin.blocks, lin.gradient, lin.e2
    newton_decrease = np.full(S, np.inf)  # predicted by the least damped step since the last accepted one
    while running.any():
        live = np.flatnonzero(running)
        now = State(log_f[live], R[live], shared[live])
        these = (
            live if len(live) < S else slice(None)
        )  # a slice does not copy what may be hundreds of megabytes
        equations = NormalEquations(
            layout, priors, now, Linearised(cost[these], blocks[these], gradient[these], e2[these])
        )
        pending = list(range(len(live)))
        step = np.zeros((len(live), layout.size))
        usable = np.zeros(len(live), bool)
        for j in pending:
            try:
                step[j] = equations.solve(j, damping[live[j]])
                usable[j] = np.isfinite(step[j]).all()
            except np.linalg.LinAlgError:
                usable[j] = False
        frames = step[:, : 4 * n].reshape(-1, n, 4)
        # One common factor per start keeps the direction (a component-wise clamp would not descend).
        largest = np.maximum(
            np.abs(frames[..., 0]).max(1, initial=0.0) / MAX_LOG_F_STEP,
            np.abs(frames[..., 1:]).max((1, 2), initial=0.0) / MAX_ROTATION_STEP,
        )
        step /= np.maximum(largest, 1.0)[:, None]
        clamped = largest > 1
        frames = step[:, : 4 * n].reshape(-1, n, 4)
        trial = now.moved(frames, step[:, 4 * n :])
        new = linearise(packed, trial, loss.pick(live))
        new_cost = new.cost + priors.cost(trial)
        new_cost = np.where(usable, new_cost, np.inf)
        predicted = np.sum(step * equations.gradient, 1)
        for j, k in enumerate(live):
            steps[k] += 1
            if new_cost[j] <= cost[k]:
                change = (cost[k] - new_cost[j]) / max(cost[k], 1e-300)
                log_f[k], R[k], shared[k] = trial.log_f[j], trial.R[j], trial.shared[j]
                cost[k] = new_cost[j]
                if S == 1:
                    blocks, gradient, e2 = new.blocks, new.gradient, new.e2
                else:
                    blocks[k], gradient[k], e2[k] = new.blocks[j], new.gradient[j], new.e2[j]
                if change < tolerance and not clamped[j] and damping[k] < 1e-2:
                    running[k], converged[k], stop[k] = False, True, "converged"
                damping[k] = max(damping[k] * 0.1, 1e-12)
                newton_decrease[k] = np.inf
            else:
                if usable[j] and not np.isfinite(newton_decrease[k]):
                    newton_decrease[k] = abs(predicted[j])

                if usable[j] and abs(predicted[j]) < 1e-13 * max(cost[k], 1.0) and damping[k] < 1e-2:
                    running[k], converged[k], stop[k] = False, True, "rounding"
                damping[k] = max(damping[k], 1e-8) * 10
                if damping[k] > 1e8:
                    # No step helps: either there was nothing left to gain (the Newton decrement is far below the
                    # noise, and what stays is the rounding of cost and gradient), or the system is wrong.
                    if newton_decrease[k] < NOTHING_TO_GAIN * cost[k]:
                        running[k], converged[k], stop[k] = False, True, "rounding"
                    else:
                        running[k], stop[k] = False, "singular" if not usable[j] else "diverged"
            if running[k] and steps[k] >= max_steps:
                running[k] = False
    return Result(
        State(log_f, R, shared), cost, converged, steps, stop, Linearised(cost, blocks, gradient, e2)
    )
