"""Closed-form starts: square-pixel focal of a homography, zoom along a homography, chains along a spanning tree.

All homographies here are between ideal pixels. Sources: Seo, Ahn, Hong 2000, eq. (38)-(40); calibration.md 4.1, 6.5.
Everything is scaled by 1 / W before squaring: in pixel units the equations are useless.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csgraph

from calib import distortion, homography, rotation
from calib.dlt import dlt
from calib.problem import Packed, State, chunks

Array = NDArray[np.float64]


def centred(H_b_a: ArrayLike, pp_px: ArrayLike, width_px: float, aspect: float = 1.0) -> Array:
    """H (..., 3, 3) in coordinates ((x - pp_x), aspect (y - pp_y)) / W of both frames, det 1."""
    pp = np.asarray(pp_px, float)
    T = np.array([[1, 0, -pp[0]], [0, aspect, -aspect * pp[1]], [0, 0, width_px]]) / width_px
    return homography.normalise(T @ np.asarray(H_b_a, float) @ np.linalg.inv(T))


def square_pixel_focal(H_centred: ArrayLike) -> Array:
    """Focal of frame a (...,), in widths, from H_b_a in centred coordinates; NaN where the equations give f^2 <= 0.

    Least squares over f^2 (h_i1 h_j1 + h_i2 h_j2) = -h_i3 h_j3, ij = 12, 13, 23, eq. (38). Negative squares are a
    result ("linear_invalid"), never clipped.
    """
    h = np.asarray(H_centred, float)
    left, right = [], []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        left.append(h[..., i, 0] * h[..., j, 0] + h[..., i, 1] * h[..., j, 1])
        right.append(-h[..., i, 2] * h[..., j, 2])
    A, b = np.stack(left, -1), np.stack(right, -1)
    with np.errstate(all="ignore"):
        square = np.sum(A * b, -1) / np.sum(A * A, -1)
        return np.sqrt(np.where(square > 0, square, np.nan))


def zoom_and_rotation(H_centred: ArrayLike, f_a: ArrayLike) -> tuple[Array, Array]:
    """f_b (...,) in widths and R_b_a (..., 3, 3) of H_b_a in centred coordinates, given f_a (...,) in widths.

    Q = H diag(f_a, f_a, 1)^2 H^T = mu K_b^2, eq. (39), (40), mean of the two; R is projected on SO(3).
    """
    H, f_a = np.asarray(H_centred, float), np.asarray(f_a, float)
    scaled = H.copy() * np.ones((*f_a.shape, 1, 1))
    scaled[..., :2] *= f_a[..., None, None]
    Q = scaled @ np.swapaxes(scaled, -1, -2)
    with np.errstate(all="ignore"):
        f_b = np.sqrt((Q[..., 0, 0] + Q[..., 1, 1]) / (2 * Q[..., 2, 2]))
        scaled[..., :2, :] /= f_b[..., None, None]
    return f_b, rotation.project_so3(homography.normalise(scaled))


class TreeEdge(NamedTuple):
    """One step outwards: `child` is reached from `parent` through `edge`, in its own direction when `forward`."""

    parent: int
    child: int
    edge: int
    forward: bool


def triangle_gaps(packed: Packed) -> tuple[NDArray[np.int64], Array]:
    """Triangles of edges (t, 3) by edge number, and how far going round each is from the identity (t,), px.

    Mean over five points of the picture. Each edge's own H is taken; distortion and parallax leave a few px.
    """
    W, H = packed.size_px
    probe = np.array([[0.5, 0.5], [0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7]]) * np.array([W, H])
    finite = np.asarray(np.isfinite(packed.H).all((-1, -2)))
    lookup: dict[tuple[int, int], tuple[int, bool]] = {}
    neighbours: dict[int, set[int]] = {}
    for k, (a, b) in enumerate(zip(packed.ia.tolist(), packed.ib.tolist(), strict=True)):
        if finite[k]:
            lookup[a, b], lookup[b, a] = (k, True), (k, False)
            neighbours.setdefault(a, set()).add(b)
            neighbours.setdefault(b, set()).add(a)
    corners = [
        (a, b, c)
        for a in sorted(neighbours)
        for b in sorted(n for n in neighbours[a] if n > a)
        for c in sorted(n for n in neighbours[a] & neighbours[b] if n > b)
    ]
    if not corners:
        return np.zeros((0, 3), int), np.zeros(0)
    inverse = homography.invert(np.where(finite[:, None, None], packed.H, np.eye(3)))

    def mapping(src: int, dst: int) -> Array:
        k, forward = lookup[src, dst]
        return np.asarray(packed.H[k] if forward else inverse[k])

    there = homography.normalise(np.array([mapping(b, c) @ mapping(a, b) for a, b, c in corners]))
    direct = np.array([mapping(a, c) for a, _, c in corners])
    gap = np.linalg.norm(homography.apply(there, probe) - homography.apply(direct, probe), axis=-1)
    edges = np.array([[lookup[a, b][0], lookup[b, c][0], lookup[a, c][0]] for a, b, c in corners])
    return edges, np.where(np.isfinite(gap), gap, 1e4).mean(-1)


def consistent_edges(packed: Packed, frames: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Edges (E,) left when those that break most triangles are taken away one by one.

    A triangle is broken beyond five times the median gap, and that is held between 1.2 and 2 % of the width (raw
    homographies of a distorted lens close to about 6 px at 1280, wrong ones to 25 and more). Among equals the longest
    gap goes: what was tracked over fewer frames is more likely right.
    """
    edges, gap = triangle_gaps(packed)
    keep = np.ones(packed.n_edges, bool)
    if not len(edges):
        return keep
    W = packed.size_px[0]
    broken = gap > np.clip(5 * float(np.median(gap)), 0.012 * W, 0.02 * W)
    span = np.abs(frames[packed.ia] - frames[packed.ib]).astype(float)
    preference = np.sqrt(span / max(float(np.median(span)), 1.0))
    while broken.any():
        score = np.bincount(edges[broken].ravel(), minlength=packed.n_edges) * preference
        worst = int(np.argmax(score))
        keep[worst] = False
        broken &= ~(edges == worst).any(1)
    return keep


def spanning_tree(
    packed: Packed,
    root: int | NDArray[np.int64],
    frames: NDArray[np.int64],
    trusted: NDArray[np.bool_] | None = None,
    *,
    few_steps: bool = False,
) -> list[TreeEdge]:
    """Steps from the root row(s) outwards over the shortest trusted edges, each after the one it hangs on.

    few_steps: fewest edges from a root instead, so that errors do not add up along hundreds of frame-to-frame edges.
    An edge outside `trusted` (E,) is used only where nothing else leads. Frames without a path are not in the list.
    Edges without information are not used.
    """
    n = packed.n_frames
    usable = packed.dof.sum(1) >= 8
    gap = np.abs(frames[packed.ia] - frames[packed.ib]).astype(float)
    weight = 1 + gap / max(gap.max(initial=1.0), 1.0)
    if trusted is not None:
        weight = weight + np.where(trusted, 0.0, 1e3)
    best: dict[tuple[int, int], int] = {}
    for k in np.flatnonzero(usable).tolist():
        a, b = int(packed.ia[k]), int(packed.ib[k])
        key = (min(a, b), max(a, b))
        if key not in best or weight[k] < weight[best[key]]:
            best[key] = k
    roots = np.atleast_1d(np.asarray(root))
    # One extra vertex joins the roots at no cost, so that several known frames serve as one.
    keys = list(best)
    rows = np.array([k[0] for k in keys] + [n] * len(roots), int)
    cols = np.array([k[1] for k in keys] + roots.tolist(), int)
    values = np.array([weight[best[k]] for k in keys] + [1e-6] * len(roots), float)
    graph = sp.csr_array((values, (rows, cols)), shape=(n + 1, n + 1))
    if few_steps:
        length, predecessor = csgraph.dijkstra(graph, directed=False, indices=n, return_predecessors=True)
        order = np.argsort(length, kind="stable")[: int(np.isfinite(length).sum())]
    else:
        tree = csgraph.minimum_spanning_tree(graph)
        order, predecessor = csgraph.breadth_first_order(tree, n, directed=False)
    start = set(roots.tolist())
    steps = []
    for child in order[1:].tolist():
        if child in start:
            continue
        parent = int(predecessor[child])
        k = best[min(parent, child), max(parent, child)]
        steps.append(TreeEdge(parent, child, k, int(packed.ia[k]) == parent))
    return steps


def chain(tree: list[TreeEdge], H_centred: Array, log_f: Array, R: Array) -> None:
    """Fill log_f (S, n) (of f in widths) and R (S, n, 3, 3) in place along the tree, from the roots' values."""
    inverse = homography.invert(H_centred)
    for step in tree:
        H = H_centred[:, step.edge] if step.forward else inverse[:, step.edge]
        f, R_child_parent = zoom_and_rotation(H, np.exp(log_f[:, step.parent]))
        with np.errstate(all="ignore"):
            log_f[:, step.child] = np.log(f)
        R[:, step.child] = rotation.orthonormalise(R_child_parent @ R[:, step.parent])


def ideal_homographies(packed: Packed, k1_half: Array, pp_px: Array, aspect: float) -> Array:
    """Homographies (S, E, 3, 3), centred coordinates, of the edges' points undistorted with each trial k1_half (S,).

    Where the points do not determine one, the edge's own H stands in.
    """
    W = packed.size_px[0]
    k = np.asarray(k1_half, float)[:, None, None]
    H = np.empty((len(k), packed.n_edges, 3, 3))
    for part in chunks(packed.n_edges, len(k), packed.dof.shape[1]):
        a, b, root = packed.select(part).points()
        ideal_a, ideal_b = distortion.undistort(a, pp_px, k, W), distortion.undistort(b, pp_px, k, W)
        fitted = dlt(ideal_a, ideal_b, np.broadcast_to(root, (len(k), *root.shape)))
        H[:, part] = centred(fitted, pp_px, W, aspect)
    own = centred(packed.H, pp_px, W, aspect)
    return np.where(np.isfinite(H).all((-1, -2), keepdims=True), H, own)


def weighted_median(values: Array, weights: Array) -> float:
    """The least of the values (n,) up to which half of the weights (n,) lie."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def root_focals(packed: Packed, tree: list[TreeEdge], root: int, H_centred: Array) -> tuple[Array, Array]:
    """log f (S,) in widths of the root frame from all edges, and the share (S,) of edges with a valid equation.

    Every edge's f_a is brought to the root by the chain's zoom ratios; weighted median, weights angle^4 (the
    information on f); twice, because the ratios depend weakly on f. NaN where no edge is valid.
    """
    S = len(H_centred)
    usable = packed.dof.sum(1) >= 8
    f_a = square_pixel_focal(H_centred)
    valid = np.isfinite(f_a) & usable
    log_root = np.full(S, np.log(1.3))
    out = np.full(S, np.nan)
    for _ in range(2):
        log_f = np.full((S, packed.n_frames), np.nan)
        R = np.full((S, packed.n_frames, 3, 3), np.nan)
        log_f[:, root], R[:, root] = log_root, np.eye(3)
        chain(tree, H_centred, log_f, R)
        zoom = log_f[:, packed.ia] - log_f[:, [root]]
        at_a = np.where(np.isfinite(log_f[:, packed.ia]), log_f[:, packed.ia], np.log(1.3))
        _, R_b_a = zoom_and_rotation(H_centred, np.exp(at_a))
        angle = np.linalg.norm(rotation.log(np.where(np.isfinite(R_b_a), R_b_a, np.eye(3))), axis=-1)
        with np.errstate(all="ignore"):
            estimate = np.log(f_a) - zoom
        for s in range(S):
            use = valid[s] & np.isfinite(estimate[s]) & (angle[s] > 1e-6)
            if use.any():
                out[s] = weighted_median(estimate[s][use], angle[s][use] ** 4)
        log_root = np.where(np.isfinite(out), np.clip(out, np.log(0.2), np.log(30)), log_root)
    return out, valid.sum(1) / max(1, usable.sum())


def states_from_roots(
    packed: Packed, tree: list[TreeEdge], root: int, H_centred: Array, log_root: Array, shared: Array
) -> State:
    """States (S) by chaining from the root's log f (S,) in widths; frames out of reach get the root's camera."""
    S, n = len(log_root), packed.n_frames
    log_f, R = np.full((S, n), np.nan), np.full((S, n, 3, 3), np.nan)
    log_f[:, root], R[:, root] = log_root, np.eye(3)
    chain(tree, H_centred, log_f, R)
    fine = np.isfinite(log_f) & np.isfinite(R).all((-1, -2))
    log_f = np.where(fine, log_f, log_root[:, None])
    R = np.where(fine[..., None, None], R, np.eye(3))
    return State(log_f + packed.log_width, R, np.array(shared, float))
