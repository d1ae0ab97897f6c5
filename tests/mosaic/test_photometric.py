"""Gain and offset: recovered over the range that broadcasts show, not pulled down by decorrelation, robust."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaic.estimator import align
from mosaic.photometric import estimate_gain
from mosaic.pyramid import build_pyramid
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, homography, picture

few = settings(max_examples=30, deadline=None, derandomize=True, database=None)
N = 576  # of the even sample that a template keeps


def values(seed: int, spread: float = 40.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(120, spread, N)


def estimate(template: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    gain, offset = estimate_gain(template.astype(np.float32), target.astype(np.float32))
    return float(gain), float(offset)


@few
@given(gain=st.floats(0.7, 1.4), offset=st.floats(-30, 30), seed=st.integers(0, 99))
def test_an_exposure_change_is_recovered(gain, offset, seed):
    """Noise of 2 grey levels: the gain to 2 %, which is the prior's width; the mapping itself to 1.5 grey levels."""
    target = values(seed)
    noise = np.random.default_rng([seed, 1]).normal(0, 2, N)
    found, shift = estimate(gain * target + offset + noise, target)
    assert found == pytest.approx(gain, abs=0.02)
    assert found * 120 + shift == pytest.approx(gain * 120 + offset, abs=1.5)


@few
@given(seed=st.integers(0, 999))
def test_without_a_change_there_is_none(seed):
    target = values(seed)
    found, shift = estimate(target + np.random.default_rng([seed, 1]).normal(0, 4, N), target)
    assert found == pytest.approx(1.0, abs=0.01)
    assert shift == pytest.approx(0.0, abs=2.0)


@pytest.mark.parametrize("noise", [10.0, 20.0, 30.0])
def test_decorrelation_does_not_pull_the_gain_below_one(noise):
    """Both pictures lose their likeness: a regression falls, the ratio of spreads stays (real-footage.md 7.4)."""
    found, slopes = [], []
    for seed in range(40):
        rng, scene = np.random.default_rng([seed, 2]), values(seed)
        template, target = (scene + rng.normal(0, noise, N) for _ in range(2))
        found.append(estimate(template, target)[0])
        slopes.append(np.polyfit(target, template, 1)[0])
    assert np.mean(slopes) < 0.97  # the trap is there
    assert np.mean(found) == pytest.approx(1.0, abs=0.01)


def test_the_gain_does_not_drift_over_a_chain_of_pictures():
    """Fifteen pairs of one scene, each picture with strong noise of its own: the product of the gains stays at one."""
    family, scene = HomographyFamily(size_px=SIZE), picture(3, finest_px=4)
    pyramids = [build_pyramid(as_uint8(scene, noise=12, seed=i)) for i in range(16)]
    product = 1.0
    for i, (a, b) in enumerate(pairwise(pyramids)):
        fit, _ = align(prepare(build_template(a, i), family), b, np.eye(3), dst=i + 1)
        assert fit.usable
        product *= fit.gain
    assert product == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.4])
def test_the_estimator_finds_the_gain_of_a_moved_picture(gain):
    """Through pyramid and interpolation; on coarse texture, where a sample between pixels loses little contrast."""
    H = homography(5.3, 3.1, 1.01, 0.5)
    a = build_pyramid(as_uint8(picture(0, finest_px=5)))
    b = build_pyramid(as_uint8(120 + (picture(0, H, finest_px=5) - 120) / gain))
    fit, _ = align(prepare(build_template(a, 0), HomographyFamily(size_px=SIZE)), b, np.eye(3), dst=1)
    assert fit.usable and fit.gain == pytest.approx(gain, rel=0.025)
    assert fit.gain * (120 + (150 - 120) / gain) + fit.offset == pytest.approx(150, abs=1.5)


@few
@given(share=st.floats(0, 0.3), gain=st.sampled_from([0.8, 1.0, 1.25]), seed=st.integers(0, 99))
def test_players_in_one_picture_do_not_count(share, gain, seed):
    target = values(seed)
    template = gain * target + np.random.default_rng([seed, 1]).normal(0, 2, N)
    taken = np.random.default_rng([seed, 3]).random(N) < share
    template[taken] = np.random.default_rng([seed, 4]).uniform(0, 255, taken.sum())
    assert estimate(template, target)[0] == pytest.approx(gain, abs=0.06)


def test_points_outside_do_not_count():
    target = values(0)
    template = 1.2 * target + 5
    seen = target.copy()
    seen[::3] = np.nan
    template[::3] = 1e6
    gain, offset = estimate(template, seen)
    assert gain == pytest.approx(1.2, abs=0.005) and offset == pytest.approx(5, abs=0.6)


@pytest.mark.parametrize("kind", ["few points", "no contrast", "nothing in common"])
def test_what_shows_no_gain_gives_a_finite_one_in_range(kind):
    template, target = values(0), values(1)
    if kind == "few points":
        target[39:] = np.nan
        assert estimate(template, target) == (1.0, 0.0)
    if kind == "no contrast":
        gain, offset = estimate(np.full(N, 90.0), np.full(N, 80.0))
        assert gain == pytest.approx(1.0) and offset == pytest.approx(10.0)
    gain, offset = estimate(template, target)
    assert 0.4 <= gain <= 2.5 and np.isfinite(offset)
