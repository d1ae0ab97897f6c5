"""How long the shutter is open, from pictures smeared by their motion."""

import cv2
import numpy as np
import pytest

from mosaic.pyramid import build_pyramid
from mosaic.records import FlowGrid, PairFit, PairStatus
from pipelines.shutter import Shutter, find_shutter, shutter_facts

SIZE_PX = (640, 360)
SPEEDS = {0: 2.0, 10: 20.0, 20: 4.0, 30: 26.0, 40: 12.0, 50: 30.0, 60: 1.0, 70: 16.0}


def pair(src, dst, H, status=PairStatus.OK):
    return PairFit(
        src=src, dst=dst, H_dst_src=H, status=status, reason="", overlap=1.0, rms_grey=1.0, score=0.2, gain=1.0,
        offset=0.0, n_steps=1, route="keyframe pair", flow=FlowGrid.empty(), anchors_px=np.zeros((4, 2)),
        info=np.eye(8),
    )  # fmt: skip


def shift(dx):
    return np.array([[1.0, 0, dx], [0, 1, 0], [0, 0, 1]])


class Smeared:
    """Pictures of one texture, each 7 px on from the one before, smeared along x by share x speed."""

    def __init__(self, share, noise=1.5, speeds=SPEEDS):
        rng = np.random.default_rng(4)
        wide = cv2.GaussianBlur(rng.normal(0, 1, (360, 900)).astype(np.float32), (0, 0), 1.2)
        self.world = np.clip(128 + 40 * wide / wide.std(), 0, 255)
        self.share, self.noise, self.rng, self.speeds = share, noise, rng, speeds

    def pyramid(self, frame, n_levels, mask):
        length = self.share * self.speeds[frame]
        n = 64
        kernel = np.zeros((1, 2 * n + 1), np.float32)
        x = np.linspace(-length / 2, length / 2, 400)
        for weight, at in ((1 - (x - np.floor(x)), np.floor(x)), (x - np.floor(x), np.floor(x) + 1)):
            np.add.at(kernel[0], at.astype(int) + n, weight.astype(np.float32))
        smeared = cv2.filter2D(self.world, -1, kernel / kernel.sum())
        left = 7 * frame // 10
        picture = smeared[:, left : left + SIZE_PX[0]] + self.rng.normal(0, self.noise, (360, 640))
        gray = np.clip(picture, 0, 255).astype(np.uint8)
        return build_pyramid(gray, n_levels=n_levels, mask=mask)


def found(share, speeds=SPEEDS, **changes):
    frames = sorted(speeds)
    pairs = [pair(a, b, shift(-7 * (b - a) / 10), **changes) for a in frames for b in frames if a < b]
    steps = [pair(k - 1, k, shift(-v)) for k, v in speeds.items()]
    return find_shutter(pairs, steps, Smeared(share, speeds=speeds), SIZE_PX, 4, None)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_the_share_that_pictures_were_smeared_by(share):
    shutter = found(share)
    assert shutter is not None and shutter.n_pairs >= 20
    # At .4 the smear of 12 px is no small change any more: see the module.
    assert shutter.share == pytest.approx(share, abs=max(0.12, 0.25 * share))
    assert abs(shutter.share - share) <= 3 * shutter.share_std + 0.1


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5])
def test_smears_too_small_for_reduced_pictures_are_seen_in_finer_ones(share):
    shutter = found(share, {k: v / 3 for k, v in SPEEDS.items()})
    assert shutter is not None and shutter.share_std < 0.1 + 0.2 * (share == 0)
    assert shutter.share == pytest.approx(share, abs=0.1)


def test_nothing_is_said_of_a_camera_that_moves_alike_or_hardly():
    assert found(0.5, {k: 10.0 for k in SPEEDS}) is None
    assert found(0.5, {k: v / 10 for k, v in SPEEDS.items()}) is None


def test_pairs_that_failed_say_nothing():
    assert found(0.3, status=PairStatus.FAILED) is None


def test_facts_have_nulls_where_nothing_is_known():
    assert shutter_facts(None) == {"share_of_frame": None, "std": None, "pairs": 0}
    known = shutter_facts(Shutter(share=0.25, share_std=0.05, n_pairs=9))
    assert known == {"share_of_frame": 0.25, "std": 0.05, "pairs": 9}
