"""The residual-flow grid measures where a cell's centroid went in the picture, whatever the family could express."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.coords import transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import build_pyramid
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, grid, homography, look, picture

FAMILY = HomographyFamily(size_px=SIZE)
STRONG = {
    "perspective": homography(px=0.25, py=0.1),
    "perspective and zoom": homography(dx=10, zoom=1.05, px=-0.25),
    "perspective across": homography(py=0.2, roll_deg=2),
}


def measured(seed, b, state, noise=0.0, **options):
    """(fit, template) of the texture's first picture against b, from a state."""
    a = build_pyramid(as_uint8(picture(seed), noise=noise, seed=1))
    template = build_template(a, 0)
    target = build_pyramid(as_uint8(b, noise=noise, seed=2))
    fit, _ = align(prepare(template, FAMILY), target, state, dst=1, options=RegisterOptions(**options))
    assert fit.usable
    return fit, template


@pytest.mark.parametrize("name", STRONG)
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_cells_are_where_their_centroids_went(name, noise):
    """The true family, a strong perspective: rms < .03 px a coordinate, the mean of 150 cells < .01."""
    H = STRONG[name]
    errors = []
    for seed in range(4):
        fit, _ = measured(seed, picture(seed, H), H, noise)
        assert len(fit.flow.cell) >= 30
        errors.append(fit.flow.dst_px - transfer(H, fit.flow.src_px))
    errors = np.concatenate(errors)
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.01


def test_a_cell_bends_by_ten_times_that():
    """'Flow grid: the warp of a cell's centroid' (1.6 % of focal): the mean of the warped pixels lies elsewhere.

    Held here: the case that the test above passes is one in which the two differ, always to the same side.
    """
    H = STRONG["perspective"]
    fit, template = measured(0, picture(0, H), H)
    level = template.levels[0]
    bent = []
    for cell, src, dst in zip(fit.flow.cell, fit.flow.src_px, fit.flow.dst_px, strict=True):
        pixels = level.src_px[level.cell == cell]
        # The cell's pixels shifted so that their plain mean is the measured, texture-weighted centroid.
        pixels = pixels + src - pixels.mean(axis=0)
        mean_of_warped = transfer(H, pixels).mean(axis=0)
        bent.append(mean_of_warped - transfer(H, src))
        assert np.linalg.norm(dst - transfer(H, src)) < 0.5 * max(0.2, np.linalg.norm(bent[-1]))
    bent = np.array(bent)
    assert np.abs(bent.mean(axis=0)).max() > 0.15 and (bent[:, 0] < 0).mean() > 0.9


def distorted(seed: int, H: np.ndarray, k: float):
    """Picture b that also has a radial distortion no homography can express, and the true map of points."""
    w, h = SIZE
    centre, half = np.array([(w - 1) / 2, (h - 1) / 2]), w / 2

    def undistort(xy):
        d = (xy - centre) / half
        return centre + half * d * (1 + k * np.sum(d**2, axis=-1, keepdims=True))

    def there(src):
        ideal = transfer(H, src)
        xy = ideal.copy()
        for _ in range(60):
            xy = xy - (undistort(xy) - ideal)
        return xy

    return look(seed, transfer(np.linalg.inv(H), undistort(grid()))), there


@pytest.mark.parametrize("k", [-0.015, 0.015])
def test_what_the_family_cannot_express_is_measured_in_full(k):
    """Robust weights at the family's own warp would pull the cells towards it (half of a wrong lens' flow was lost)."""
    H = homography(8, -4, 1.02)
    errors, residuals = [], []
    for seed in range(3):
        b, there = distorted(seed, H, k)
        fit, _ = measured(seed, b, H, noise=1.0)
        truth = there(fit.flow.src_px)
        errors.append(fit.flow.dst_px - truth)
        residuals.append(truth - transfer(fit.H_dst_src, fit.flow.src_px))
    errors, residuals = np.concatenate(errors), np.concatenate(residuals)
    assert np.sqrt(np.mean(residuals**2)) > 0.2  # there is something to measure
    assert np.sqrt(np.mean(errors**2)) < 0.05
    # Share of the residual that the grid shows: measured .97, the flow of a cell not being constant; not 1/2.
    share = np.sum((errors + residuals) * residuals) / np.sum(residuals**2)
    assert share == pytest.approx(1.0, abs=0.05)


def test_the_stated_information_covers_the_error_and_has_its_floor():
    H = STRONG["perspective"]
    normalised = []
    for seed in range(4):
        fit, _ = measured(seed, picture(seed, H), H, noise=4.0)
        e = fit.flow.dst_px - transfer(H, fit.flow.src_px)
        normalised.append(np.einsum("ci,cij,cj->c", e, fit.flow.info, e) / 2)
        assert np.linalg.eigvalsh(fit.flow.info).max() <= 1 / 0.1**2 + 1e-6
    assert np.mean(np.concatenate(normalised)) < 1.0


def test_stripes_tell_nothing_along_themselves():
    """Texture in x alone, and a pan: every cell knows x, none claims y."""
    x = grid()[..., 0]
    pattern = look(5, np.stack([x, np.zeros_like(x)], axis=-1))
    moved = look(5, np.stack([x - 3.3, np.zeros_like(x)], axis=-1))
    # Some texture in both directions on the left, without which the homography itself would be open.
    left = x < 160
    a, b = np.where(left, picture(5), pattern), np.where(left, picture(5, homography(dx=3.3)), moved)
    source = build_template(build_pyramid(as_uint8(a, noise=1, seed=1)), 0)
    fit, _ = align(
        prepare(source, FAMILY), build_pyramid(as_uint8(b, noise=1, seed=2)), homography(dx=3.0), dst=1
    )
    assert fit.usable
    striped = fit.flow.src_px[:, 0] > 200
    assert striped.sum() >= 15
    info = fit.flow.info[striped]
    assert (info[:, 0, 0] > 50).mean() > 0.9
    assert np.median(info[:, 1, 1]) < 1.0
    error = (fit.flow.dst_px - fit.flow.src_px)[striped, 0] - 3.3
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_masked_and_unseen_cells_are_left_out():
    usable = np.ones(SIZE[::-1], bool)
    usable[:, :130] = False
    H = homography(dx=125)
    a = build_pyramid(as_uint8(picture(0), noise=1), mask=usable)
    b = build_pyramid(as_uint8(picture(0, H), noise=1, seed=2))
    fit, _ = align(prepare(build_template(a, 0), FAMILY), b, H, dst=1)
    assert fit.usable and len(fit.flow.cell) >= 15
    column = fit.flow.cell % 8
    assert column.min() == 2  # columns 0 and 1 are masked, 6 and 7 (from x = 355 on) have left the picture
    assert (fit.flow.dst_px[:, 0] < SIZE[0]).all() and (fit.flow.weight > 0).all()
    assert (fit.flow.weight <= 1).all()
