"""Rotations, camera, distortion, homographies: signs, round trips, Jacobians against central differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib import camera, distortion, dlt, homography, rotation
from calib.records import Lens

angle = st.floats(-1.4, 1.4)


def test_pan_right_moves_the_old_centre_left():
    assert (rotation.from_pan_tilt_roll(0.1, 0, 0) @ [0, 0, 1])[0] < 0


def test_tilt_up_moves_the_old_centre_down():
    assert (rotation.from_pan_tilt_roll(0, 0.1, 0) @ [0, 0, 1])[1] > 0


def test_roll_clockwise_turns_the_picture_counter_clockwise():
    assert (rotation.from_pan_tilt_roll(0, 0, 0.1) @ [1, 0, 1])[1] < 0


def test_euler_factors_are_those_of_the_conventions():
    c, s = np.cos(-0.2), np.sin(-0.2)
    Rx = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    np.testing.assert_allclose(rotation.from_pan_tilt_roll(0, 0.2, 0), Rx, atol=1e-15)
    Ry = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    np.testing.assert_allclose(rotation.from_pan_tilt_roll(0.2, 0, 0), Ry, atol=1e-15)
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(rotation.from_pan_tilt_roll(0, 0, 0.2), Rz, atol=1e-15)
    np.testing.assert_allclose(rotation.from_pan_tilt_roll(0.2, 0.2, 0.2), Rz @ Rx @ Ry, atol=1e-15)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.floats(-3.1, 3.1), angle, st.floats(-3.1, 3.1))
def test_pan_tilt_roll_round_trip(pan, tilt, roll):
    back = rotation.to_pan_tilt_roll(rotation.from_pan_tilt_roll(pan, tilt, roll))
    np.testing.assert_allclose(back, (pan, tilt, roll), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-7, 1e-4, 0.3, 3.0, np.pi - 1e-3, np.pi - 1e-7])
def test_exp_and_log_are_inverse(size):
    rng = np.random.default_rng(1)
    axes = rng.standard_normal((20, 3))
    w = size * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = rotation.exp(w)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-13)
    np.testing.assert_allclose(rotation.log(R), w, atol=1e-8 if size > 3 else 1e-12)


def test_projection_gives_the_nearest_rotation():
    rng = np.random.default_rng(2)
    R = rotation.exp(rng.standard_normal((10, 3)))
    noisy = R + 1e-3 * rng.standard_normal(R.shape)
    P = rotation.project_so3(noisy)
    np.testing.assert_allclose(np.linalg.det(P), 1, atol=1e-12)
    assert np.all(np.linalg.norm(P - noisy, axis=(1, 2)) <= np.linalg.norm(R - noisy, axis=(1, 2)) + 1e-12)
    assert np.isnan(rotation.project_so3(np.full((3, 3), np.nan))).all()


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.floats(-0.2, 0.15), st.floats(-0.02, 0.02))
def test_distortion_round_trip_up_to_the_corner(k1, k2):
    points = np.array([[0, 0], [1279, 719], [640, 360], [639.5, 359.5], [0, 719], [1000.3, 20.7]], float)
    ideal = distortion.undistort(points, (639.5, 359.5), k1, 1280, k2)
    seen = np.isfinite(ideal).all(1)
    back = distortion.distort(ideal[seen], (639.5, 359.5), k1, 1280, k2)
    np.testing.assert_allclose(back, points[seen], atol=1e-7)
    assert seen.all() or not distortion.is_invertible(k1 - 0.08, (1280, 720), k2 - 0.03)


def test_folding_distortion_is_nan_not_a_point():
    assert np.isnan(distortion.undistort(np.array([[0.0, 0.0]]), (639.5, 359.5), -0.4, 1280)).all()
    assert not distortion.is_invertible(-0.26, (1280, 720))
    assert distortion.is_invertible(-0.24, (1280, 720))


def test_opencv_coefficient_is_the_same_curve():
    f, W, k1 = 2100.0, 1280, 0.03
    k1_cv = distortion.k1_to_opencv(k1, f, W)
    x = np.array([0.21, -0.1])
    observed = (639.5, 359.5) + f * x * (1 + k1_cv * (x @ x))
    np.testing.assert_allclose(
        distortion.distort((639.5, 359.5) + f * x, (639.5, 359.5), k1, W), observed, atol=1e-9
    )
    assert distortion.k1_from_opencv(k1_cv, f, W) == pytest.approx(k1)
    lens = Lens(size_px=(W, 720), pp_px=(639.5, 359.5), c0=0.04, c1=-0.01)
    assert lens.k1_opencv(np.log(f)) == pytest.approx(float(lens.k1_half(np.log(f))) * (2 * f / W) ** 2)


def test_homography_gauge_inverse_and_anchors():
    rng = np.random.default_rng(3)
    H = np.eye(3) + 0.2 * rng.standard_normal((5, 3, 3)) * np.array(
        [[1, 1, 100], [1, 1, 100], [1e-4, 1e-4, 1]]
    )
    for scale in (2.0, -3.0, 1e-4):
        np.testing.assert_allclose(np.linalg.det(homography.normalise(scale * H)), 1, rtol=1e-9)
        np.testing.assert_allclose(homography.normalise(scale * H), homography.normalise(H), rtol=1e-9)
    points = np.array([[100, 100], [900, 120], [880, 600], [130, 560]], float)
    H = homography.normalise(H)
    there = homography.apply(H, points)
    np.testing.assert_allclose(
        homography.apply(homography.invert(H), there), np.broadcast_to(points, there.shape), atol=1e-6
    )
    np.testing.assert_allclose(homography.from_anchors(points, there), H, rtol=1e-6, atol=1e-9)
    assert np.isnan(homography.normalise(np.zeros((3, 3)))).all()


def test_infinite_homography_cancels_indices():
    lens = Lens(size_px=(1280, 720), pp_px=(650, 340))
    K = lens.K(np.log([1500.0, 2000.0, 2500.0]))
    R = rotation.exp(np.array([[0, 0, 0], [0.05, 0.2, 0.01], [0.1, -0.1, 0.0]]))
    H_b_a = camera.infinite_homography(K[1], K[0], R[1] @ R[0].T)
    H_c_b = camera.infinite_homography(K[2], K[1], R[2] @ R[1].T)
    H_c_a = camera.infinite_homography(K[2], K[0], R[2] @ R[0].T)
    np.testing.assert_allclose(homography.normalise(H_c_b @ H_b_a), H_c_a, atol=1e-9)
    assert np.isnan(camera.infinite_homography(np.full((3, 3), np.nan), K[0], R[0])).all()
    with pytest.raises(ValueError):
        camera.infinite_homography(np.zeros((2, 3, 3)), np.zeros((3, 3, 3)), R[0])


@pytest.mark.parametrize("angle_rad", [1e-7, 0.05, 0.4])
@pytest.mark.parametrize("k1", [-0.04, 0.0, 0.05])
def test_transfer_jacobian_equals_central_differences(angle_rad, k1):
    rng = np.random.default_rng(4)
    axis = np.array([0.3, 0.9, 0.1])
    Ra = rotation.exp(0.05 * rng.standard_normal(3))
    Rb = rotation.exp(angle_rad * axis / np.linalg.norm(axis)) @ Ra
    x, y = rng.uniform(500, 900, 7), rng.uniform(200, 500, 7)
    shared = np.array([650.0, 350.0, 0.02, k1, -0.02])

    def predict(p, jacobian=False):
        A, B = rotation.exp(p[1:4]) @ Ra, rotation.exp(p[5:8]) @ Rb
        return camera.transfer(
            x, y, np.log(1800) + p[0], np.log(2100) + p[4], B @ A.T, shared + p[8:], 1280, jacobian=jacobian
        )

    J = predict(np.zeros(13), jacobian=True).J
    step = np.array([1e-5] * 8 + [1e-3, 1e-3, 1e-5, 1e-5, 1e-5])
    for k in range(13):
        d = np.zeros(13)
        d[k] = step[k]
        plus, minus = predict(d), predict(-d)
        numeric = np.stack([plus.x - minus.x, plus.y - minus.y]) / (2 * step[k])
        np.testing.assert_allclose(J[k], numeric, rtol=2e-6, atol=2e-6 * max(1.0, np.abs(numeric).max()))
    assert predict(np.zeros(13)).J is None
    pose = camera.transfer(x, y, np.log(1800), np.log(2100), Rb @ Ra.T, shared, 1280, pose_only=True).J
    np.testing.assert_array_equal(pose, J[:8])


def test_points_behind_the_camera_are_nan():
    out = camera.transfer(
        np.array([640.0]), np.array([360.0]), np.log(1500.0), np.log(1500.0), rotation.exp([0, 2.0, 0]),
        np.array([639.5, 359.5, 0, 0, 0]), 1280,
    )  # fmt: skip
    assert np.isnan(out.x).all()


@pytest.mark.parametrize("two_sided", [False, True])
def test_homography_fit_is_as_good_as_its_covariance_says(two_sided):
    rng = np.random.default_rng(5)
    H = homography.normalise(np.array([[1.1, 0.05, 30], [-0.04, 1.05, -20], [1e-4, -5e-5, 1]]))
    probe = np.array([[100, 100], [1100, 100], [1100, 600], [100, 600]], float)
    J = homography.point_jacobian(H, probe).reshape(8, 9)
    values = []
    for _ in range(60):
        a = rng.uniform([0, 0], [1280, 720], (60, 2))
        b = homography.apply(H, a) + 0.5 * rng.standard_normal(a.shape)
        a_seen = a + 0.5 * rng.standard_normal(a.shape) * two_sided
        fit = dlt.fit(a_seen, b, sigma_px=0.5, two_sided=two_sided)
        assert fit.converged
        e = (homography.apply(fit.H, probe) - homography.apply(H, probe)).ravel()
        values.append(e @ np.linalg.solve(J @ fit.cov @ J.T, e))
    # chi2 with 8 degrees of freedom: mean 8, standard error 4 / sqrt(60).
    assert 8 - 4 * 0.52 < np.mean(values) < 8 + 4 * 0.52


def test_dlt_refuses_what_it_cannot_know():
    line = np.stack([np.linspace(0, 1000, 10), np.linspace(0, 500, 10)], 1)
    assert np.isnan(dlt.dlt(line, line + 3)).all()
    assert np.isnan(dlt.dlt(line[:3], line[:3])).all()
    assert not dlt.fit(line, line + 3, sigma_px=1.0).converged
    with pytest.raises(ValueError):
        dlt.fit(line, line[:4], sigma_px=1.0)


def test_root_information_squares_to_the_information():
    rng = np.random.default_rng(6)
    A = rng.standard_normal((10, 2, 2))
    info = A @ np.swapaxes(A, 1, 2)
    info[0], info[1] = 0.0, [[4, 0], [0, 0]]
    S = dlt.square_root_information(info)
    np.testing.assert_allclose(S @ S, info, atol=1e-12)
