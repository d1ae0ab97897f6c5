"""Pictures of unequal sharpness: the difference of their point spreads, and alignment across it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.blur import matched, spread_difference
from mosaic.pair import PairOptions, register
from mosaic.pyramid import build_pyramid
from tests.mosaic.textures import as_uint8, corner_error_px, homography, picture

SIZE = (1280, 720)
H = homography(6.3, -3.7, 1.02, 0.4, size_px=SIZE)


def smeared(gray: np.ndarray, length_px: int, upright: bool) -> np.ndarray:
    """A box of an odd number of pixels along x or y: variance (n^2 - 1) / 12."""
    return cv2.blur(gray, (1, length_px) if upright else (length_px, 1), borderType=cv2.BORDER_REFLECT)


def pair(length_px: int, upright: bool, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
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
