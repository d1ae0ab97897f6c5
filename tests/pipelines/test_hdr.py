"""HDR and wide gamuts as BT.709: the table against colour arithmetic written out here, pictures against the table."""

from __future__ import annotations

from itertools import pairwise

import av
import numpy as np
import pytest

from pipelines.hdr import NODES, bt709_table, needs_mapping
from pipelines.pixels import rgb_picture

# BT.2020 to BT.709, linear light (BT.2087 annex 2).
TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])


def _linear(code: np.ndarray) -> np.ndarray:
    return np.where(code < 0.081, code / 4.5, ((code + 0.099) / 1.099) ** (1 / 0.45))


def _coded(light: np.ndarray) -> np.ndarray:
    light = np.maximum(light, 0)
    return np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 1e-9) ** 0.45 - 0.099)


@pytest.mark.parametrize("rgb", [(16, 12, 8), (20, 18, 24), (28, 26, 25), (14, 16, 10)])
def test_colours_inside_the_smaller_gamut_are_kept(rgb: tuple[int, int, int]) -> None:
    code = np.array(rgb) / (NODES - 1)
    wanted = 255 * _coded(TO_709 @ _linear(code))
    assert np.abs(wanted - 255 * code).max() > 1  # it is no identity
    np.testing.assert_allclose(255 * bt709_table(1, 9)[rgb[2], rgb[1], rgb[0]], wanted, atol=3)


@pytest.mark.parametrize("transfer", [16, 18])
def test_hdr_greys_rise_from_black_to_white_without_a_tint(transfer: int) -> None:
    diagonal = np.arange(NODES)
    grey = 255 * bt709_table(transfer, 9)[diagonal, diagonal, diagonal]
    assert np.ptp(grey, axis=1).max() < 1
    level = grey.mean(axis=1)
    assert level[0] < 1 and level[-1] > 254 and (np.diff(level) > 0).all()
    # Reference white (203 cd/m2, BT.2408) is light, and what is brighter is not all white.
    white = np.interp(0.58 if transfer == 16 else 0.75, diagonal / (NODES - 1), level)
    assert 130 < white < 230


def _picture(colour: tuple[int, int, int], tags: tuple[int, int, int], full: bool = False) -> av.VideoFrame:
    """10-bit 4:2:0 of one YCbCr code."""
    frame = av.VideoFrame(64, 32, "yuv420p10le")
    for plane, value in zip(frame.planes, colour, strict=True):
        plane.update(np.full(plane.buffer_size // 2, value, "<u2").tobytes())
    frame.colorspace, frame.color_primaries, frame.color_trc = tags
    frame.color_range = 2 if full else 1
    frame.pts = 0
    return frame


@pytest.mark.parametrize("transfer", [1, 16, 18])
@pytest.mark.parametrize("luma", [64, 300, 502, 940])
def test_a_picture_goes_through_the_table(transfer: int, luma: int) -> None:
    frame = _picture((luma, 512, 512), (9, 9, transfer))
    assert needs_mapping(frame)
    code = (luma - 64) / 876 * (NODES - 1)
    diagonal = np.arange(NODES)
    wanted = 255 * np.interp(code, diagonal, bt709_table(transfer, 9)[diagonal, diagonal, diagonal, 1])
    for turns, shape in ((0, (32, 64, 3)), (1, (64, 32, 3))):
        seen = rgb_picture(frame, turns)
        assert seen.shape == shape and seen.dtype == np.uint8
        np.testing.assert_allclose(seen.astype(float), wanted, atol=2)


def test_the_range_is_respected_and_pictures_in_a_row_agree() -> None:
    limited, full = (
        rgb_picture(_picture((luma, 512, 512), (9, 9, 18), f), 0) for luma, f in ((502, False), (512, True))
    )
    np.testing.assert_allclose(limited.astype(float), full.astype(float), atol=2)
    levels = [
        int(rgb_picture(_picture((luma, 512, 512), (9, 9, 18)), 0)[5, 5, 1]) for luma in range(100, 900, 100)
    ]
    assert all(a < b for a, b in pairwise(levels))


def test_plain_pictures_are_left_alone() -> None:
    assert not needs_mapping(_picture((502, 512, 512), (1, 1, 1)))
    assert not needs_mapping(_picture((502, 512, 512), (2, 2, 2)))
