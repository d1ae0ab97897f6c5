"""The two kernels are one estimator: same residuals, gradients, sums and, in the end, the same homography."""

import cv2
import numpy as np
import pytest

from mosaic import kernel_numba, kernel_torch
from mosaic.coords import transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import build_pyramid
from mosaic.template import build_template, mask_arguments, prepare
from mosaic.warp import HomographyFamily

SIZE = (320, 180)


def textured(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0, 255, (180, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0) + 0.5 * cv2.GaussianBlur(noise, (0, 0), 6.0)
    return cv2.normalize(smooth, None, 10, 245, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def pair():
    a = textured(0)
    H = np.array([[1.01, 0.004, 3.3], [-0.003, 0.995, -2.1], [1e-5, -2e-5, 1.0]])
    b = cv2.warpPerspective(a, H, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    mask = np.ones((180, 320), bool)
    mask[20:60, 30:120] = False
    return build_pyramid(a, mask=mask), build_pyramid(b, mask=mask), H


def test_kernels_agree_term_by_term(pair):
    source, target, H = pair
    family = HomographyFamily(size_px=SIZE)
    template = build_template(source, 0)
    level = template.levels[0]
    where, J, A = family.warp(H, family.prepare(level.src_px))
    arguments = (
        target.levels[0],
        *target.scales[0],
        where,
        A,
        level.values,
        level.gradients,
        1.1,
        -3.0,
        *mask_arguments(target),
    )
    r_n, G_n = kernel_numba.linearise(*arguments)
    r_t, G_t = kernel_torch.linearise(*arguments)
    np.testing.assert_array_equal(np.isnan(r_n), np.isnan(r_t))
    np.testing.assert_allclose(r_n, r_t, atol=2e-3)
    np.testing.assert_allclose(G_n, G_t, atol=2e-3)
    for tukey in (True, False):
        np.testing.assert_allclose(
            kernel_numba.robust_weights(r_n, np.float32(5.0), tukey),
            kernel_torch.robust_weights(r_n, 5.0, tukey),
            atol=1e-5,
        )
    w = kernel_numba.robust_weights(r_n, np.float32(5.0), True)
    for a, b in zip(
        kernel_numba.accumulate(r_n, G_n, J, w), kernel_torch.accumulate(r_n, G_n, J, w), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-2)
    cells_n = kernel_numba.accumulate_cells(r_n, G_n, w, level.src_px, where, level.cell, 40)
    cells_t = kernel_torch.accumulate_cells(r_n, G_n, w, level.src_px, where, level.cell, 40)
    for a, b in zip(cells_n, cells_t, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-4)


def test_kernels_agree_on_what_is_measured_after_the_alignment(pair):
    """Scale, null, and the cells' steps and sums: with cells moved one by one, and pixels outside and masked."""
    source, target, H = pair
    family = HomographyFamily(size_px=SIZE)
    level = build_template(source, 0).levels[0]
    where, J, A = family.warp(H, family.prepare(level.src_px))
    shift = np.random.default_rng(1).uniform(-1.5, 1.5, (40, 2))
    masks = mask_arguments(target)
    picture = (target.levels[0], *target.scales[0])
    found = []
    for kernel in (kernel_numba, kernel_torch):
        r, G, moved = kernel.linearise_cells(
            *picture, where, shift, level.cell, A, level.values, level.gradients, 1.1, -3.0, *masks
        )
        np.testing.assert_array_equal(moved, where + shift[level.cell])
        scale, n = kernel.robust_scale(r)
        assert 0 < n == np.isfinite(r).sum() < len(r)
        w = kernel.robust_weights(r, np.float32(scale), True)
        sums, b, _, _ = kernel.accumulate_cells(r, G, w, level.src_px, moved, level.cell, 40)
        limit = 1.01 * float(np.sqrt(np.median(kernel.cell_steps(sums, b, scale**2, 1.0)[2])))
        step, vectors, std2, known = kernel.cell_steps(sums, b, scale**2, limit)
        assert known.any() and not known.all()
        spread = (vectors * np.where(known, std2, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
        scores = kernel.cell_scores(r, G, J, w, level.cell, 40)
        np.testing.assert_allclose(scores.sum(axis=0), kernel.accumulate(r, G, J, w)[1], rtol=1e-5, atol=1e-3)
        moments = kernel.cell_moments(G, J, w, level.cell, 40)
        null = kernel.shifted_residuals(
            *picture, where, np.array([[5.0, 2.0], [-40.0, 3.0]]), 3, level.values, 1.1, -3.0, *masks
        )
        inner = kernel.inlier_scale(r, scale)
        assert 0.5 <= inner <= scale
        cost = kernel.tukey_cost(r, inner)
        assert 0 < kernel.tukey_cost(r, 2 * inner) < cost < 1
        found.append((scale, inner, cost, step, spread, scores, moments / 1e3, np.nan_to_num(null)))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-3)


def test_the_inlier_scale_leaves_out_what_the_robust_scale_swallows():
    """60 % of the residuals are noise of 2 levels, 40 % anything up to 60: 3 levels by the quantile, 2.3 at last."""
    rng = np.random.default_rng(0)
    r = np.concatenate([rng.normal(0, 2, 6000), rng.uniform(-60, 60, 4000)]).astype(np.float32)
    for kernel in (kernel_numba, kernel_torch):
        scale, _ = kernel.robust_scale(r)
        assert scale > 3
        assert kernel.inlier_scale(r, scale) == pytest.approx(2.0, rel=0.2)
        alone = kernel.inlier_scale(r[:6000], kernel.robust_scale(r[:6000])[0])
        assert alone == pytest.approx(2.0, rel=0.03)


@pytest.mark.parametrize("n", [1, 2, 3, 1000])
def test_the_robust_scale_is_the_quantile(n):
    r = np.random.default_rng(n).normal(0, 7, n + 1).astype(np.float32)
    r[n // 2] = np.nan
    expected = np.sort(np.abs(r[np.isfinite(r)]))[int(0.3 * n)] / 0.38532
    for kernel in (kernel_numba, kernel_torch):
        scale, count = kernel.robust_scale(r)
        assert count == n and scale == pytest.approx(max(expected, 0.5), rel=1e-6)
        assert kernel.robust_scale(np.full(3, np.nan, np.float32))[1] == 0


def test_kernels_give_the_same_homography(pair):
    source, target, H = pair
    prepared = prepare(build_template(source, 0), HomographyFamily(size_px=SIZE))
    corners = np.array([[0, 0], [319, 0], [319, 179], [0, 179.0]])
    found = []
    for name in ("numba", "torch"):
        fit, _ = align(
            prepared, target, np.eye(3), dst=1, options=RegisterOptions(kernel=name, stop_sigmas=1e-3)
        )
        assert fit.usable
        found.append(transfer(fit.H_dst_src, corners))
    assert np.abs(found[0] - found[1]).max() < 1e-3
    assert np.abs(found[0] - transfer(H, corners)).max() < 0.3
