"""Pictures of unequal sharpness: the difference of their point spreads, and alignment across it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.blur import FINE, equally_sharp, matched, spread_difference
from mosaic.pair import PairOptions, register
from mosaic.pyramid import build_pyramid
from tests.mosaic.textures import as_uint8, corner_error_px, homography, picture

SIZE = (1280, 720)
H = homography(6.3, -3.7, 1.02, 0.4, size_px=SIZE)


def smeared(gray: np.ndarray, length_px: int, upright: bool) -> np.ndarray:
    """A box of an odd number of pixels along x or y: variance (n^2 - 1) / 12."""
    return cv2.blur(gray, (1, length_px) if upright else (length_px, 1), borderType=cv2.BORDER_REFLECT)


def pair(
    length_px: int, upright: bool, seed: int = 0, finest_px: float = 1.2
) -> tuple[np.ndarray, np.ndarray]:
    a, b = (picture(seed, h, size_px=SIZE, finest_px=1.2)[:720, :1280] for h in (None, H))
    return as_uint8(a, noise=2, seed=1), as_uint8(smeared(b, length_px, upright), noise=2, seed=2)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("length_px", [1, 9, 13])
def test_the_smear_is_measured_along_its_own_axis(length_px, upright):
    """Truth 0, 6.7, 14 px^2; second derivatives at a quarter of the size find it to two, less a fifth."""
    a, b = (build_pyramid(p) for p in pair(length_px, upright))
    found = spread_difference(a, b, H, 1.0, 0.0)
    truth = (length_px**2 - 1) / 12
    along, across = (found[1, 1], found[0, 0]) if upright else (found[0, 0], found[1, 1])
    assert along == pytest.approx(truth, abs=2.5 + 0.2 * truth)
    assert abs(across) < 2.5 and abs(found[0, 1]) < 2.5
    assert (matched(a, b, found, H) is None) == (length_px == 1)


@pytest.mark.parametrize("length_px", [1, 3])
def test_a_small_smear_is_measured_in_a_part_of_the_finest_level(length_px):
    """Truth 0 and .67 px^2, which a quarter of the size cannot tell from each other."""
    a, b = (build_pyramid(p) for p in pair(length_px, False))
    found = spread_difference(a, b, H, 1.0, 0.0, level=0, most_px=400)
    assert found[0, 0] == pytest.approx((length_px**2 - 1) / 12, abs=0.25)
    assert abs(found[1, 1]) < 0.25 and abs(found[0, 1]) < 0.25


def test_matching_the_smear_brings_the_corners_closer():
    """9 px of smear in one picture: .3 px at the corners, .1 px matched."""
    errors = []
    for options in (PairOptions(match_blur=False), PairOptions()):
        fits = [register(*pair(9, False, seed), options=options) for seed in (0, 1)]
        assert all(f.usable for f in fits)
        assert all(("blur matched" in f.route) == options.match_blur for f in fits)
        errors.append(np.mean([corner_error_px(f.H_dst_src, H, SIZE) for f in fits]))
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("upright", [False, True])
def test_a_small_smear_is_found_at_half_the_size(upright):
    """5 px, a variance of 2 px^2, is less than the coarse level can be sure of."""
    a, b = (build_pyramid(p) for p in pair(5, upright))
    assert matched(a, b, spread_difference(a, b, H, 1.0, 0.0), H) is None
    found = spread_difference(a, b, H, 1.0, 0.0, level=FINE)
    along, across = (found[1, 1], found[0, 0]) if upright else (found[0, 0], found[1, 1])
    assert along == pytest.approx(2.0, abs=0.8) and abs(across) < 0.7
    assert equally_sharp(a, b, H, 1.0, 0.0) is not None
    sharp = [build_pyramid(p) for p in pair(1, upright)]
    assert equally_sharp(*sharp, H, 1.0, 0.0) is None


@pytest.mark.parametrize("finest_px", [1.2, 2.0])
def test_matching_a_small_smear_leaves_no_more_than_without_one(finest_px):
    """5 px in one picture: .013 and .024 px at the corners left as they are, .004 and .007 px matched."""
    M = homography(6.3, -3.7, 1.02, 0.4)
    a, b = (picture(0, h, finest_px=finest_px) for h in (None, M))
    pictures = as_uint8(a, noise=2, seed=1), as_uint8(smeared(b, 5, False), noise=2, seed=2)
    # As it is matched, before the last steps, which leave less of the smear in either case (finish.py).
    fit, left = (
        register(*pictures, options=PairOptions(match_blur=on, finish=False)) for on in (True, False)
    )
    assert "blur matched" in fit.route
    assert corner_error_px(fit.H_dst_src, M) < min(0.01, 0.6 * corner_error_px(left.H_dst_src, M))
