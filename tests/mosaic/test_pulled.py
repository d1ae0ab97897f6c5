"""Four weak freedoms on top of a family: Jacobian, and a pull that is no wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mosaic.coords import normalise_homography
from mosaic.estimator import align
from mosaic.pulled import PulledFamily, PulledState
from mosaic.pyramid import build_pyramid
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, corner_error_px, homography, picture

FULL = HomographyFamily(size_px=SIZE)


@dataclass(frozen=True, slots=True)
class Similarity:
    """Shift, zoom and roll as a family: four of the homography's increments."""

    n_parameters: int = 4

    def prepare(self, src_px):
        return FULL.prepare(src_px)

    def warp(self, state, prepared):
        where, J, A = FULL.warp(state, prepared)
        own = np.stack([J[..., 2], J[..., 5], J[..., 0] + J[..., 4], J[..., 3] - J[..., 1]], axis=-1)
        return where, own, A

    def update(self, state, step):
        tx, ty, zoom, roll = step
        return FULL.update(state, np.array([zoom, -roll, tx, roll, zoom, ty, 0.0, 0.0]))


STATE = PulledState(homography(5, -3, 1.03, 1.0), np.array([0.01, -0.02, 0.03, 0.015]))
POINTS = np.random.default_rng(0).uniform([0, 0], [479, 269], (25, 2))


def test_the_jacobians_are_those_of_central_differences():
    family = PulledFamily(base=Similarity(), size_px=SIZE)
    _, J, A = family.warp(STATE, family.prepare(POINTS))
    for k in range(8):
        step = 1e-6 * np.eye(8)[k]
        ahead, back = (family.warp(family.update(STATE, s), family.prepare(POINTS))[0] for s in (step, -step))
        np.testing.assert_allclose(J[..., k], (ahead - back) / 2e-6, rtol=1e-5, atol=2e-3)
    for k in range(2):
        shift = 1e-4 * np.eye(2)[k]
        ahead, back = (family.warp(STATE, family.prepare(POINTS + s))[0] for s in (shift, -shift))
        np.testing.assert_allclose(A[..., k], (ahead - back) / 2e-4, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("std_px", [0.01, 1.0])
def test_the_pull_is_what_it_says(std_px):
    """A keystone of 2.4 px at the sides: with a pull of 1 px the pixels have their way, with .01 px the model does."""
    H = homography(4, 2, 1.01, 0.3, px=0.01)
    a, b = (build_pyramid(as_uint8(picture(0, h), noise=2, seed=i)) for i, h in enumerate((None, H)))
    family = PulledFamily(base=Similarity(), size_px=SIZE, std_px=std_px)
    start = family.start(homography(3, 2))
    fit, state = align(prepare(build_template(a, 0), family), b, start, dst=1)
    assert fit.usable
    if std_px == 1.0:
        assert corner_error_px(fit.H_dst_src, H) < 0.15
        assert np.abs(state.weak).max() > 0.005
    else:
        assert np.abs(state.weak).max() < 0.003
    assert np.isfinite(normalise_homography(fit.H_dst_src)).all()
