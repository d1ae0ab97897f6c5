"""Pixel conventions: points through H, level maps against the resamplers themselves, det 1, the four-anchor chart."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaic import kernel_numba, kernel_torch
from mosaic.coords import (
    anchor_information,
    default_anchors,
    fit_homography_to_flow,
    level_scale,
    normalise_homography,
    to_full,
    to_level,
    transfer,
    transfer_jacobian,
)
from mosaic.pyramid import build_pyramid
from mosaic.rescue import match_features, phase_correlation
from tests.mosaic.textures import as_uint8, corner_error_px, homography, picture

NO_MASK = (np.zeros((1, 1), np.uint8), 1.0, 1.0, False)
SIZES = [(640, 360), (481, 271), (333, 187), (1279, 97)]
few = settings(max_examples=40, deadline=None, derandomize=True, database=None)
homographies = st.builds(
    homography,
    dx=st.floats(-200, 200),
    dy=st.floats(-200, 200),
    zoom=st.floats(0.3, 3),
    roll_deg=st.floats(-180, 180),
    px=st.floats(-0.4, 0.4),
    py=st.floats(-0.4, 0.4),
)


def ramps(size_px, dtype=np.float32):
    """Pictures whose value at (x, y) is x, and y: where a resampler took a pixel from is what it shows there."""
    x, y = np.meshgrid(np.arange(size_px[0], dtype=dtype), np.arange(size_px[1], dtype=dtype))
    return x, y


# ---- points


def test_transfer_is_the_projective_map_and_nan_behind():
    H = np.array([[2.0, 0.5, 3.0], [0.1, 1.5, -2.0], [0.01, 0.0, 1.0]])
    points = np.array([[[10.0, 4.0], [-100.0, 0.0], [-200.0, 7.0]]])
    found = transfer(H, points)
    assert found.shape == points.shape
    np.testing.assert_allclose(found[0, 0], [25.0 / 1.1, 5.0 / 1.1])
    assert np.isnan(found[0, 1:]).all()  # on the line at infinity, and behind it


@few
@given(H=homographies, G=homographies)
def test_transfer_composes_and_inverts(H, G):
    points = np.array([[240.0, 135.0], [200.0, 120.0], [260.0, 160.0]])
    there = transfer(H, points)
    both = transfer(G, there)
    good = np.isfinite(both).all(axis=1)
    np.testing.assert_allclose(
        transfer(normalise_homography(G @ H), points)[good], both[good], rtol=1e-6, atol=1e-6
    )
    good = np.isfinite(there).all(axis=1)
    np.testing.assert_allclose(transfer(np.linalg.inv(H), there)[good], points[good], rtol=1e-6, atol=1e-6)


@few
@given(H=homographies, scale=st.floats(1e-3, 1e3), sign=st.sampled_from([-1.0, 1.0]))
def test_determinant_one_whatever_the_scale_and_sign(H, scale, sign):
    found = normalise_homography(sign * scale * H)
    assert np.linalg.det(found) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(found, normalise_homography(H), rtol=1e-9, atol=1e-9)


def test_a_singular_homography_has_no_such_scale():
    with np.errstate(invalid="ignore"):
        found = normalise_homography(np.stack([np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)]))
    np.testing.assert_array_equal(found[0], np.eye(3))
    assert np.isnan(found[1:]).all()


# ---- levels: each resampler on ramps


@pytest.mark.parametrize("size_px", SIZES)
@pytest.mark.parametrize("divisor", [2, 3, 8])
def test_area_resize_lies_where_level_scale_says(size_px, divisor):
    small = tuple(-(-n // divisor) for n in size_px)
    scale = level_scale(size_px, small)
    expected = to_full(np.stack(ramps(small), axis=-1), scale)
    for axis, ramp in enumerate(ramps(size_px)):
        seen = cv2.resize(ramp, small, interpolation=cv2.INTER_AREA)
        error = seen - expected[..., axis]
        # Where a cell cuts a pixel, the pixel's value counts for the part: at most 1 / (8 s) px, to either side.
        assert np.abs(error).max() < 0.125 / min(scale) + 1e-3
        assert abs(error.mean()) < 2e-3


@pytest.mark.parametrize("size_px", SIZES)
@pytest.mark.parametrize("smooth", [True, False])
def test_every_level_of_a_pyramid_lies_where_its_scale_says(size_px, smooth):
    """Half a pixel per level is a bias: the coarsest level would be 7 px off. The blur must not shift either."""
    pyramids = [build_pyramid(ramp, n_levels=4, smooth=smooth) for ramp in ramps(size_px)]
    assert pyramids[0].scales[0] == (1.0, 1.0)
    for index, scale in enumerate(pyramids[0].scales):
        h, w = pyramids[0].levels[index].shape
        expected = to_full(np.stack(ramps((w, h)), axis=-1), scale)
        for axis in (0, 1):
            # The rim of a level holds what the blur reflected at the edge.
            error = (pyramids[axis].levels[index] - expected[..., axis])[1:-1, 1:-1]
            # Cut pixels at odd sizes (see above) add up over the levels, but to a wobble, not to a bias.
            assert np.abs(error).max() < 0.01 + 0.0625 * (2**index - 1)
            assert abs(error.mean()) < 0.01


@pytest.mark.parametrize("kernel", [kernel_numba, kernel_torch], ids=["numba", "torch"])
@pytest.mark.parametrize("size_px", SIZES[:3])
def test_samplers_read_the_point_they_are_given(kernel, size_px):
    """numba's loop and torch's grid_sample (align_corners) on every level: value of a ramp = coordinate."""
    rng = np.random.default_rng(0)
    at = rng.uniform(0.15, 0.85, (200, 2)) * (np.array(size_px) - 1)
    for axis, ramp in enumerate(ramps(size_px)):
        pyramid = build_pyramid(ramp, n_levels=3)
        for level, scale in zip(pyramid.levels, pyramid.scales, strict=True):
            # 1/16 px per level at odd sizes: the pyramid's cut pixels, not the sampler's.
            atol = 0.2 if any(n % 4 for n in size_px) else 1e-3
            np.testing.assert_allclose(kernel.sample(level, *scale, at, *NO_MASK), at[:, axis], atol=atol)
            r, G = kernel.linearise(
                level, *scale, at, np.tile(np.eye(2), (200, 1, 1)), np.zeros(200, np.float32),
                np.tile(np.eye(2, dtype=np.float32)[axis], (200, 1)), 1.0, 0.0, *NO_MASK,
            )  # fmt: skip
            np.testing.assert_allclose(-r, at[:, axis], atol=atol)
            # Gradients are per full pixel on every level.
            np.testing.assert_allclose(G, np.tile(np.eye(2)[axis], (200, 1)), atol=0.03)


@pytest.mark.parametrize("size_px", SIZES)
def test_the_mask_covers_what_it_covered(size_px):
    """Kept at a quarter of the size: no full pixel that was forbidden may be read, and hardly one that was not lost."""
    w, h = size_px
    usable = np.ones((h, w), bool)
    usable[h // 3 : h // 2, w // 5 : w // 2] = False
    pyramid = build_pyramid(np.full((h, w), 100, np.uint8), mask=usable)
    at = np.stack(ramps(size_px, np.float64), axis=-1).reshape(-1, 2)
    read = np.isfinite(
        kernel_numba.sample(pyramid.levels[0], 1.0, 1.0, at, pyramid.mask, *pyramid.mask_scale, True)
    )
    inner = np.zeros((h, w), bool)
    inner[2:-2, 2:-2] = True
    read, forbidden = read.reshape(h, w), ~usable
    assert not (read & forbidden).any()
    near = cv2.dilate(forbidden.astype(np.uint8), np.ones((9, 9))) > 0
    assert (read | near)[inner].all()


@few
@given(w=st.integers(16, 4000), small=st.integers(4, 2000), x=st.floats(-100, 5000))
def test_level_maps_invert_and_keep_the_edges(w, small, x):
    scale = level_scale((w, w), (small, small))
    np.testing.assert_allclose(to_level(to_full([x, x], scale), scale), x, atol=1e-8)
    # The outer edges of the first and last pixel are the same edges on every level.
    np.testing.assert_allclose(to_full([-0.5, small - 0.5], scale[:1] * 2), [-0.5, w - 0.5], atol=1e-8)


# ---- the rescues' own scales


@pytest.mark.parametrize("size_px", [(480, 270), (477, 263)])
@pytest.mark.parametrize("shift", [(60, -20), (-33, 8)])
def test_rescues_start_within_a_small_pixel(size_px, shift):
    """They work on reduced pictures: a wrong map between the sizes is a shift, or a wrong scale of it."""
    H = homography(*shift, size_px=size_px)
    a, b = as_uint8(picture(0, size_px=size_px)), as_uint8(picture(0, H, size_px=size_px))
    found, response = phase_correlation(a, b, size_px)
    assert response > 0.1
    assert corner_error_px(found, H, size_px) < 1.5  # of px of 1/2 and of integer reduction's rounding
    half = (size_px[0] // 2 + size_px[0] % 2, size_px[1] // 2 + size_px[1] % 2)
    small = [cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in (a, b)]
    by_features = match_features(*small, size_px)
    assert by_features is not None and corner_error_px(by_features, H, size_px) < 1.0


# ---- anchors and information


def test_the_anchor_jacobian_is_the_derivative_of_transfer():
    H = homography(10, 5, 1.2, 3, 0.1, -0.05)
    points = default_anchors((480, 270))
    J = transfer_jacobian(H, points)
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-6 * max(1.0, abs(H.ravel()[k])) if k < 6 else 1e-9
        d = step.reshape(3, 3)
        difference = (transfer(H + d, points) - transfer(H - d, points)) / (2 * step[k])
        np.testing.assert_allclose(J[:, :, k], difference, rtol=1e-5, atol=1e-5)


def test_anchor_information_predicts_the_scatter_of_the_anchors():
    """Points measured with known, anisotropic noise many times: covariance of the fitted anchors against info^-1."""
    rng = np.random.default_rng(0)
    H = homography(20, -8, 1.1, 4, 0.08, -0.03)
    src = rng.uniform([20, 20], [460, 250], (40, 2))
    dst = transfer(H, src)
    covariance = np.zeros((40, 2, 2))
    for i in range(40):
        c, s = np.cos(t := rng.uniform(0, np.pi)), np.sin(t)
        Q = np.array([[c, -s], [s, c]])
        covariance[i] = Q @ np.diag(rng.uniform(0.05, 0.5, 2) ** 2) @ Q.T
    info = np.linalg.inv(covariance)
    root = np.linalg.cholesky(covariance)
    anchors = default_anchors((480, 270))
    errors, stated, n = [], None, 1500
    for _ in range(n):
        noisy = dst + np.einsum("nij,nj->ni", root, rng.normal(size=(40, 2)))
        found, N = fit_homography_to_flow(src, noisy, info, H)
        stated = anchor_information(found, N, anchors) if stated is None else stated
        errors.append((transfer(found, anchors) - transfer(H, anchors)).ravel())
    errors = np.array(errors)
    assert stated.shape == (8, 8) and np.allclose(stated, stated.T)
    # Whitened errors have unit covariance; 1500 draws of 8 give its elements to .026 and .037 (one sigma).
    white = errors @ np.linalg.cholesky(stated)
    scatter = white.T @ white / n
    np.testing.assert_allclose(scatter, np.eye(8), atol=0.16)
    assert np.trace(scatter) / 8 == pytest.approx(1.0, abs=0.05)


@few
@given(H=homographies)
def test_points_without_error_give_their_homography(H):
    src = np.stack(np.meshgrid(np.linspace(0, 479, 5), np.linspace(0, 269, 4)), axis=-1).reshape(-1, 2)
    dst = transfer(H, src)
    if not np.isfinite(dst).all():
        return
    start = normalise_homography(homography(0.3, -0.2, 1.002) @ H)
    found, _ = fit_homography_to_flow(src, dst, np.tile(25.0 * np.eye(2), (20, 1, 1)), start)
    assert np.abs(transfer(found, src) - dst).max() < 0.02


def test_a_direction_that_was_not_measured_stays_where_it_was():
    """Points known in x only: y is the start's, to the weak pull; and the information says nothing of y."""
    src = np.stack(np.meshgrid(np.linspace(0, 479, 5), np.linspace(0, 269, 4)), axis=-1).reshape(-1, 2)
    info = np.tile(np.diag([100.0, 0.0]), (20, 1, 1))
    truth = homography(3.0, 5.0)
    found, N = fit_homography_to_flow(src, transfer(truth, src), info, np.eye(3))
    moved = transfer(found, src) - src
    np.testing.assert_allclose(moved[:, 0], 3.0, atol=0.02)
    np.testing.assert_allclose(moved[:, 1], 0.0, atol=0.1)
    anchors = default_anchors((480, 270))
    stated = anchor_information(found, N, anchors)
    # Any affine motion in y; its perspective would show in x as well.
    for pattern in (np.ones(4), anchors[:, 0] / 480, anchors[:, 1] / 270):
        unseen, seen = np.zeros((2, 4, 2))
        unseen[:, 1] = seen[:, 0] = pattern
        assert unseen.ravel() @ stated @ unseen.ravel() < 1e-6 * (seen.ravel() @ stated @ seen.ravel())
