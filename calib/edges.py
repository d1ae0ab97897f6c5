"""Edges of a graph: which frames they join, which contradict the rest, which one more look may bring back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calib.problem import Packed

Array = NDArray[np.float64]
WORST_FIRST = 0.4


def linked_frames(packed: Packed, ok: NDArray[np.bool_], reference: int) -> NDArray[np.bool_]:
    """Frames (n,) that accepted edges join to the reference row."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    return np.asarray(label == label[reference])


def linked_pairs(packed: Packed, ok: NDArray[np.bool_], row: int) -> NDArray[np.bool_]:
    """Edges (E,) both of whose frames accepted edges join to the reference."""
    linked = linked_frames(packed, ok, row)
    return linked[packed.ia] & linked[packed.ib]


def linked_to(packed: Packed, ok: NDArray[np.bool_], roots: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Frames (n,) that accepted edges join to any of the root frames (n,) bool."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    return np.isin(label, np.unique(label[roots]))


def largest_component(packed: Packed, ok: NDArray[np.bool_]) -> tuple[int, int]:
    """Number of frames and first row of the largest set of frames that accepted edges join."""
    n = packed.n_frames
    link = coo_array((np.ones(int(ok.sum())), (packed.ia[ok], packed.ib[ok])), shape=(n, n))
    _, label = connected_components(link, directed=False)
    best = int(np.argmax(np.bincount(label)))
    return int(np.sum(label == best)), int(np.flatnonzero(label == best)[0])


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


def common_variance(kappa: Array, chi2_dof: float) -> float:
    """How many stated variances an edge's common errors make of one: measurements that share them count once.

    The mean of the edges' kappa (E,), or what the fit's chi2 per degree of freedom shows if that is more; at least 1,
    which is all that can be said where neither is known (NaN: no edge's points can be seen from the solution).
    """
    known = kappa[np.isfinite(kappa)]
    return max(1.0, float(known.mean()) if known.size else 1.0, chi2_dof if np.isfinite(chi2_dof) else 1.0)
