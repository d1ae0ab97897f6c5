"""The borders of an encoder's blocks are seen, and widen the stated error by what the blocks may be displaced."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mosaic.coded import BLOCK_PX, PX_PER_GREY, blockiness, displacement_px
from mosaic.coords import transfer
from mosaic.estimator import align
from mosaic.pair import PairOptions, register, register_pyramids
from mosaic.pyramid import build_pyramid
from mosaic.records import PairStatus
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, homography, picture

H = homography(9, -4, 1.02, 0.4)


def _coded(gray: np.ndarray, quality: int) -> np.ndarray:
    """The picture through blocks of 8 px whose coefficients were rounded (JPEG)."""
    return cv2.imdecode(
        cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE
    )


@pytest.mark.parametrize("seed", range(4))
def test_coarser_coding_shows_more_blocks_and_none_are_seen_without(seed):
    gray = as_uint8(picture(seed), noise=2, seed=seed)
    none, fine, coarse = (blockiness(g) for g in (gray, _coded(gray, 50), _coded(gray, 10)))
    assert none < 0.02 < fine < coarse
    # A crop moves the grid, not what is seen of it.
    assert blockiness(_coded(gray, 10)[:, 3:]) == pytest.approx(coarse, abs=0.03)


@pytest.mark.parametrize("gray", [np.zeros((90, 160)), np.full((4, 3 * BLOCK_PX), 7.0), np.zeros((1, 1))])
def test_flat_and_tiny_pictures_show_no_blocks(gray):
    assert blockiness(gray) == 0.0


def test_the_whole_picture_may_be_displaced_by_what_the_blocks_say():
    """Of the stated variance of the anchors' mean, what blocks add is that of the whole picture's displacement or more.

    A displacement of everything moves the homography by itself, whatever the texture; regions on their own add to it.
    """
    first, second = (as_uint8(picture(3, M), noise=2, seed=k) for k, M in enumerate((None, H)))
    blocks = 0.08

    def stated(some: float) -> np.ndarray:
        a, b = (replace(build_pyramid(p, n_levels=3), blocks=some) for p in (first, second))
        source = prepare(build_template(a, 0), HomographyFamily(size_px=SIZE))
        fit, _ = align(source, b, H, dst=1, levels=[0])
        widths.append(fit.rms_grey)
        return np.linalg.inv(fit.info)

    widths: list[float] = []
    added = stated(blocks) - stated(0.0)
    e2 = displacement_px(blocks, blocks, widths[0]) ** 2
    assert e2 == pytest.approx((PX_PER_GREY * widths[0] * blocks) ** 2) and e2 > 0
    for axis in (0, 1):
        mean = np.zeros(8)
        mean[axis::2] = 0.25
        # fine.sigma, which is not handed out, is at most rms_grey, here within a few hundredths of it.
        assert 0.8 * e2 < mean @ added @ mean < 4.2 * e2


def test_only_pictures_with_blocks_are_stated_wider():
    gray = [as_uint8(picture(5, M), noise=2, seed=k) for k, M in enumerate((None, H))]
    coded = [_coded(g, 12) for g in gray]

    def std_px(pictures: list[np.ndarray], seen: bool) -> float:
        if seen:
            fit = register(*pictures)
        else:
            fit = register_pyramids(*(build_pyramid(p, n_levels=3) for p in pictures), options=PairOptions())
        assert fit.status != PairStatus.FAILED
        assert (
            np.linalg.norm(
                transfer(fit.H_dst_src, fit.anchors_px) - transfer(H, fit.anchors_px), axis=1
            ).max()
            < 1
        )
        return float(np.sqrt(np.trace(np.linalg.inv(fit.info)) / 8))

    assert std_px(coded, True) > 1.2 * std_px(coded, False)
    assert std_px(gray, True) < 1.02 * std_px(gray, False)
