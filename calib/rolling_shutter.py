"""How long the sensor takes to read its rows, from what a turning camera leaves of it in the residuals.

A row read later sees the camera further on its way: in a pan the picture is sheared, and between two frames only the
difference of their speeds shows. A rotation and a zoom explain a part of that; what is left is a shear of known size
and one unknown, the time from the first row to the last. Linear, over all pairs at once, with each pair's own camera
free. Parallax of the same shape is not told apart from it (real-footage.md 6.5): what a pupil explains comes out first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib import rotation
from calib.problem import Loss, Packed, State, chunks, pack, residuals, robust_scale
from calib.records import HomographyGraph, Solution

Array = NDArray[np.float64]

SIGNIFICANT = 4.0  # standard deviations
# Smaller is not worth a word: px at W = 1280 that it moves the first row of the fastest frame; and a share that errors
# of another kind reach (generator clips without a read-out time: .02 at most).
LEAST_PX, LEAST_SHARE = 0.1, 0.08
MOST_SHARE = 1.05  # of a frame's time: more is no read-out, nor is less than none
LEAST_EDGES = 6
HUBER = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingShutter:
    """share: time from the first row to the last over the time between frames, with its standard deviation; NaN
    without motion. px: how far it moves the first row of the fastest frame. found: significant and possible; reason:
    'found', 'no_motion', 'not_significant' or 'impossible' (the main job adds 'not_better')."""

    share: float
    share_std: float
    px: float
    found: bool
    reason: str
    n_pairs: int


def rolling_shutter(graph: HomographyGraph, solution: Solution, rates: Array | None = None) -> RollingShutter:
    """The read-out time that pairs of frames show, one frame number being one unit of time.

    graph: measured pairs, without the parallax of a pupil if there is one. solution: the cameras of its frames. rates
    (n, 4): their motion a frame, aligned with solution.frames; default its own, from frames that follow each other.
    Pairs whose frames have no known motion are left out.
    """
    rates = frame_rates(solution) if rates is None else rates
    row = {int(f): k for k, f in enumerate(solution.frames)}
    edges = [e for e in graph.edges if e.a in row and e.b in row]
    edges = [e for e in edges if np.isfinite(rates[[row[e.a], row[e.b]]]).all()]
    if len(edges) < LEAST_EDGES:
        return _nothing("no_motion", len(edges))
    packed = pack(HomographyGraph(frames=solution.frames, edges=tuple(edges), size_px=graph.size_px))
    told, known, fastest = [], [], 0.0
    scale: Array | None = None
    for part in chunks(packed.n_edges, 1, packed.dof.shape[1]):
        r, J, g, speed = _displacement(packed, solution, rates, part)
        seen = np.isfinite(speed).any(axis=1)
        fastest = max(fastest, float(np.nanmedian(speed[seen], axis=1).max(initial=0)))
        s11, s12, s22 = packed.s11[part], packed.s12[part], packed.s22[part]
        S = np.stack([np.stack([s11, s12], 1), np.stack([s12, s22], 1)], 1)  # (E, 2, 2, m)
        usable = (
            (packed.dof[part] > 0)
            & np.isfinite(r).all(1)
            & np.isfinite(g).all(1)
            & np.isfinite(J).all((1, 2))
        )
        r, g, J = (
            np.where(usable[:, None] if x.ndim == 3 else usable[:, None, None], x, 0.0) for x in (r, g, J)
        )
        r, g = (np.einsum("eijm,ejm->eim", S, x) for x in (r, g))
        J_b = np.einsum("eijm,ekjm->ekim", S, J[:, 4:8])
        e2 = np.sum(r * r, 1)[None]
        if scale is None:
            scale = robust_scale(e2, packed.dof[part])
        root = np.sqrt(Loss("huber", scale, HUBER).value_and_weight(e2)[1][0])[:, None]
        flat = [np.reshape(x, (len(r), -1)) for x in (r * root, g * root)]
        J_flat = np.reshape(J_b * root[:, None], (len(r), 4, -1))
        N = J_flat @ np.swapaxes(J_flat, 1, 2) + 1e-9 * np.eye(4)
        left = flat[1] - np.einsum(
            "ekn,ek->en", J_flat, np.linalg.solve(N, J_flat @ flat[1][..., None])[..., 0]
        )
        told.append(np.sum(left * flat[0], 1))
        known.append(np.sum(left * left, 1))
    a, b = np.concatenate(told), np.concatenate(known)
    if not b.sum() > 0:
        return _nothing("no_motion", len(edges))
    share = float(a.sum() / b.sum())
    # Errors of a pair are common to its points: the spread between pairs counts, not that of points.
    std = float(np.sqrt(np.sum((a - share * b) ** 2)) / b.sum())
    px = abs(share) / 2 * fastest
    if not (
        abs(share) > SIGNIFICANT * std
        and px > LEAST_PX * graph.size_px[0] / 1280
        and abs(share) > LEAST_SHARE
    ):
        reason = "not_significant"
    else:
        reason = "found" if 0 < share < MOST_SHARE else "impossible"
    return RollingShutter(
        share=share, share_std=std, px=px, found=reason == "found", reason=reason, n_pairs=len(edges)
    )


def _nothing(reason: str, n_pairs: int) -> RollingShutter:
    nan = float("nan")
    return RollingShutter(share=nan, share_std=nan, px=nan, found=False, reason=reason, n_pairs=n_pairs)


def without_rolling_shutter(
    graph: HomographyGraph, solution: Solution, share: float, rates: Array | None = None
) -> HomographyGraph:
    """The graph as if all rows of a picture had been read at its middle row's time; H, only a start value, as it was.

    solution: cameras of the graph's frames. rates (n, 4): their motion a frame, aligned with solution.frames; default
    its own. Edges of cameras or rates that are not known stay.
    """
    rates = frame_rates(solution) if rates is None else rates
    row = {int(f): k for k, f in enumerate(solution.frames)}
    usable = [
        k
        for k, e in enumerate(graph.edges)
        if e.a in row and e.b in row and np.isfinite(rates[[row[e.a], row[e.b]]]).all()
    ]
    edges = list(graph.edges)
    if usable:
        packed = pack(
            HomographyGraph(
                frames=solution.frames, edges=tuple(edges[k] for k in usable), size_px=graph.size_px
            )
        )
        for part in chunks(packed.n_edges, 1, packed.dof.shape[1]):
            _, _, g, _ = _displacement(packed, solution, rates, part)
            for k, shift in zip(usable[part], np.nan_to_num(share * g), strict=True):
                edge = edges[k]
                edges[k] = replace(edge, grid_b=edge.grid_b - shift.T[: len(edge.grid_b)])
    return replace(graph, edges=tuple(edges))


def row_delay(y_px: Array, height_px: int) -> Array:
    """When the row at y_px (...) is read after the middle one, over the time from the first row to the last."""
    return np.asarray((y_px + 0.5) / height_px - 0.5)


def frame_rates(solution: Solution) -> Array:
    """`motion_rates` of a solution's frames."""
    return motion_rates(solution.frames, solution.log_f, solution.R)


def motion_rates(frames: NDArray[np.int64], log_f: Array, R: Array) -> Array:
    """(n, 4) change of log f and left rotation increment a frame, from the frames before and after (at an end or beside
    a gap from one of them); NaN without a solved neighbour. Repeated or missing numbers count as gaps.

    frames (n,) rising numbers; log_f (n,), NaN where a frame has no camera; R (n, 3, 3), world to camera."""
    n = len(frames)
    rates = np.full((n, 4), np.nan)
    solved = np.isfinite(log_f)
    after = np.append(
        (np.diff(frames) == 1) & solved[1:] & solved[:-1], False
    )  # the next one is its neighbour
    before = np.append(False, after[:-1])
    for which, first, last in ((after & before, -1, 1), (after & ~before, 0, 1), (before & ~after, -1, 0)):
        k = np.flatnonzero(which)
        if len(k):
            span = last - first
            rates[k, 0] = (log_f[k + last] - log_f[k + first]) / span
            rates[k, 1:] = rotation.log(R[k + last] @ np.swapaxes(R[k + first], 1, 2)) / span
    return rates


def rates_at(track: Solution, frames: NDArray[np.int64]) -> Array:
    """(m, 4): frame_rates of a track at some of its frames; NaN where it has none."""
    rates, row = frame_rates(track), {int(f): k for k, f in enumerate(track.frames)}
    nothing = np.full(4, np.nan)
    return np.array([rates[row[int(f)]] if int(f) in row else nothing for f in frames]).reshape(-1, 4)


def _displacement(
    packed: Packed, solution: Solution, rates: Array, part: slice
) -> tuple[Array, Array, Array, Array]:
    """Of some edges: residuals (E, 2, m), pose Jacobian (E, 8, 2, m), what a read-out as long as a frame moves in b
    (E, 2, m), and speed in b (E, m), px a frame."""
    shared = solution.lens.shared(packed.log_f_pp)[None]
    state = State(np.nan_to_num(solution.log_f, nan=7.0)[None], np.nan_to_num(solution.R)[None], shared)
    with np.errstate(all="ignore"):
        rx, ry, J = residuals(packed, state, part, jacobian=True, pose_only=True)
    J = J[0]
    late_a, late_b = (row_delay(y[part], packed.size_px[1])[:, None] for y in (packed.a_y, packed.b_y))
    # T' v_a = -J_a rate_a: a point of the scene stays where it is in b while a turns.
    by_a = np.einsum("ek,ekim->eim", rates[packed.ia[part]], J[:, 0:4])
    by_b = np.einsum("ek,ekim->eim", rates[packed.ib[part]], J[:, 4:8])
    return np.stack([rx[0], ry[0]], 1), J, by_b * late_b + by_a * late_a, np.hypot(by_b[:, 0], by_b[:, 1])
