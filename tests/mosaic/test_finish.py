"""The last steps on smoothed pictures: what sampling and unequal smoothing leave, gain, and what is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mosaic import finish
from mosaic.coords import transfer
from mosaic.finish import ALIKE_SPREAD_PX, CODED, SPREAD_PX, finished
from mosaic.pair import PairOptions, register, register_pyramids
from mosaic.pyramid import build_pyramid
from mosaic.records import PairStatus
from tests.mosaic.textures import SIZE, as_uint8, corner_error_px, homography, picture

WITHOUT = PairOptions(finish=False)
SHIFT = homography(5.3, -3.4)
LARGE = (1280, 720)


def pair(H: np.ndarray, seed: int, size_px: tuple[int, int] = SIZE) -> list[np.ndarray]:
    """Quantised pictures with detail far beyond what their pixels resolve."""
    return [as_uint8(picture(seed, h, finest_px=0.5, size_px=size_px)) for h in (None, H)]


def mean_error_px(H: np.ndarray, options: PairOptions) -> float:
    fits = [register(*pair(H, seed), options=options) for seed in range(6)]
    assert all(f.status == PairStatus.OK for f in fits)
    return float(np.mean([corner_error_px(f.H_dst_src, H) for f in fits]))


def test_detail_that_is_not_sampled_well_no_longer_pulls_a_pure_shift():
    """One fraction of a pixel all over the picture: .019 px without, .008 with."""
    assert mean_error_px(SHIFT, PairOptions()) < 0.6 * mean_error_px(SHIFT, WITHOUT)


def test_pictures_of_unlike_zoom_are_smoothed_alike_in_the_scene(monkeypatch):
    """Zoom 1.2: .003 px, with equal smoothing in px .012, which is no better than without any."""
    H = homography(5.3, -3.4, 1.2)
    alike = mean_error_px(H, PairOptions())
    monkeypatch.setattr(finish, "_zoom", lambda H, point: 1.0)
    assert alike < 0.5 * mean_error_px(H, PairOptions())


@pytest.mark.parametrize("gain", [1.0, 0.7])
def test_gain_is_found_on_the_finest_level(gain):
    """Coarse levels of such detail, sampled between their pixels, lack a tenth of its contrast."""
    for seed in range(4):
        a, b = (picture(seed, h, finest_px=0.5) for h in (None, SHIFT))
        fit, without = (
            register(as_uint8(a), as_uint8(120 + (b - 120) * gain), options=o)
            for o in (PairOptions(), WITHOUT)
        )
        assert abs(fit.gain * gain - 1) < 0.02 < abs(without.gain * gain - 1)


def test_the_zoom_is_that_about_the_point():
    H = homography(30, -10, 1.25, 7, 0.1, -0.05)
    point, step = np.array([300.0, 90.0]), 1e-3
    corners = point + step * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    x, y = transfer(H, corners).T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert finish._zoom(H, point) == pytest.approx(np.sqrt(area) / step, rel=1e-4)


@pytest.mark.parametrize(
    ("H", "size_px", "spread"),
    [
        (homography(5.3, -3.4, size_px=LARGE), LARGE, ALIKE_SPREAD_PX),
        (homography(5.3, -3.4, 1.02, size_px=LARGE), LARGE, SPREAD_PX),
        (SHIFT, SIZE, SPREAD_PX),
    ],
    ids=["shift", "zoom", "small"],
)
def test_large_neighbours_that_lie_alike_on_the_grid_are_smoothed_most(H, size_px, spread):
    fit = register(*pair(H, 0, size_px), options=WITHOUT)
    assert finish._spread_px(fit, size_px[0]) == spread


@pytest.mark.parametrize("coded", [True, False])
def test_the_stated_error_stays_where_an_encoder_displaces(coded):
    pyramids = [replace(build_pyramid(p, n_levels=3), blocks=2 * CODED * coded) for p in pair(SHIFT, 1)]
    before, after = (
        register_pyramids(*pyramids, options=replace(o, turning=False)) for o in (WITHOUT, PairOptions())
    )
    assert not np.array_equal(before.H_dst_src, after.H_dst_src)
    assert np.array_equal(before.info, after.info) == coded


def test_a_fit_that_smoothed_pictures_do_not_hold_stays():
    options = PairOptions()
    source, target = (build_pyramid(p, n_levels=3) for p in pair(SHIFT, 2))
    fit = register_pyramids(source, target, options=WITHOUT)
    hidden = build_pyramid(pair(SHIFT, 2)[1], n_levels=3, mask=np.zeros(SIZE[::-1], bool))
    assert finished(fit, source, hidden, options.selection, options.estimator) is fit
