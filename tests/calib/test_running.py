"""The running calibrator against the batch result, its motion model, gaps, and its saved state."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib import HomographyGraph, RunningCalibrator, RunningOptions, refine, rotation
from tests.calib import tracks


def run(seed=0, n=81, step=10, pan_deg=20, zoom=1.5, options=None, **kw):
    rng = np.random.default_rng(seed)
    truth = tracks.path(rng, n, pan_deg=pan_deg, zoom=zoom, roll_deg=0.0, **kw)
    truth = replace(truth, frames=np.arange(n))
    cal = RunningCalibrator((1280, 720), options=options)
    keys, edges, estimates = [], [], []
    for t in range(n):
        if t % step == 0:
            new = [tracks.edge(rng, truth, k, t, smooth_px=0.05) for k in keys[-3:]]
            new = [e for e in new if e is not None]
            estimates.append(cal.add_keyframe(t, new))
            keys.append(t)
            edges += new
        else:
            pair = [
                tracks.edge(rng, truth, keys[-1], t, smooth_px=0.05),
                tracks.edge(rng, truth, t - 1, t, smooth_px=0.05),
            ]
            estimates.append(cal.update(t, pair))
    return (
        truth,
        cal,
        HomographyGraph(frames=np.array(keys), edges=tuple(edges), size_px=(1280, 720)),
        estimates,
    )


@pytest.fixture(scope="module")
def short():
    return run()


def test_running_ends_at_the_batch_result(short):
    _truth, cal, graph, estimates = short
    batch = refine(graph)
    assert abs(estimates[-1].log_f - batch.log_f[-1]) < 1e-3
    assert abs(estimates[-1].log_f - batch.log_f[-1]) < estimates[-1].sigma_log_f
    assert cal.ready and estimates[-1].status == "ok"
    assert cal.solution.s10_px == pytest.approx(batch.s10_px, rel=0.02)


def test_running_says_when_it_does_not_know(short):
    truth, _cal, _graph, estimates = short
    assert estimates[0].status == "relative" and not estimates[0].ready and estimates[0].sigma_log_f == np.inf
    first = next(k for k, e in enumerate(estimates) if e.ready)
    assert first > 3
    for e, true in zip(estimates[first:], truth.log_f[first:], strict=True):
        if e.ready:
            assert abs(e.log_f - true) < 2.5 * e.sigma_log_f


def test_relative_zoom_is_good_from_the_start(short):
    truth, _cal, _graph, estimates = short
    late = [k for k in range(40, len(estimates))]
    zoom = np.array([estimates[k].log_f for k in late]) - np.array([truth.log_f[k] for k in late])
    assert np.std(zoom - np.polyval(np.polyfit(late, zoom, 1), late)) < 1e-3


def test_still_camera_never_becomes_ready():
    _, _cal, _, estimates = run(n=21, step=10, pan_deg=0, tilt_deg=0, zoom=1.0)
    assert not any(e.ready for e in estimates)
    assert all(e.reason == "not_ready" for e in estimates)


def test_saved_state_goes_on_to_the_same_numbers(short):
    truth, cal, _graph, _ = short
    text = json.dumps(cal.state())
    again = RunningCalibrator.from_state(json.loads(text))
    assert json.dumps(again.state()) == text
    rng = np.random.default_rng(9)
    edge = tracks.edge(rng, truth, 70, 75)
    a, b = cal.update(75, [edge]), again.update(75, [edge])
    assert a.log_f == b.log_f and np.array_equal(a.R, b.R) and a.sigma_log_f == b.sigma_log_f


def test_prediction_is_constant_velocity_of_consecutive_frames():
    rng = np.random.default_rng(3)
    truth, cal, _graph, _ = run(seed=3, n=44)
    predicted = cal.predict(44)
    assert predicted.status == "predicted"
    step = predicted.R @ cal.pose(43)[1].T
    # .1 px of noise at f = 2000 px, two frames: .005 degrees; pan and tilt speed change by less in a frame.
    assert rotation.angle_between(step, truth.R[43] @ truth.R[42].T) < np.deg2rad(0.02)
    # A keyframe correction (here: the keyframe's pose is moved by hand) must not become a velocity.
    before = cal.predict(45).R @ cal.pose(43)[1].T
    cal.update(44, [tracks.edge(rng, replace(truth, frames=truth.frames), 43, 43 - 1)])  # no edge to frame 44
    assert np.allclose(cal.predict(45).R @ cal.pose(43)[1].T, before)


def test_gap_and_recovery():
    truth, cal, _graph, _ = run(seed=4, n=41)
    lost = cal.update(41, [])
    assert lost.status == "lost" and lost.reason == "no_edges" and np.isnan(lost.log_f)
    assert cal.predict(42).status == "predicted"
    rng = np.random.default_rng(0)
    edge = tracks.edge(rng, truth, 40, 35)
    swapped = replace(edge, b=43)
    back = cal.update(43, [swapped])  # content of frame 35, numbered 43
    assert back.status in ("ok", "relative")
    assert back.log_f == pytest.approx(truth.log_f[35] + cal.pose(40)[0] - truth.log_f[40], abs=1e-3)


def test_contradicting_measurements_are_refused():
    truth, cal, _graph, _ = run(seed=5, n=31)
    rng = np.random.default_rng(0)
    edge = tracks.edge(rng, truth, 20, 29)
    scrambled = replace(edge, b=31, grid_b=rng.permutation(edge.grid_b))
    assert cal.update(31, [scrambled]).reason == "diverged"


def test_a_window_keeps_the_world_and_the_work_bounded():
    truth, cal, _graph, estimates = run(
        n=121, step=6, pan_deg=40, zoom=1.3, options=RunningOptions(window=8, linked=3)
    )
    assert len(cal.solution.frames) <= 8
    assert np.array_equal(cal.pose(0)[1], np.eye(3))
    assert abs(estimates[-1].log_f - truth.log_f[-1]) < 0.05
    turned = rotation.angle_between(estimates[0].R, estimates[-1].R)
    true = rotation.angle_between(truth.R[0], truth.R[-1])
    assert turned == pytest.approx(float(true), rel=0.05)


def test_foreign_edges_are_a_mistake():
    truth, cal, _graph, _ = run(seed=6, n=11)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError):
        cal.add_keyframe(11, [tracks.edge(rng, truth, 3, 5)])
    with pytest.raises(ValueError):
        cal.add_keyframe(0, [])
    with pytest.raises(ValueError):
        RunningCalibrator((1280, 720)).predict(0)


def test_memory_is_bounded_and_the_world_stays_when_old_keyframes_are_forgotten():
    options = RunningOptions(window=6, linked=2, max_keyframes=9, cold_at=(2, 3))
    truth, cal, _, estimates = run(n=160, step=8, pan_deg=50, options=options)
    assert len(cal.keyframes) == 9 and cal.keyframes[0] == 0 and cal.keyframes[-1] == 152
    assert set(cal.keyframes) == set(cal.state()["keyframes"]) == {f for f, *_ in cal.state()["poses"]}
    edges = cal.state()["edges"]
    assert all(e["a"] in cal.keyframes and e["b"] in cal.keyframes for e in edges)
    np.testing.assert_allclose(cal.pose(0)[1], np.eye(3), atol=1e-12)
    assert cal.pose(8) is None
    assert abs(estimates[-1].log_f - truth.log_f[-1]) < 0.02
    turn = rotation.log(estimates[-1].R @ truth.R[-1].T)
    assert np.linalg.norm(turn) < np.deg2rad(1.0)
