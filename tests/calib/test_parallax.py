"""A scene seen from the pupil and from the pan axis: against points in space, and one map undoing the other."""

import numpy as np

from calib import rotation
from calib.parallax import Parallax

OFFSET, HEIGHT, STAND = 0.6, 15.0, 95.0  # metres


def scene():
    R_head_world = rotation.from_pan_tilt_roll(0.1, -0.15, 0.02).T
    return Parallax(over_height=OFFSET / HEIGHT, over_stand=OFFSET / STAND, R_head_world=R_head_world)


def rays():
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.uniform(-0.5, 0.5, (500, 2)), np.ones((500, 1))], 1)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_the_pupil_sees_points_of_the_scene_where_they_are():
    parallax, d = scene(), rays()
    axis = rotation.from_pan_tilt_roll(0.2, -0.1, 0.0)[2]
    head = d @ parallax.R_head_world.T
    with np.errstate(divide="ignore"):
        reach = np.minimum(
            np.where(head[:, 1] > 0, HEIGHT / head[:, 1], np.inf), STAND / np.hypot(head[:, 0], head[:, 2])
        )
    assert (head[:, 1] * reach > HEIGHT - 1e-6).sum() > 50 and (head[:, 1] * reach < HEIGHT - 1).sum() > 50
    expected = d * reach[:, None] - OFFSET * axis
    seen = parallax.from_pupil(d, axis)
    np.testing.assert_allclose(np.cross(seen, expected), 0.0, atol=1e-9)
    assert np.all(np.sum(seen * expected, 1) > 0)


def test_from_axis_undoes_from_pupil():
    parallax, d = scene(), rays()
    axis = rotation.from_pan_tilt_roll(-0.3, 0.05, 0.1)[2]
    np.testing.assert_allclose(parallax.from_axis(parallax.from_pupil(d, axis), axis), d, atol=1e-12)


def test_other_axes_are_the_same_scene():
    parallax, d = scene(), rays()
    R = rotation.from_pan_tilt_roll(0.4, 0.1, -0.2)
    axis = d[7]
    turned = parallax.of_axes(R).from_pupil(d @ R.T, R @ axis)
    np.testing.assert_allclose(turned, parallax.from_pupil(d, axis) @ R.T, atol=1e-12)
