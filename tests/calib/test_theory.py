"""The zero-skew theorem: K R K^-1 taken apart, both forms of the condition, rank, null space and the words for it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib import homography, rotation
from calib.camera import infinite_homography
from calib.camera_matrix import (
    homography_parts,
    nearest_rotation,
    orthogonality_error,
    parts,
    rotation_from_homography,
    zero_skew_residual,
)
from calib.observability import (
    common_axis,
    observability,
    zero_skew_polynomials,
    zero_skew_rows,
    zero_skew_rows_by_quaternion,
)
from calib.quaternion import from_rotation, paper_rotation, to_rotation
from tests.calib.test_gates import turns

RNG = np.random.default_rng(11)
ROTATIONS = rotation.exp(RNG.standard_normal((200, 3)) * 1.5)
GENERIC = turns((10, 5, 20), (20, -5, -30), (-10, 28, 10), (25, 12, -20))


def camera(fx=1000.0, fy=1030.0, cx=330.0, cy=230.0, skew=0.0):
    return np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])


def test_quaternions_and_matrices_are_one_rotation():
    np.testing.assert_allclose(to_rotation(from_rotation(ROTATIONS)), ROTATIONS, atol=1e-14)
    w = np.array([0.3, -0.2, 0.5])
    half = np.linalg.norm(w) / 2
    q = np.array([np.cos(half), *(np.sin(half) * w / (2 * half))])
    np.testing.assert_allclose(to_rotation(2 * q), rotation.exp(w), atol=1e-15)
    np.testing.assert_allclose(paper_rotation(q), rotation.exp(w).T, atol=1e-15)
    half_turn = rotation.exp(np.array([[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi - 1e-9]]))
    np.testing.assert_allclose(to_rotation(from_rotation(half_turn)), half_turn, atol=1e-14)
    with pytest.raises(ValueError):
        to_rotation(np.zeros(3))
    with pytest.raises(ValueError):
        from_rotation(np.zeros((3, 2)))


def test_polynomials_of_the_print_equal_the_rows_of_the_matrix():
    """calibration.md 2.3: all six columns, with the paper's R(q) and not with its transpose."""
    q = from_rotation(ROTATIONS)
    np.testing.assert_allclose(zero_skew_polynomials(q), zero_skew_rows(paper_rotation(q)), atol=1e-14)
    np.testing.assert_allclose(zero_skew_rows_by_quaternion(ROTATIONS), zero_skew_rows(ROTATIONS), atol=1e-14)
    wrong = np.abs(zero_skew_polynomials(q) - zero_skew_rows(to_rotation(q))).max(0)
    assert wrong[1] < 1e-14 and np.all(np.delete(wrong, 1) > 0.1)


def test_skew_is_what_the_condition_measures():
    P = camera() @ ROTATIONS
    np.testing.assert_allclose(zero_skew_residual(P), 0, atol=1e-12)
    skewed = zero_skew_residual(-2.5 * camera(skew=12.0) @ ROTATIONS)
    np.testing.assert_allclose(skewed, 12 / np.hypot(1000, 12), rtol=1e-9)


def test_a_camera_matrix_comes_apart_into_its_parts():
    K = camera(skew=3.0)
    found = parts(-7.0 * K @ ROTATIONS)
    np.testing.assert_allclose(found.K, np.broadcast_to(K, found.K.shape), rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(found.R, ROTATIONS, atol=1e-12)
    assert np.isnan(parts(np.zeros((3, 3))).K).all()
    with pytest.raises(ValueError):
        parts(np.zeros((3, 4)))


def test_a_homography_comes_apart_into_its_parts():
    K0, K1, R = camera(), camera(1500, 1545), rotation.exp(np.array([0.1, 0.2, -0.05]))
    H = infinite_homography(K1, K0, R)
    found = homography_parts(-4 * H, K0)
    np.testing.assert_allclose(found.K, K1, rtol=1e-10, atol=1e-8)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(rotation_from_homography(H, K1, K0), R, atol=1e-12)
    wrong = rotation_from_homography(H, camera(1400, 1545), K0)
    assert orthogonality_error(wrong) > 1e-3 > 1e-20 > orthogonality_error(R)
    np.testing.assert_allclose(np.linalg.det(nearest_rotation(H, camera(1400, 1545), K0)), 1, atol=1e-12)


@settings(derandomize=True, max_examples=30, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1), st.floats(0.3, 3.0))
def test_the_homography_of_swapped_frames_is_the_inverse(x, y, z, zoom):
    K0, K1, R = camera(), camera(1000 * zoom, 1030 * zoom), rotation.exp(np.array([x, y, z]))
    H = infinite_homography(K1, K0, R)
    np.testing.assert_allclose(
        homography.invert(H), infinite_homography(K0, K1, R.T), rtol=1e-9, atol=1e-9 * np.abs(H).max()
    )


@pytest.mark.parametrize(
    "rotations", [turns((10, 0, 0), (20, 0, 0)), turns((10, 5, 0), (20, -5, 0), (-8, 9, 0))]
)
def test_every_other_null_vector_is_another_camera_with_zero_skew(rotations):
    """The theorem read backwards: with (Q Q^T)^-1 = L, K R_k Q has zero skew in all views: nothing tells them apart."""
    found = observability(rotations)
    K0 = camera()
    for L in found.null_space:
        L = np.eye(3) + 0.2 * (L - L[2, 2] * np.eye(3))
        Q = np.linalg.cholesky(np.linalg.inv(L))
        other = K0 @ rotations @ Q
        np.testing.assert_allclose(zero_skew_residual(other), 0, atol=1e-12)
    moved = [parts(K0 @ np.linalg.cholesky(np.linalg.inv(np.eye(3) + 0.2 * L))).K for L in found.null_space]
    assert max(np.abs(K - K0).max() / K0.max() for K in moved) > 0.01


def test_a_generic_motion_leaves_no_other_camera():
    found = observability(GENERIC)
    assert found.rank == 5 and found.free == () and found.needed == ""
    L = found.null_space[0]
    np.testing.assert_allclose(L / L[0, 0], np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("rotations", "square", "free", "word"),
    [
        (turns((0, 0, 0)), False, {"fx", "fy", "cx", "cy"}, "must turn"),
        (turns((0, 0, 10)), True, {"fx", "fy", "cx", "cy"}, "pan or a tilt"),
        (turns((10, 0, 0), (20, 0, 0)), False, {"fx", "fy", "cx"}, "tilt"),
        (turns((0, 10, 0), (0, 20, 0)), False, {"fx", "fy", "cy"}, "pan"),
        (turns((10, 5, 0), (20, -5, 0), (-10, 8, 0)), False, {"fy"}, "Roll"),
        (turns((10, 0, 0)), True, {"fx", "fy", "cx"}, "third view"),
        (turns((10, 0, 0), (20, 0, 0)), True, set(), ""),
    ],
)
def test_the_verdict_names_what_stays_free_and_the_motion_that_would_fix_it(rotations, square, free, word):
    found = observability(rotations, square_pixels=square)
    assert set(found.free) == free
    assert word in found.needed and bool(found.needed) == bool(free)


def test_a_common_axis_is_found_and_different_ones_are_not():
    np.testing.assert_allclose(np.abs(common_axis(turns((10, 0, 0), (-20, 0, 0)))), [0, 1, 0], atol=1e-12)
    assert np.isnan(common_axis(turns((10, 0, 0), (0, 10, 0)))).all()
    assert np.isnan(common_axis(turns((0, 0, 0)))).all()
