"""Failures of real footage that belong to the registration of a pair: flash, duplicates, long chains, coarse scales."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.coords import normalise_homography, transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pair import register
from mosaic.pyramid import build_pyramid
from mosaic.records import PairStatus
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, blocks, corner_error_px, homography, picture

FAMILY = HomographyFamily(size_px=SIZE)


@pytest.mark.parametrize("seed", range(3))
def test_a_flash_gives_no_wrong_answer(seed):
    """An over-exposed picture, a third of it white: the pair is right or not called ok (real-footage.md 7.7)."""
    H = homography(4, -3, 1.01, 0.3)
    a = as_uint8(picture(seed), noise=2, seed=1)
    flash = as_uint8(1.9 * picture(seed, H) + 60, noise=2, seed=2)
    assert (flash == 255).mean() > 0.3
    fit = register(a, flash)
    assert fit.status != PairStatus.OK or corner_error_px(fit.H_dst_src, H) < 1.0


def test_a_repeated_picture_is_found_where_it_was():
    """The same scene with the coder's other noise stays within .02 px, whatever motion was predicted (7.6)."""
    a, b = (as_uint8(picture(2), noise=1, seed=i) for i in (1, 2))
    prepared = prepare(build_template(build_pyramid(a), 0), FAMILY)
    for predicted in (np.eye(3), homography(9, 4), homography(-6, 2, 1.02)):
        fit, _ = align(prepared, build_pyramid(b), predicted, dst=1)
        assert fit.status == PairStatus.OK
        assert corner_error_px(fit.H_dst_src, np.eye(3)) < 0.05


def test_a_chain_of_updates_stays_a_homography():
    """400 steps and as many back: det 1 all the way, and the points return (7.3: what is not renormalised doubles)."""
    rng = np.random.default_rng(0)
    H = np.eye(3)
    steps = 1e-3 * rng.normal(size=(400, 8))
    for step in steps:
        H = FAMILY.update(H, step)
        assert abs(np.linalg.det(H) - 1) < 1e-9
    back = H
    for step in steps[::-1]:
        undo = FAMILY.update(np.eye(3), step)
        back = normalise_homography(np.linalg.inv(undo) @ back)
    corners = np.array([[0.0, 0], [479, 0], [479, 269], [0, 269]])
    assert np.abs(transfer(back, corners) - corners).max() < 1e-6


@pytest.mark.parametrize("shift", [(10, 4), (-9, 6)])
def test_every_level_begins_with_its_own_scale(shift):
    """The coarse residuals, which are smaller, must not weigh the fine ones: from 11 px off, 10 % foreign (7.8)."""
    H = homography(*shift, 1.01)
    a, b = (as_uint8(blocks(p, 0.1, k), noise=4, seed=k) for k, p in enumerate((picture(3), picture(3, H))))
    prepared = prepare(build_template(build_pyramid(a), 0), FAMILY)
    one = [align(prepared, build_pyramid(b), np.eye(3), dst=1, options=RegisterOptions())[0]]
    one.append(align(prepared, build_pyramid(b), H, dst=1, levels=(0,), options=RegisterOptions())[0])
    assert all(fit.usable and corner_error_px(fit.H_dst_src, H) < 0.15 for fit in one)
    assert one[0].rms_grey == pytest.approx(one[1].rms_grey, rel=0.05)
