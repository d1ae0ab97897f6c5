"""Error bars of long graphs from parts of the inverse: equal to the whole inverse, in any order, with loops."""

from dataclasses import replace

import numpy as np
import pytest

from calib import HomographyGraph, refine, selected_inverse, solver
from calib.problem import Loss, PriorTerms, linearise, pack
from calib.selected_inverse import order_frames
from calib.starts import state_from_solution
from tests.calib import tracks
from tests.calib.test_refine import make


@pytest.mark.parametrize(("max_band", "loops"), [(96, False), (3, False), (3, True), (1, True)])
def test_parts_of_the_inverse_equal_the_whole(monkeypatch, max_band, loops):
    """Band, hubs in the border, and an order of its own where hubs are not enough."""
    monkeypatch.setattr(selected_inverse, "MAX_BAND", max_band)
    truth, graph = make(0, n=14, pan_deg=25, zoom=1.3)
    if loops:
        rng = np.random.default_rng(1)
        extra = [tracks.edge(rng, truth, 0, k) for k in (8, 9, 10)] + [tracks.edge(rng, truth, 2, 11)]
        graph = HomographyGraph(
            frames=graph.frames, edges=(*graph.edges, *(e for e in extra if e)), size_px=(1280, 720)
        )
    solution = refine(graph)
    packed = pack(graph)
    state = state_from_solution(packed, graph.frames, solution, 0)
    terms = PriorTerms(solution.priors, (1280, 720), graph.frames, np.array([True, True, False, True, True]))
    monkeypatch.setattr(solver, "DENSE_BELOW", 0)
    layout = solver.Layout(packed, 0, terms.free)
    equations = solver.NormalEquations(
        layout, terms, state, linearise(packed, state, Loss("huber", np.ones(1)))
    )
    whole, parts = equations.covariance(), equations.covariance_parts()
    n = packed.n_frames
    blocks = parts.frame_blocks()
    for k in range(n):
        part = slice(4 * k, 4 * k + 4)
        np.testing.assert_allclose(blocks[k], whole[part, part], rtol=1e-7, atol=1e-9 * whole[0, 0])
    np.testing.assert_allclose(parts.shared_variances(), np.diagonal(whole)[4 * n :], rtol=1e-8, atol=1e-16)
    v = np.random.default_rng(2).standard_normal(layout.size)
    expected = whole @ v
    np.testing.assert_allclose(parts.product(v), expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_order_takes_out_the_few_frames_that_many_come_back_to(monkeypatch):
    monkeypatch.setattr(selected_inverse, "MAX_BAND", 4)
    n = 60
    ia = np.concatenate([np.arange(n - 1), np.zeros(20, int)])
    ib = np.concatenate([np.arange(1, n), np.arange(40, 60)])
    found = order_frames(ia, ib, n)
    assert found.hubs.tolist() == [0] and found.band == 1
    assert sorted([*found.inner.tolist(), *found.hubs.tolist()]) == list(range(n))
    # Numbered at random the chain is as wide as the graph; the narrow order is found again.
    monkeypatch.setattr(selected_inverse, "MAX_HUBS", 0)
    shuffle = np.random.default_rng(3).permutation(n)
    found = order_frames(shuffle[ia[: n - 1]], shuffle[ib[: n - 1]], n)
    assert found.band == 1


def test_a_singular_matrix_says_so():
    import scipy.sparse as sp

    full = sp.csc_array((9 * 4 + 5,) * 2)
    active = np.ones(9 * 4 + 5, bool)
    with pytest.raises(np.linalg.LinAlgError):
        selected_inverse.SelectedCovariance(full, active, 9, np.arange(8), np.arange(1, 9), 1.0)


def test_a_long_graph_is_solved_from_scratch_by_way_of_its_scouts():
    """180 frames, more than are tried from 31 starts: the answer is that of a start at the truth."""
    rng = np.random.default_rng(4)
    truth = tracks.path(rng, 180, pan_deg=30, zoom=1.4, roll_deg=0.02)
    edges = [tracks.edge(rng, truth, k - 1, k) for k in range(1, 180)]
    edges += [tracks.edge(rng, truth, k // 12 * 12, k) for k in range(2, 180) if k % 12 > 1]
    edges += [
        tracks.edge(rng, truth, k - back, k) for k in range(12, 180, 12) for back in (12, 24) if k >= back
    ]
    graph = HomographyGraph(
        frames=truth.frames, edges=tuple(e for e in edges if e is not None), size_px=(1280, 720)
    )
    found = refine(graph)
    assert found.converged and found.starts and np.isfinite(found.log_f).all()
    perfect = replace(found, log_f=truth.log_f, R=truth.R, lens=truth.lens)
    best = refine(graph, start=perfect)
    assert found.cost < best.cost * (1 + 1e-5)
    np.testing.assert_allclose(found.log_f, best.log_f, atol=2e-4)
