"""The wider lens: a second coefficient of distortion, a principal point that drifts with the zoom; off by default."""

from dataclasses import replace

import numpy as np
import pytest

from calib import (
    Lens,
    Priors,
    RefineOptions,
    RunningCalibrator,
    camera,
    distortion,
    judge,
    refine,
    rotation,
    serial,
    solver,
)
from calib.poses import solve_poses
from calib.priors import LensProfile, lens_profile, with_profile
from calib.problem import Loss, PriorTerms, State, linearise, pack, residuals, state_of
from tests.calib import tracks

WITH_K2 = Priors(k2_std=0.02)
WITH_DRIFT = Priors(pp_drift_std=20 / 1280)


def make(seed, n=8, *, k2=0.0, drift=(0.0, 0.0), smooth_px=0.1, **kw):
    """A track whose lens has a k2 or a drift about its mean log f, and its graph."""
    rng = np.random.default_rng(seed)
    truth = tracks.path(rng, n, **kw)
    lens = replace(truth.lens, k2=k2, pp_drift_px=np.array(drift), pp_log_f=float(truth.log_f.mean()))
    truth = replace(truth, lens=lens)
    return truth, tracks.graph(rng, truth, max_span=3, smooth_px=smooth_px)


def common_error(solution, truth):
    return float(np.mean(solution.log_f - truth.log_f))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("angle_rad", [1e-7, 0.05, 0.4])
@pytest.mark.parametrize(("k1", "k2"), [(0.05, -0.03), (-0.04, 0.02), (0.0, 0.0)])
def test_transfer_jacobian_equals_central_differences(angle_rad, k1, k2):
    rng = np.random.default_rng(4)
    axis = np.array([0.3, 0.9, 0.1])
    Ra = rotation.exp(0.05 * rng.standard_normal(3))
    Rb = rotation.exp(angle_rad * axis / np.linalg.norm(axis)) @ Ra
    x, y = rng.uniform(100, 900, 9), rng.uniform(100, 600, 9)
    shared = np.array([650.0, 350.0, 0.02, k1, -0.02, k2, 12.0, -25.0])

    def predict(p, **kw):
        A, B = rotation.exp(p[1:4]) @ Ra, rotation.exp(p[5:8]) @ Rb
        return camera.transfer(
            x,
            y,
            np.log(1800) + p[0],
            np.log(2100) + p[4],
            B @ A.T,
            shared + p[8:],
            1280,
            log_f_pp=np.log(1500),
            **kw,
        )

    J = predict(np.zeros(16), jacobian=True).J
    step = np.array([1e-5] * 8 + [1e-3, 1e-3] + [1e-5] * 4 + [1e-3, 1e-3])
    for k in range(16):
        d = np.zeros(16)
        d[k] = step[k]
        plus, minus = predict(d, jacobian=False), predict(-d, jacobian=False)
        numeric = np.stack([plus.x - minus.x, plus.y - minus.y]) / (2 * step[k])
        np.testing.assert_allclose(J[k], numeric, rtol=2e-6, atol=2e-6 * max(1.0, np.abs(numeric).max()))
    np.testing.assert_array_equal(predict(np.zeros(16), pose_only=True).J, J[:8])


def test_without_k2_and_drift_it_is_the_usual_lens():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(100, 1100, 20), rng.uniform(50, 650, 20)
    usual = np.array([650.0, 350.0, 0.02, 0.03, -0.02])
    where = (x, y, np.log(1800), np.log(2100), rotation.exp([0.02, 0.1, 0.01]))
    a = camera.transfer(*where, usual, 1280)
    b = camera.transfer(*where, np.array([*usual, 0, 0, 0]), 1280)
    np.testing.assert_allclose([b.x, b.y], [a.x, a.y], rtol=1e-13)
    np.testing.assert_allclose(b.J[:13], a.J, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("k1", "k2"), [(-0.3, 0.08), (0.3, -0.1), (-0.1, -0.05), (0.1, 0.05), (-0.35, 0.0), (-0.3, 0.03)]
)
def test_beyond_the_first_fold_nothing_is_seen(k1, k2):
    edge = np.sqrt(distortion.fold_square(k1, k2))
    rho = np.linspace(0, 3, 3001)
    slope = 1 + 3 * k1 * rho**2 + 5 * k2 * rho**4
    one_to_one = np.cumsum(slope <= 0) == 0  # up to the first fold, also where a second branch follows
    np.testing.assert_array_equal(one_to_one, rho < edge)
    inside = rho[rho < min(0.95 * edge, 1.3)]  # six Newton steps; nearer to the fold the radius may be NaN
    observed = inside * (1 + k1 * inside**2 + k2 * inside**4)
    np.testing.assert_allclose(distortion.undistorted_radius(observed, k1, k2), inside, atol=1e-9)
    points = np.stack([640 * rho, np.zeros_like(rho)], -1)
    seen = np.isfinite(distortion.distort(points, (0, 0), k1, 1280, k2)).all(-1)
    np.testing.assert_array_equal(seen, rho < edge)
    corner = np.hypot(1, 720 / 1280)
    assert distortion.is_invertible(k1, (1280, 720), k2) == bool(one_to_one[rho <= corner].all())


def test_a_lens_with_drift_has_its_principal_point_where_it_says():
    lens = Lens(size_px=(1280, 720), pp_px=np.array([640.0, 350.0]), c0=0.03, c1=-0.01, k2=-0.02,
                pp_drift_px=np.array([10.0, -6.0]), pp_log_f=float(np.log(1800)))  # fmt: skip
    log_f = np.log([1800.0, 1800 * np.e])
    np.testing.assert_allclose(lens.pp(log_f), [[640, 350], [650, 344]])
    np.testing.assert_allclose(lens.K(log_f)[:, :2, 2], lens.pp(log_f))
    ideal = np.array([[200.0, 100.0], [1200.0, 650.0]])
    np.testing.assert_allclose(lens.undistort(lens.distort(ideal, log_f), log_f), ideal, atol=1e-8)
    np.testing.assert_allclose(lens.distort(lens.pp(log_f), log_f), lens.pp(log_f))
    # The unknowns with the principal point at another log f are the same lens.
    other = lens.shared(float(np.log(2500)))
    np.testing.assert_allclose(other[:2] + other[6:] * (log_f[1] - np.log(2500)), lens.pp(log_f[1]))
    assert serial.from_plain(Lens, serial.to_plain(lens)).k2 == lens.k2


def test_predicted_edges_are_those_of_the_lens():
    truth, graph = make(1, k2=-0.03, drift=(15.0, -10.0), pan_deg=30, f_w=0.8, zoom=1.5, smooth_px=0.0)
    lens, packed = truth.lens, pack(graph)
    state = State(truth.log_f[None], truth.R[None], lens.shared(packed.log_f_pp)[None])
    rx, ry, _ = residuals(packed, state)
    assert 0.08 < rms(np.stack([rx, ry])[:, 0][:, packed.dof > 0]) < 0.12  # the noise, .1 px


def test_a_second_coefficient_is_found_and_its_bias_taken_out():
    for k2, bias in ((-0.03, 0.025), (0.03, 0.012)):
        with_it, without = [], []
        for seed in (0, 1):
            truth, graph = make(seed, k2=k2, pan_deg=30, f_w=0.8, zoom=1.3)
            found = refine(graph, priors=WITH_K2)
            assert found.converged and found.lens.k2 == pytest.approx(k2, abs=4 * found.lens_std["k2"] + 2e-4)
            assert np.std(found.log_f - truth.log_f) < 5e-4
            with_it.append(common_error(found, truth))
            usual = refine(graph)
            assert usual.chi2_dof > 5 * found.chi2_dof and "k2" not in usual.lens_std
            without.append(common_error(usual, truth))
        assert rms(with_it) < 0.005 and rms(without) > bias


def test_a_drift_of_the_principal_point_is_found_and_its_bias_taken_out():
    with_it, without = [], []
    for seed in (0, 1, 2, 3):
        truth, graph = make(seed, drift=(30.0, -30.0), pan_deg=25, f_w=1.2, zoom=2.0)
        found = refine(graph, priors=WITH_DRIFT)
        assert found.converged
        std = np.array([found.lens_std["pp_drift_x"], found.lens_std["pp_drift_y"]])
        assert (np.abs(found.lens.pp_drift_px - (30, -30)) < 4 * std).all() and (std < 6).all()
        assert found.lens.pp_log_f == pytest.approx(np.mean(found.log_f), abs=0.05)
        with_it.append(common_error(found, truth))
        without.append(common_error(refine(graph), truth))
    assert rms(with_it) < 0.008 and rms(without) > 2 * rms(with_it)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("priors", "lens", "names"),
    [(WITH_K2, {"k2": -0.02}, ("k2",)), (WITH_DRIFT, {"drift": (12.0, -16.0)}, ("pp_drift_x", "pp_drift_y"))],
)
def test_error_bars_hold(priors, lens, names):
    z, z_lens = [], []
    for seed in range(24):
        truth, graph = make(100 + seed, pan_deg=25, f_w=0.9, zoom=1.7, **lens)
        found = refine(graph, priors=priors)
        z.append(common_error(found, truth) / found.sigma_mean_log_f)
        values = {
            "k2": found.lens.k2,
            "pp_drift_x": found.lens.pp_drift_px[0],
            "pp_drift_y": found.lens.pp_drift_px[1],
        }
        real = {
            "k2": truth.lens.k2,
            "pp_drift_x": truth.lens.pp_drift_px[0],
            "pp_drift_y": truth.lens.pp_drift_px[1],
        }
        z_lens += [(values[k] - real[k]) / found.lens_std[k] for k in names]
    for values in (np.abs(z), np.abs(z_lens)):
        # Of 24 independent draws: .68 +- .095 and .95 +- .045, three deviations and one draw.
        assert 0.35 < np.mean(values < 1) < 0.98 and np.mean(values < 2) > 0.78
        assert 0.5 < rms(values) < 1.6


def test_where_the_lens_has_neither_the_option_costs_little():
    errors = []
    for seed in (0, 1, 2):
        truth, graph = make(seed, pan_deg=30, f_w=0.8, zoom=1.6)
        wide = refine(graph, priors=Priors(k2_std=0.02, pp_drift_std=10 / 1280))
        usual = refine(graph)
        assert wide.sigma_mean_log_f < 2 * usual.sigma_mean_log_f
        assert abs(wide.lens.k2) < 5 * wide.lens_std["k2"]
        errors.append(common_error(wide, truth))
    assert rms(errors) < 0.007


def test_what_is_known_of_a_lens_is_held():
    truth, graph = make(2, k2=-0.03, pan_deg=30, f_w=0.8, zoom=1.3)
    found = refine(graph, priors=Priors(k2_mean=-0.03))
    assert found.lens.k2 == -0.03 and found.lens_std["k2"] == 0.0
    assert abs(common_error(found, truth)) < 0.005
    fixed = refine(
        graph, priors=Priors(k2_mean=-0.03, pp_drift_std=0.01), options=RefineOptions(free_pp=False)
    )
    assert fixed.lens_std["pp_drift_x"] == 0.0 and not fixed.lens.pp_drift_px.any()


def test_sparse_equals_dense_with_all_unknowns(monkeypatch):
    _, graph = make(17, n=9, k2=-0.02, drift=(10.0, -10.0), pan_deg=25, f_w=0.9, zoom=1.6)
    priors = Priors(k2_std=0.02, pp_drift_std=0.01, aspect_std=0.002)
    dense = refine(graph, priors=priors)
    dense = refine(graph, start=dense, priors=priors)  # both with the principal point given at the same log f
    monkeypatch.setattr(solver, "DENSE_BELOW", 0)
    sparse = refine(graph, start=dense, priors=priors)
    np.testing.assert_allclose(sparse.log_f, dense.log_f, atol=5e-6)
    np.testing.assert_allclose(sparse.sigma_log_f, dense.sigma_log_f, rtol=2e-4)
    assert sparse.lens.k2 == pytest.approx(dense.lens.k2, abs=1e-6)
    assert sparse.lens_std == pytest.approx(dense.lens_std, rel=2e-3)
    assert len(sparse.lens_std) == 8


def test_assembled_step_and_covariance_equal_a_dense_solve():
    truth, graph = make(18, n=5, k2=-0.02, drift=(10.0, -10.0), pan_deg=15, zoom=1.5)
    packed = replace(pack(graph), log_f_pp=truth.lens.pp_log_f)
    state = State(truth.log_f[None], truth.R[None], truth.lens.shared(packed.log_f_pp)[None])
    free = np.array([True, True, False, True, True, True, True, True])
    priors = PriorTerms(Priors(k2_std=0.02, pp_drift_std=0.01), graph.size_px, graph.frames, free)
    layout = solver.Layout(packed, 0, free)
    equations = solver.NormalEquations(
        layout, priors, state, linearise(packed, state, Loss("huber", np.ones(1), 1e9))
    )
    rx, ry, J = residuals(packed, state, jacobian=True)
    rows, right = [], []
    for e, i in zip(*np.nonzero(packed.dof), strict=True):
        for axis, r in ((0, rx), (1, ry)):
            row = np.zeros(layout.size)
            np.add.at(row, layout.columns[e], J[0, e, :, axis, i])
            rows.append(row * 10)  # information 100 px^-2
            right.append(r[0, e, i] * 10)
    std = [10.0, 25.0, 1.0, 0.05, 0.05, 0.02, 12.8, 12.8]  # px at W = 1280
    mean = [639.5, 359.5, 0, 0, 0, 0, 0, 0]
    for k in np.flatnonzero(free):
        row = np.zeros(layout.size)
        row[20 + k] = 1 / std[k]
        rows.append(row)
        right.append((mean[k] - state.shared[0, k]) / std[k])
    row = np.zeros(layout.size)
    row[0:20:4] = 0.2 / 0.7
    rows.append(row)
    right.append((np.log(1.3 * 1280) - truth.log_f.mean()) / 0.7)
    A = np.array(rows)[:, layout.active]
    step = np.zeros(layout.size)
    step[layout.active] = np.linalg.lstsq(A, np.array(right), rcond=None)[0]
    np.testing.assert_allclose(equations.solve(0, 0.0), step, rtol=1e-6, atol=1e-9)
    cov = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(
        equations.covariance()[np.ix_(layout.active, layout.active)], cov, rtol=1e-6, atol=1e-14
    )


def test_frames_between_judgement_and_profile_use_the_same_lens(tmp_path):
    truth, graph = make(3, n=9, k2=-0.03, drift=(15.0, -10.0), pan_deg=30, f_w=0.8, zoom=1.6)
    priors = Priors(k2_std=0.02, pp_drift_std=20 / 1280)
    keys = refine(graph.subgraph(graph.frames[::2]), priors=priors)
    track = solve_poses(graph, keys)
    error = track.log_f - truth.log_f
    assert abs(error.mean()) < 0.006 and error.std() < 5e-4
    np.testing.assert_allclose(track.lens.pp_drift_px, keys.lens.pp_drift_px)
    whole = refine(graph, priors=priors)
    verdict = judge(whole, graph)
    assert verdict.claims_focal and verdict.sigma_log_f_total < 0.03
    profile = lens_profile(whole)
    profile.save(tmp_path / "lens.json")
    assert LensProfile.load(tmp_path / "lens.json") == profile
    next_time = with_profile(Priors(), profile)
    assert next_time.k2_mean == whole.lens.k2 and next_time.k2_std == 0.0 and next_time.wide
    assert not with_profile(Priors(), lens_profile(refine(graph))).wide


def test_the_running_calibrator_uses_it_too():
    truth, graph = make(5, n=8, k2=-0.03, pan_deg=30, f_w=0.8, zoom=1.3)
    running = RunningCalibrator((1280, 720), priors=WITH_K2)
    for frame in truth.frames.tolist():
        running.add_keyframe(frame, [e for e in graph.edges if e.b == frame])
    assert running.ready and running.lens.k2 == pytest.approx(-0.03, abs=0.003)
    packed = pack(graph)
    assert state_of(packed, running.solution).shared.shape == (1, 8)
    again = RunningCalibrator.from_state(running.state())
    assert again.lens.k2 == running.lens.k2
