"""A graph as arrays, and its robust least-squares linearisation per edge. No solving here.

Everything carries a leading axis of starts, so that a multistart costs one pass. An edge's block is 13 x 13 over
(log f_a, rot_a, log f_b, rot_b, shared 5), or 16 x 16 with the shared 8 of the wider lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from calib import camera, rotation
from calib.dlt import square_root_information
from calib.lines import LineTerm, line_term
from calib.records import HomographyEdge, HomographyGraph, Priors, Solution

Array = NDArray[np.float64]
# Points linearised at once: ~60 arrays of them are the working set (measured: 61 ms for 154,000 points at 8,000, 72 ms
# at 4,000, 67 ms at 16,000, 81 ms at 32,000).
CHUNK_POINTS = 8_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Packed:
    """Edges as arrays, padded to the longest.

    ia, ib (E,) frame rows; a_x .. b_y (E, m) raw px; s11, s12, s22 (E, m) square root of the information; dof (E, m)
    directions known better than 1 px (0, 1 or 2); H (E, 3, 3) as handed in. log_f_pp: log f at which a State's
    principal point holds; of no effect but on a principal point that drifts.
    """

    ia: NDArray[np.int64]
    ib: NDArray[np.int64]
    a_x: Array
    a_y: Array
    b_x: Array
    b_y: Array
    s11: Array
    s12: Array
    s22: Array
    dof: Array
    H: Array
    n_frames: int
    size_px: tuple[int, int]
    log_f_pp: float

    @property
    def n_edges(self) -> int:
        """Number of edges."""
        return len(self.ia)

    @property
    def log_width(self) -> float:
        """log W."""
        return float(np.log(self.size_px[0]))

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Packed:
        """The same frames with some of the edges; with all of them, the same arrays."""
        if isinstance(keep, np.ndarray) and keep.dtype == bool and keep.all():
            return self
        return replace(
            self, ia=self.ia[keep], ib=self.ib[keep], a_x=self.a_x[keep], a_y=self.a_y[keep], b_x=self.b_x[keep],
            b_y=self.b_y[keep], s11=self.s11[keep], s12=self.s12[keep], s22=self.s22[keep], dof=self.dof[keep],
            H=self.H[keep],
        )  # fmt: skip

    def thin(self, n_points: int) -> Packed:
        """The same edges with about n_points of their points: an even stride through each edge's known points."""
        m = self.dof.shape[1]
        if m <= n_points:
            return self
        # Known points first, in their own order; then an even stride through them.
        order = np.argsort(self.dof <= 0, axis=1, kind="stable")
        count = np.maximum((self.dof > 0).sum(1), 1)
        # Golden-ratio phase per edge: not the same columns of the grid in every edge.
        phase = (np.arange(self.n_edges) * 0.618) % 1.0
        steps = (
            (np.arange(n_points)[None, :] + phase[:, None]) * np.maximum(count, n_points)[:, None] / n_points
        )
        pick = np.take_along_axis(order, np.minimum(steps.astype(int), m - 1), 1)

        def take(values: Array) -> Array:
            return np.take_along_axis(values, pick, 1)

        return replace(
            self, a_x=take(self.a_x), a_y=take(self.a_y), b_x=take(self.b_x), b_y=take(self.b_y),
            s11=take(self.s11), s12=take(self.s12), s22=take(self.s22), dof=take(self.dof),
        )  # fmt: skip

    def points(self) -> tuple[Array, Array, Array]:
        """grid_a (E, m, 2), grid_b (E, m, 2), root information (E, m, 2, 2)."""
        root = np.stack([np.stack([self.s11, self.s12], -1), np.stack([self.s12, self.s22], -1)], -2)
        return np.stack([self.a_x, self.a_y], -1), np.stack([self.b_x, self.b_y], -1), root


def pack(graph: HomographyGraph, edges: Sequence[HomographyEdge] | None = None) -> Packed:
    """Arrays of a graph's edges (or of the given ones among its frames). Non-finite points carry no information."""
    edges = graph.edges if edges is None else tuple(edges)
    rows = {frame: k for k, frame in enumerate(graph.frames.tolist())}
    centre = ((graph.size_px[0] - 1) / 2, (graph.size_px[1] - 1) / 2)
    E, m = len(edges), max([1, *(len(e.grid_a) for e in edges)])
    # a_x, a_y, b_x, b_y, s11, s12, s22, dof: all that a long shot needs room for.
    columns = [np.full((E, m), empty) for empty in (*centre, *centre, 0.0, 0.0, 0.0, 0.0)]
    for part in chunks(E, 1, m):
        _fill(edges[part], [column[part] for column in columns], centre)
    a_x, a_y, b_x, b_y, s11, s12, s22, dof = columns
    return Packed(
        ia=np.array([rows[e.a] for e in edges], int), ib=np.array([rows[e.b] for e in edges], int),
        a_x=a_x, a_y=a_y, b_x=b_x, b_y=b_y, s11=s11, s12=s12, s22=s22, dof=dof,
        H=np.array([e.H for e in edges], float).reshape(-1, 3, 3),
        n_frames=len(graph.frames), size_px=graph.size_px, log_f_pp=float(np.log(graph.size_px[0])),
    )  # fmt: skip


def _fill(edges: Sequence[HomographyEdge], columns: list[Array], centre: tuple[float, float]) -> None:
    """The edges' points written to Packed's columns (E, m), which hold what an edge without a point has there."""
    count = np.array([len(e.grid_a) for e in edges], int)
    kappa = np.array([e.kappa for e in edges], float)
    a = np.concatenate([np.empty((0, 2)), *(e.grid_a for e in edges)])
    b = np.concatenate([np.empty((0, 2)), *(e.grid_b for e in edges)])
    info = np.concatenate([np.empty((0, 2, 2)), *(e.info for e in edges)])
    info /= np.repeat(kappa, count)[:, None, None]
    finite: NDArray[np.bool_] = np.asarray(
        np.isfinite(a).all(-1) & np.isfinite(b).all(-1) & np.isfinite(info).all((-1, -2))
    )
    info[~finite] = 0.0
    # A point without information must not decide whether a camera is possible: it goes to the centre.
    unknown = info.sum((-1, -2)) == 0
    a[unknown] = b[unknown] = centre
    S = square_root_information(info)
    half, diff = 0.5 * (info[:, 0, 0] + info[:, 1, 1]), 0.5 * (info[:, 0, 0] - info[:, 1, 1])
    spread = np.sqrt(diff**2 + info[:, 0, 1] ** 2)
    # A direction worse than 1 px counts as unknown. kappa widens the edge but does not remove measurements.
    one = 1 / np.repeat(kappa, count)
    dof = (half - spread > one).astype(float) + (half + spread > one)
    place = np.arange(columns[0].shape[1]) < count[:, None]
    values = (a[:, 0], a[:, 1], b[:, 0], b[:, 1], S[:, 0, 0], S[:, 0, 1], S[:, 1, 1], dof)
    for column, value in zip(columns, values, strict=True):
        column[place] = value


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Unknowns of S starts: log_f (S, n), R (S, n, 3, 3), shared (S, 5) = pp_x, pp_y, log aspect, c0, c1, or (S, 8)."""

    log_f: Array
    R: Array
    shared: Array

    def pick(self, which: NDArray[np.int64] | slice) -> State:
        """Some of the starts."""
        return State(self.log_f[which], self.R[which], self.shared[which])

    def moved(self, frames: Array, shared: Array) -> State:
        """Steps (S, n, 4) and (S, 5 or 8) applied: rotations from the left, made orthonormal again.

        Pixels show a focal length times an angle: the data's flat valley is angle = constant / f. A straight step of d
        in the mean log f leaves it by d^2 / 2 of the angles; turned by (1 - exp(-d)) / d as far, it stays in. Small
        steps are the same.
        """
        bent = special.exprel(-frames[..., 0].mean(-1))[:, None, None]
        R = rotation.orthonormalise(rotation.exp(frames[..., 1:] * bent) @ self.R)
        return State(self.log_f + frames[..., 0], R, self.shared + shared)


def state_of(packed: Packed, solution: Solution) -> State:
    """A solution of the packed frames as a State of one start."""
    return State(solution.log_f[None], solution.R[None], solution.lens.shared(packed.log_f_pp)[None])


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """cost (S,) robust; blocks (S, E, 13, 13) J^T W J; gradient (S, E, 13) J^T W r; e2 (S, E, m) squares, whitened.

    (16 of the wider lens.) An impossible state has cost inf.
    """

    cost: Array
    blocks: Array
    gradient: Array
    e2: Array


@dataclass
class Loss:
    """Robust loss over points: 'huber' or 'tukey' with thresholds in units of scale (S,) times the stated sigma."""

    kind: str
    scale: Array
    huber: float = 3.0
    tukey: float = 4.7

    def pick(self, which: NDArray[np.int64]) -> Loss:
        """The loss of some of the starts."""
        return Loss(self.kind, self.scale[which], self.huber, self.tukey)

    def value_and_weight(self, e2: Array) -> tuple[Array, Array]:
        """rho(e) and rho'(e) / 2e, both (S, E, m)."""
        if self.kind == "tukey":
            c2 = (self.tukey * self.scale[:, None, None]) ** 2
            left = np.maximum(1 - e2 / c2, 0.0)
            return c2 / 3 * (1 - left**3), left**2
        k = self.huber * self.scale[:, None, None]
        e = np.sqrt(e2)
        near = np.minimum(e, k)
        return near * (2 * e - near), k / np.maximum(e, k)


def chunks(n_edges: int, n_starts: int, m: int) -> list[slice]:
    """Slices of edges of about CHUNK_POINTS points each."""
    size = max(1, CHUNK_POINTS // max(1, n_starts * m))
    return [slice(k, min(k + size, n_edges)) for k in range(0, n_edges, size)]


def residuals(
    packed: Packed,
    state: State,
    which: slice = slice(None),
    *,
    jacobian: bool = False,
    pose_only: bool = False,
) -> tuple[Array, Array, Array]:
    """Raw residuals r_x, r_y (S, E, m) px of measured minus predicted, and the Jacobian of the prediction or None."""
    out = _seen(packed, state, which)
    J = out.jacobian(pose_only=pose_only) if jacobian else None
    return packed.b_x[which] - out.x, packed.b_y[which] - out.y, J  # type: ignore[return-value]


def _seen(packed: Packed, state: State, which: slice) -> camera.Seen:
    ia, ib = packed.ia[which], packed.ib[which]
    return camera.Seen(
        packed.a_x[which], packed.a_y[which], state.log_f[:, ia], state.log_f[:, ib],
        state.R[:, ib] @ np.swapaxes(state.R[:, ia], -1, -2), state.shared[:, None], packed.size_px[0],
        log_f_pp=packed.log_f_pp,
    )  # fmt: skip


def whitened_squares(packed: Packed, state: State) -> Array:
    """Squared whitened residuals e2 (S, E, m); inf where a point cannot be transferred."""
    out = np.empty((len(state.log_f), packed.n_edges, packed.dof.shape[1]))
    with np.errstate(all="ignore"):
        for part in chunks(*out.shape[1::-1], out.shape[2]):
            rx, ry, _ = residuals(packed, state, part)
            s11, s12, s22 = packed.s11[part], packed.s12[part], packed.s22[part]
            e2 = (s11 * rx + s12 * ry) ** 2 + (s12 * rx + s22 * ry) ** 2
            out[:, part] = np.where(packed.dof[part] > 0, np.where(np.isnan(e2), np.inf, e2), 0.0)
    return out


class AdaptiveLoss(Loss):
    """Huber with the scale that the residuals have at the moment: for the first steps of a small problem."""

    def __init__(self, dof: Array, huber: float) -> None:
        super().__init__("huber", np.ones(1), huber)
        self.dof = dof

    def value_and_weight(self, e2: Array) -> tuple[Array, Array]:
        """As Loss, at the residuals' own scale."""
        return Loss("huber", robust_scale(e2, self.dof), self.huber).value_and_weight(e2)


def linearise(packed: Packed, state: State, loss: Loss, *, pose_only: bool = False) -> Linearised:
    """Cost, normal blocks and gradients per edge at a state; pose_only leaves the shared columns out (8 x 8 blocks)."""
    S, E, m = len(state.log_f), packed.n_edges, packed.dof.shape[1]
    n_columns = camera.N_POSES if pose_only else camera.N_POSES + state.shared.shape[1]
    blocks, gradient = np.empty((S, E, n_columns, n_columns)), np.empty((S, E, n_columns))
    e2_all, cost = np.empty((S, E, m)), np.zeros(S)
    with np.errstate(all="ignore"):
        for part in chunks(E, S, m):
            seen = _seen(packed, state, part)
            rx, ry = packed.b_x[part] - seen.x, packed.b_y[part] - seen.y
            s11, s12, s22 = packed.s11[part], packed.s12[part], packed.s22[part]
            ex, ey = s11 * rx + s12 * ry, s12 * rx + s22 * ry
            e2 = ex * ex + ey * ey
            unknown = packed.dof[part] <= 0
            e2[:, unknown] = 0.0
            value, weight = loss.value_and_weight(e2)
            # What counts nothing must not pull: a gradient of points without a cost leaves no state at rest.
            weight[:, unknown] = 0.0
            cost += value.sum((1, 2))
            root = np.sqrt(weight)
            e = np.stack([ex * root, ey * root], -2).reshape(S, -1, 2 * m, 1)
            Jw = seen.jacobian((s11 * root, s12 * root, s22 * root), pose_only=pose_only)
            Jw = Jw.reshape(S, -1, n_columns, 2 * m)
            np.matmul(Jw, np.swapaxes(Jw, -1, -2), out=blocks[:, part])
            gradient[:, part] = (Jw @ e)[..., 0]
            e2_all[:, part] = e2
    bad = ~np.isfinite(cost)
    cost[bad] = np.inf
    return Linearised(cost, blocks, gradient, e2_all)


def robust_scale(e2: Array, dof: Array) -> Array:
    """Scale (S,) of whitened residuals from their median, at least 1 (the stated noise), over the known points.

    1.177 = median of |e| for two unit-variance components; an edge with one known direction per point lowers it a bit.
    """
    known = dof > 0
    if not known.any():
        return np.ones(len(e2))
    values = np.where(np.isfinite(e2[:, known]), e2[:, known], 1e30)
    return np.maximum(1.0, np.sqrt(np.median(values, axis=1)) / 1.177)


class PriorTerms:
    """Gaussian priors as additions to cost, normal matrix and gradient; `free` (5,) or (8,): which shared ones move.

    log_f_pp: as in Packed, for straight lines under a principal point that drifts.
    """

    def __init__(
        self,
        priors: Priors,
        size_px: tuple[int, int],
        frames: NDArray[np.int64],
        free: NDArray[np.bool_],
        log_f_pp: float = 0.0,
    ) -> None:
        W = size_px[0]
        self.free = np.asarray(free, bool)
        pp = priors.pp_mean_px(size_px)
        mean = [*pp, np.log(priors.aspect), priors.c0_mean, priors.c1_mean, priors.k2_mean, 0.0, 0.0]
        std = [
            priors.pp_std_x * W, priors.pp_std_y * W, priors.aspect_std, priors.c0_std, priors.c1_std,
            priors.k2_std, priors.pp_drift_std * W, priors.pp_drift_std * W,
        ]  # fmt: skip
        self.mean = np.array(mean[: len(self.free)])
        self.std = np.maximum(np.array(std[: len(self.free)]), 1e-9)
        self.precision = np.where(self.free, 1 / self.std**2, 0.0)
        self.mean_log_f, self.mean_precision = priors.log_f_mean + np.log(W), 1 / priors.log_f_std**2
        rows = {frame: k for k, frame in enumerate(frames.tolist())}
        known = [
            (rows[p.frame], np.log(p.f_px), (p.f_px / p.std_px) ** 2)
            for p in priors.known_focals
            if p.frame in rows
        ]
        self.known_row = np.array([k for k, _, _ in known], int)
        self.known_log_f = np.array([v for _, v, _ in known], float)
        self.known_precision = np.array([w for _, _, w in known], float)
        self.lines = [(rows[line.frame], line) for line in priors.straight_lines if line.frame in rows]
        self.width_px, self.log_f_pp = float(W), log_f_pp

    def line_terms(self, state: State) -> list[tuple[int, LineTerm]]:
        """Row of the frame and term of every straight line."""
        return [
            (row, line_term(line, state.log_f[:, row], state.shared, self.width_px, self.log_f_pp))
            for row, line in self.lines
        ]

    def cost(self, state: State) -> Array:
        """Sum of squared prior residuals (S,)."""
        out = np.sum(self.precision * (state.shared - self.mean) ** 2, -1)
        out = out + self.mean_precision * (state.log_f.mean(-1) - self.mean_log_f) ** 2
        for _, term in self.line_terms(state):
            out = out + term.cost
        return out + np.sum(
            self.known_precision * (state.log_f[:, self.known_row] - self.known_log_f) ** 2, -1
        )

    def shared_gradient(self, state: State) -> Array:
        """J^T W r of the shared parameters (S, 5 or 8)."""
        return self.precision * (self.mean - state.shared)

    def mean_gradient(self, state: State) -> Array:
        """Precision times residual of the mean-log-f prior (S,): gradient / n on every log f."""
        return self.mean_precision * (self.mean_log_f - state.log_f.mean(-1))
