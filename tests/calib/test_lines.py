"""Lines known to be straight: their term is what it says, and they fix the valley between focal length and k1."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib import Priors, StraightLine, fit_lines, judge, refine, serial, solver
from calib.lines import bow, line_term
from tests.calib import tracks


def seen_line(rng, truth, row, a, b, noise_px, n=25):
    """A line between two ideal points, as frame `row` of a track shows it."""
    raw = truth.lens.distort(np.linspace(a, b, n), truth.log_f[row]) + noise_px * rng.standard_normal((n, 2))
    return StraightLine(frame=int(truth.frames[row]), points_px=raw, sigma_px=noise_px)


def make(seed, n=8, *, pan_deg=8, noise_px=0.3, smooth_px=0.1, pupil_m=0.0):
    """A track, its graph, and two lines across its pictures."""
    rng = np.random.default_rng([3, seed])
    truth = tracks.path(rng, n, pan_deg=pan_deg, f_w=1.6, zoom=1.2)
    graph = tracks.graph(rng, truth, max_span=3, smooth_px=smooth_px)
    if pupil_m:
        rows = {frame: k for k, frame in enumerate(truth.frames.tolist())}
        moved = [tracks.parallax(truth, rows[e.a], rows[e.b], e.grid_a, pupil_m) for e in graph.edges]
        pairs = zip(graph.edges, moved, strict=True)
        graph = replace(graph, edges=tuple(replace(e, grid_b=e.grid_b + shift) for e, shift in pairs))
    lines = (
        seen_line(rng, truth, 1, (30.0, 120.0), (1250.0, 60.0), noise_px),
        seen_line(rng, truth, n - 2, (40.0, 600.0), (1240.0, 660.0), noise_px),
    )
    return truth, graph, lines


def common_error(solution, truth):
    return float(np.mean(solution.log_f - truth.log_f))


@pytest.mark.parametrize(
    "shared", [[650, 350, 0.02, 0.05, -0.02], [650, 350, 0.02, 0.04, -0.02, -0.03, 12, -25]]
)
def test_the_term_has_its_derivatives(shared):
    rng = np.random.default_rng(0)
    x = np.linspace(100, 1200, 12)
    points = np.column_stack([x, 150 + 0.1 * x])
    shared, log_f = np.array([shared], float), np.array([np.log(1800.0)])
    step = np.array([1e-5, 1e-3, 1e-3, 1e-5, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3])[: shared.shape[1] + 1]

    def moved(k, sign):
        d = np.zeros(len(step))
        d[k] = sign * step[k]
        return log_f + d[0], shared + d[1:]

    noisy = StraightLine(frame=0, points_px=points + rng.normal(0, 1, (12, 2)), sigma_px=0.5)
    term = line_term(noisy, log_f, shared, 1280, np.log(1500))
    # Points that the lens at hand makes straight: there the derivative is exact, elsewhere to first order in the bow.
    lens = tracks.Lens(size_px=(1280, 720), pp_px=shared[0, :2] if shared.shape[1] == 5 else
                       shared[0, :2] + shared[0, 6:8] * (log_f[0] - np.log(1500)), c0=shared[0, 3], c1=shared[0, 4],
                       k2=shared[0, 5] if shared.shape[1] > 5 else 0.0)  # fmt: skip
    straight = lens.distort(points, log_f[0])
    residual, J = bow(straight, log_f, shared, 1280, np.log(1500))
    assert np.abs(residual).max() < 1e-7
    for k in range(len(step)):
        plus, minus = (moved(k, sign) for sign in (1, -1))
        costs = [line_term(noisy, *m, 1280, np.log(1500)).cost[0] for m in (plus, minus)]
        # gradient = J^T W (measured less predicted): half the cost's slope, the other way.
        slope = (costs[0] - costs[1]) / (2 * step[k])
        assert -2 * term.gradient[0, k] == pytest.approx(
            slope, rel=1e-5, abs=1e-6 * abs(term.cost[0]) / step[k]
        )
        bows = [bow(straight, *m, 1280, np.log(1500))[0][0] for m in (plus, minus)]
        sign = np.sign(bows[0] @ J[0, k]) or 1.0  # the normal of a line without a bow may point either way
        numeric = (sign * bows[0] - (np.sign(bows[1] @ -J[0, k]) or 1.0) * bows[1]) / (2 * step[k])
        np.testing.assert_allclose(J[0, k], numeric, rtol=1e-4, atol=1e-4 * max(1e-3, np.abs(numeric).max()))


def test_where_the_line_lies_does_not_matter():
    rng = np.random.default_rng(1)
    truth = tracks.path(rng, 3, pan_deg=10)
    points = seen_line(rng, truth, 0, (50.0, 100.0), (1200.0, 300.0), 0.3).points_px
    shared = truth.lens.shared(0.0)[None]
    here, _ = bow(points, truth.log_f[:1], shared, 1280, 0.0)
    turned, _ = bow(points[::-1], truth.log_f[:1], shared, 1280, 0.0)
    np.testing.assert_allclose(np.abs(turned[0, ::-1]), np.abs(here[0]), atol=1e-9)
    assert 0.1 < np.sqrt(np.mean(here**2)) < 0.5  # the noise alone
    wrong = shared + np.array([0, 0, 0, 0.03, 0])
    assert np.sqrt(np.mean(bow(points, truth.log_f[:1], wrong, 1280, 0.0)[0] ** 2)) > 0.8
    folded = StraightLine(frame=0, points_px=points * 40)
    assert line_term(folded, truth.log_f[:1], shared - 0.2, 1280, 0.0).cost == np.inf


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_precise_lines_sharpen_the_focal_length():
    plain, helped = [], []
    for seed in range(4):
        truth, graph, lines = make(seed, noise_px=0.1, smooth_px=0.0)
        without, found = refine(graph), refine(graph, priors=Priors(straight_lines=lines))
        assert found.converged
        plain.append((common_error(without, truth), without.sigma_mean_log_f))
        helped.append((common_error(found, truth), found.sigma_mean_log_f))
    (e0, s0), (e1, s1) = np.transpose(plain), np.transpose(helped)
    assert rms(e1) < 0.8 * rms(e0) and rms(s1) < 0.8 * rms(s0)
    assert (np.abs(e1) < 3 * s1).all()


@pytest.mark.slow
def test_lines_hold_the_lens_where_parallax_pulls_it():
    """A pupil .6 m before the pan axis is in every edge; two lines of .3 px know better what the lens does."""
    plain, helped, total = [], [], []
    for seed in range(8):
        truth, graph, lines = make(seed, pan_deg=30, pupil_m=0.6, noise_px=0.3)
        found = fit_lines(graph, lines)
        assert found.priors.straight_lines[0].weight > 10
        plain.append(common_error(refine(graph), truth))
        helped.append((common_error(found, truth), found.sigma_mean_log_f))
        total.append(judge(found, graph).sigma_log_f_total)
    error, sigma = np.transpose(helped)
    assert rms(plain) > 0.04 and rms(error) < 0.4 * rms(plain)
    assert (np.abs(error) < 2 * np.array(total)).all() and 0.4 < rms(error / sigma) < 2.0


def test_without_anything_to_calibrate_lines_change_nothing():
    _, graph, lines = make(0)
    still = replace(graph, edges=tuple(replace(e, grid_b=e.grid_a) for e in graph.edges))
    found = fit_lines(still, lines)
    assert not judge(found, still).claims_focal
    nothing = fit_lines(replace(graph, edges=()), lines)
    assert not nothing.converged and nothing.stop == "no_edges"


def test_lines_of_other_frames_do_not_count_and_lines_are_saved():
    _, graph, lines = make(0)
    priors = Priors(straight_lines=lines)
    elsewhere = Priors(straight_lines=(replace(lines[0], frame=12345),))
    np.testing.assert_array_equal(refine(graph, priors=elsewhere).log_f, refine(graph).log_f)
    again = serial.from_plain(Priors, json.loads(json.dumps(serial.to_plain(priors))))
    np.testing.assert_array_equal(again.straight_lines[0].points_px, lines[0].points_px)


def test_sparse_equals_dense(monkeypatch):
    _, graph, lines = make(2)
    priors = Priors(straight_lines=lines)
    dense = refine(graph, priors=priors)
    monkeypatch.setattr(solver, "DENSE_BELOW", 0)
    sparse = refine(graph, start=dense, priors=priors)
    np.testing.assert_allclose(sparse.log_f, dense.log_f, atol=5e-6)
    np.testing.assert_allclose(sparse.sigma_log_f, dense.sigma_log_f, rtol=2e-4)
    assert sparse.lens_std == pytest.approx(dense.lens_std, rel=2e-3)


def test_a_line_needs_three_points_and_an_error():
    with pytest.raises(ValueError, match="three"):
        StraightLine(frame=0, points_px=np.zeros((2, 2)))
    with pytest.raises(ValueError, match="sigma"):
        StraightLine(frame=0, points_px=np.zeros((3, 2)), sigma_px=0.0)
