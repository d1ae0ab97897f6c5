"""Gates, poses, level, observability: claims only where the motion allows them, error bars that hold."""

from dataclasses import replace

import numpy as np
import pytest

from calib import (
    GateOptions,
    HomographyGraph,
    RefineOptions,
    judge,
    level,
    observability,
    refine,
    rotation,
    solve_poses,
)
from calib.gates import SENTENCES
from calib.selected_inverse import inverse_diagonal_blocks
from tests.calib import tracks
from tests.calib.test_refine import common_error, make

MOTIONS = {
    "no_rotation": {"pan_deg": 0, "tilt_deg": 0, "roll_deg": 0},
    "zoom_only": {"pan_deg": 0, "tilt_deg": 0, "roll_deg": 0, "zoom": 2.0},
    "roll_only": {"pan_deg": 0, "tilt_deg": 0, "roll_deg": 8.0},
}


@pytest.mark.parametrize("reason", MOTIONS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_motion_that_hides_the_focal_claims_none(reason, seed):
    _, graph = make(seed, n=6, **MOTIONS[reason])
    verdict = judge(refine(graph), graph)
    assert not verdict.claims_focal
    assert verdict.reason == reason
    assert verdict.sentence == SENTENCES[reason]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_turn_of_a_fifth_of_a_degree_claims_nothing(seed):
    _, graph = make(seed, n=6, pan_deg=0.2, tilt_deg=0.05, zoom=1.3)
    assert not judge(refine(graph), graph).claims_focal


def test_a_pan_is_claimed_with_its_error():
    truth, graph = make(0, n=10, pan_deg=20, zoom=1.5, smooth_px=0.03)
    solution = refine(graph)
    verdict = judge(solution, graph)
    assert verdict.claims_focal, verdict.reason
    assert verdict.sigma_log_f_total <= 0.05
    assert abs(common_error(solution, truth)) <= 2 * verdict.sigma_log_f_total
    assert verdict.support_rows == 5
    assert verdict.sigma_parts["cluster"] < verdict.sigma_log_f_total
    assert 18 < verdict.rotation_deg < 23
    assert verdict.zoom_range == pytest.approx(1.5, rel=0.01)


def test_without_distortion_in_the_model_nothing_is_claimed():
    truth, graph = make(1, n=10, pan_deg=20, zoom=1.3, c0=0.04, c1=0.0)
    solution = refine(graph, options=RefineOptions(distortion=False))
    assert abs(common_error(solution, truth)) > 0.1  # the trap: a tight, wrong answer
    assert not judge(solution, graph).claims_focal
    truth, graph = make(1, n=10, pan_deg=20, zoom=1.3, c0=0.003, c1=0.0)
    verdict = judge(refine(graph, options=RefineOptions(distortion=False)), graph)
    assert verdict.reason == "distortion_not_modelled"


def test_a_band_of_texture_claims_nothing():
    _, graph = make(2, n=10, pan_deg=30, zoom=1.5, rows=(0, 1), smooth_px=0.02)
    verdict = judge(refine(graph), graph)
    assert not verdict.claims_focal
    assert verdict.support_rows == 2


def test_nothing_and_misfit_have_their_reasons():
    _, graph = make(3, n=6, pan_deg=20)
    empty = replace(graph, edges=())
    assert judge(refine(empty), empty).reason == "too_few_edges"
    # A camera that also travels: near cells (low in the picture) move on.
    edges = tuple(
        replace(
            e,
            grid_b=e.grid_b
            + np.stack([3.0 * (e.b - e.a) / 10 * (e.grid_a[:, 1] / 720) ** 2, 0 * e.grid_a[:, 1]], 1),
        )
        for e in graph.edges
    )
    travelling = replace(graph, edges=edges)
    verdict = judge(refine(travelling), travelling)
    assert verdict.sigma_log_f_total > 0.1 or verdict.reason == "model_misfit"
    assert not verdict.claims_focal
    with pytest.raises(ValueError):
        judge(refine(graph), empty)


def test_errors_of_single_edges_are_not_taken_for_shared_ones():
    _, quiet = make(4, n=8, pan_deg=20, zoom=1.3, smooth_px=0.0)
    _, noisy = make(4, n=8, pan_deg=20, zoom=1.3, smooth_px=0.3)
    parts = [judge(refine(g), g, GateOptions(refits=False)).sigma_parts for g in (quiet, noisy)]
    assert parts[0]["systematic_px"] == pytest.approx(0.05, abs=0.02)
    assert parts[0]["coherent_px"] < 0.05 < parts[1]["coherent_px"]
    assert parts[1]["shared_px"] < 0.15  # .42 px rms in two components, in every edge


@pytest.mark.parametrize("seed", range(6))
def test_a_pupil_in_front_of_the_axis_widens_the_stated_error(seed):
    truth, graph = make(seed, n=10, pan_deg=15 + 4 * seed, zoom=1.4, f_w=1.3 + 0.1 * seed, c0=0.05, c1=-0.018)
    moved = tuple(
        replace(e, grid_b=e.grid_b + tracks.parallax(truth, e.a // 10, e.b // 10, e.grid_a, 0.6))
        for e in graph.edges
    )
    parallax = replace(graph, edges=moved)
    solution = refine(parallax)
    verdict, without = judge(solution, parallax), judge(refine(graph), graph)
    error = common_error(solution, truth)
    assert abs(error) > 2.5 * solution.sigma_mean_log_f  # the trap: the statistical bar is fiction
    assert abs(error) < 2 * verdict.sigma_log_f_total
    assert verdict.sigma_parts["shared_px"] > 1.5 * without.sigma_parts["shared_px"]
    assert without.sigma_log_f_total < 0.05


@pytest.mark.slow
def test_two_sigma_covers_quick_tracks():
    inside = claimed = 0
    z_statistical = []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        truth = tracks.path(
            rng, 8, pan_deg=float(rng.uniform(10, 40)), zoom=float(rng.uniform(1, 2.5)),
            f_w=float(rng.uniform(0.9, 1.8)), c0=float(rng.uniform(0, 0.05)), c1=float(rng.uniform(-0.02, 0.01)),
            pp_offset_px=tuple(rng.normal(0, (6, 12))),
        )  # fmt: skip
        graph = tracks.graph(rng, truth, max_span=3)
        solution = refine(graph)
        verdict = judge(solution, graph)
        error = common_error(solution, truth)
        z_statistical.append(error / solution.sigma_mean_log_f)
        if verdict.claims_focal:
            claimed += 1
            inside += abs(error) <= 2 * verdict.sigma_log_f_total
    assert claimed >= 30
    assert inside >= 0.93 * claimed
    # The statistical bar alone: 68 % of a Gaussian, 40 trials, three standard errors.
    assert 0.45 < np.mean(np.abs(z_statistical) < 1) < 0.9


def test_poses_between_keyframes():
    rng = np.random.default_rng(5)
    n, step = 61, 10
    truth = tracks.path(rng, n, pan_deg=20, zoom=1.5)
    truth = replace(truth, frames=np.arange(n))
    keys = np.arange(0, n, step)
    key_edges = [
        tracks.edge(rng, truth, a, b, smooth_px=0.05) for i, a in enumerate(keys) for b in keys[i + 1 : i + 4]
    ]
    key_edges = [e for e in key_edges if e is not None]
    held = refine(HomographyGraph(frames=keys, edges=tuple(key_edges), size_px=(1280, 720)))
    edges = list(key_edges)
    for t in range(n):
        if t % step:
            edges.append(tracks.edge(rng, truth, t // step * step, t, smooth_px=0.05))
            edges.append(tracks.edge(rng, truth, t - 1, t, smooth_px=0.05))
    wrong = tracks.edge(rng, truth, 5, 16, shift_px=30.0)
    graph = HomographyGraph(frames=truth.frames, edges=(*edges, wrong), size_px=(1280, 720))
    out = solve_poses(graph, held)
    assert out.converged and not out.edge_ok[-1] and out.edge_ok[:-1].all()
    np.testing.assert_array_equal(out.log_f[keys], held.log_f)
    np.testing.assert_allclose(out.R[keys], held.R, atol=1e-12)
    error = out.log_f - truth.log_f
    assert np.std(error) < 5e-4
    free = np.setdiff1d(truth.frames, keys)
    assert np.all(out.sigma_log_f[free] > np.interp(free, keys, held.sigma_log_f))
    # Own errors against their bars (common part removed frame by frame through the neighbours' mean).
    own = np.sqrt(out.sigma_log_f[free] ** 2 - np.interp(free, keys, held.sigma_log_f) ** 2)
    z = (error[free] - np.interp(free, keys, error[keys])) / own
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6
    lonely = solve_poses(
        HomographyGraph(frames=np.array([0, 10, 99]), edges=tuple(key_edges[:1]), size_px=(1280, 720)), held
    )
    assert np.isnan(lonely.log_f[2]) and np.isnan(lonely.R[2]).all()
    with pytest.raises(ValueError):
        solve_poses(HomographyGraph(frames=np.array([98, 99]), edges=(), size_px=(1280, 720)), held)
    # A lens that folds the whole picture away sees none of the measurements: no fit, and not a word on the terminal.
    folded = solve_poses(graph, replace(held, lens=replace(held.lens, c0=-2.0)))
    assert not folded.converged and np.isnan(folded.edge_kappa).all()


@pytest.mark.parametrize("band", [1, 3])
def test_block_recursion_equals_the_dense_inverse(band):
    import scipy.sparse as sp

    rng = np.random.default_rng(6)
    n = 11
    A = np.zeros((4 * n, 4 * n))
    for i in range(n):
        for j in range(i, min(n, i + band + 1)):
            J = rng.standard_normal((10, 8))
            B = J.T @ J
            index = np.r_[4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
            A[np.ix_(index, index)] += B if i != j else np.eye(8) * 0.5
    inverse = np.linalg.inv(A)
    blocks = inverse_diagonal_blocks(sp.csc_array(A), band)
    for k in range(n):
        np.testing.assert_allclose(
            blocks[k], inverse[4 * k : 4 * k + 4, 4 * k : 4 * k + 4], rtol=1e-9, atol=1e-13
        )


def head_track(pan_deg, tilt_deg, tilt0_deg=-12.0, rho_deg=0.7, roll_deg=0.0, seed=7):
    rng = np.random.default_rng(seed)
    truth = tracks.path(rng, 12, pan_deg=pan_deg, tilt_deg=tilt_deg, zoom=1.2, roll_deg=0.0)
    t = np.linspace(0, 1, 12)
    pan, tilt = np.deg2rad(pan_deg) * t, np.deg2rad(tilt0_deg + tilt_deg * np.sin(5 * t))
    R = rotation.from_pan_tilt_roll(pan, tilt, np.deg2rad(rho_deg + roll_deg * rng.standard_normal(12)))
    truth = replace(truth, R=R @ R[0].T)
    return R, truth, tracks.graph(rng, truth, max_span=3, smooth_px=0.05)


def test_head_axis_from_a_pan():
    R, _truth, graph = head_track(30, 3)
    found = level(refine(graph))
    assert found.observable, found.reason
    assert np.rad2deg(found.tilt0_rad) == pytest.approx(-12, abs=3 * np.rad2deg(found.tilt0_std_rad) + 0.05)
    assert np.rad2deg(found.rho_rad) == pytest.approx(0.7, abs=3 * np.rad2deg(found.rho_std_rad) + 0.05)
    solution = refine(graph)
    absolute = solution.R @ found.R_head_world.T
    _, tilt, roll = rotation.to_pan_tilt_roll(absolute)
    _, true_tilt, _ = rotation.to_pan_tilt_roll(R)
    np.testing.assert_allclose(tilt, true_tilt, atol=np.deg2rad(0.3))
    np.testing.assert_allclose(roll, np.deg2rad(0.7), atol=np.deg2rad(0.3))


def test_head_axis_is_refused_where_it_is_not_observable():
    still = level(refine(head_track(0.0, 8)[2]))
    assert not still.observable and still.reason == "head_axis_unobservable" and np.isnan(still.tilt0_rad)
    shaky = level(refine(head_track(30, 3, roll_deg=2.0)[2]))
    assert not shaky.observable and shaky.reason in ("not_a_pan_tilt_head", "head_axis_unobservable")


def turns(*angles):
    return rotation.from_pan_tilt_roll(*np.deg2rad(np.array([(0.0, 0.0, 0.0), *angles])).T)


@pytest.mark.parametrize(
    ("rotations", "rank"),
    # calibration.md 2.4
    [
        (turns((0, 0, 0)), 1),
        (turns((0, 0, 10), (0, 0, 20)), 2),
        (turns((10, 0, 0), (20, 0, 0), (25, 0, 0)), 2),
        (turns((0, 10, 0), (0, 20, 0), (0, 5, 0)), 2),
        (rotation.exp(np.array([[0, 0, 0], [1, 1, 0], [2, 2, 0], [3, 3, 0]]) * 0.1), 3),
        (turns((10, 5, 0), (20, -5, 0), (-10, 8, 0), (15, 12, 0), (5, -10, 0)), 4),
        (turns((10, 5, 20), (20, -5, -30), (-10, 28, 10), (25, 12, -20), (5, -20, 30)), 5),
    ],
)
def test_rank_table_of_the_zero_skew_theorem(rotations, rank):
    found = observability(rotations)
    assert found.rank == rank
    assert found.null_space.shape == (6 - rank, 3, 3)
    # The identity is always among what cannot be told apart from it.
    assert observability(rotations, square_pixels=True).rank >= 2


def test_square_pixels_make_a_plain_pan_enough():
    assert observability(turns((10, 0, 0), (20, 0, 0)), square_pixels=True).rank == 5
    assert observability(turns((10, 0, 0)), square_pixels=True).rank == 4
    assert observability(turns((0, 0, 10)), square_pixels=True).rank == 2
    with pytest.raises(ValueError):
        observability(np.eye(3))
