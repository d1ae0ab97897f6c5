"""The pupil in front of the pan axis: its parallax as it is, estimated, taken out, left alone where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from calib import PupilOptions, fit_pupil, refine, rotation
from calib.parallax import Parallax
from calib.problem import pack
from calib.pupil import parallax_px
from tests.calib import tracks
from tests.calib.test_refine import common_error, make

TILT0 = np.deg2rad(-8.0)  # of tracks.path
OVER_HEIGHT, OVER_STAND = 0.6 / 15, 0.6 / 95  # of tracks.parallax at .6 m


def with_pupil(truth, graph):
    rows = {f: k for k, f in enumerate(truth.frames.tolist())}
    return replace(graph, edges=tuple(
        replace(e, grid_b=e.grid_b + tracks.parallax(truth, rows[e.a], rows[e.b], e.grid_a, 0.6)) for e in graph.edges
    ))  # fmt: skip


def broadcast(seed):
    return make(
        seed, n=10, pan_deg=25 + 3 * seed, zoom=1.4, f_w=1.3 + 0.1 * seed, c0=0.05, c1=-0.018, roll_deg=0.0
    )


def test_the_displacement_is_that_of_a_scene_built_point_by_point():
    truth, graph = broadcast(0)
    solution = replace(refine(graph), log_f=truth.log_f, R=truth.R, lens=truth.lens)
    R_head_world = rotation.from_pan_tilt_roll(0.0, TILT0, 0.0).T
    scene = Parallax(over_height=OVER_HEIGHT, over_stand=OVER_STAND, R_head_world=R_head_world)
    shift = parallax_px(pack(graph), solution, scene)
    rows = {f: k for k, f in enumerate(truth.frames.tolist())}
    largest = 0.0
    for k, e in enumerate(graph.edges):
        expected = tracks.parallax(truth, rows[e.a], rows[e.b], e.grid_a, 0.6)
        np.testing.assert_allclose(shift[k, : len(expected)], expected, atol=1e-6)
        largest = max(largest, float(np.abs(expected).max()))
    assert largest > 1.0  # real-footage.md 5: a pixel and more


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_pupil_is_found_and_its_bias_of_the_focal_taken_out(seed):
    truth, graph = broadcast(seed)
    parallax = with_pupil(truth, graph)
    solution = refine(parallax)
    found = fit_pupil(parallax, solution)
    assert found.accepted, found.reason
    before, after = common_error(solution, truth), common_error(found.solution, truth)
    assert abs(before) > 0.035 and abs(after) < 0.015
    assert abs(found.over_height - OVER_HEIGHT) < 4 * found.over_height_std + 0.1 * OVER_HEIGHT
    assert found.solution.chi2_dof < solution.chi2_dof
    assert len(found.graph.edges) == len(parallax.edges)


def test_without_a_pupil_nothing_is_taken_out():
    _, graph = broadcast(1)
    solution = refine(graph)
    found = fit_pupil(graph, solution)
    assert not found.accepted and found.reason == "not_significant"
    assert found.solution is solution and found.graph is graph
    assert abs(found.over_height) < 0.3 * OVER_HEIGHT


def test_without_the_head_axis_nothing_is_done():
    _, graph = make(3, n=8, pan_deg=0.0, tilt_deg=8.0, f_w=1.2, roll_deg=0.0)
    solution = refine(graph)
    found = fit_pupil(graph, solution, PupilOptions())
    assert not found.accepted and found.reason in ("head_axis_unknown", "not_converged")
    with pytest.raises(ValueError):
        fit_pupil(replace(graph, edges=graph.edges[:-1]), solution)
