"""Small pictures that the first pass leaves for the panorama's plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mosaic.pyramid import build_pyramid
from pipelines.keyframe_graph import GLANCE_EVERY, GLANCE_PX, KeyframeImages
from pipelines.panorama import LEAST_GLANCES, MOST_GLANCES, glances_of

SIZE_PX = (640, 360)


@pytest.fixture
def images(tmp_path: Path):
    kept = KeyframeImages(tmp_path)
    yield kept
    kept.close()


def ramp(frame: int, dtype: type = np.uint8) -> np.ndarray:
    """Gray that grows by one level in 4 px to the right, from the frame's number on."""
    return np.tile((frame + np.arange(SIZE_PX[0]) // 4).astype(dtype), (SIZE_PX[1], 1))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_every_fourth_frame_leaves_its_mean_over_blocks(images: KeyframeImages, dtype: type) -> None:
    for frame in range(10, 40):
        images.put_glance(frame, build_pyramid(ramp(frame, dtype), n_levels=3, smooth=False))
    assert images.glances == tuple(range(10, 40, GLANCE_EVERY))
    for frame in images.glances:
        small = images.glance(frame)
        assert small.shape == (SIZE_PX[1] * GLANCE_PX // SIZE_PX[0], GLANCE_PX)
        # A block of 4 px is one level of the ramp; halves are rounded twice on the way.
        assert np.abs(small[0].astype(int) - (frame + np.arange(GLANCE_PX))).max() <= 1


def test_glances_and_keyframes_lie_in_one_file_and_do_not_touch(images: KeyframeImages) -> None:
    for frame in range(0, 20, 5):
        pyramid = build_pyramid(ramp(frame), n_levels=3, smooth=False)
        images.put(frame, pyramid)
        images.put_glance(frame, pyramid)
    for frame in range(0, 20, 5):
        assert np.array_equal(images.pyramid(frame, 3, None).levels[0], ramp(frame))
        assert abs(int(images.glance(frame)[0, 50]) - (frame + 50)) <= 1


def test_a_picture_smaller_than_a_glance_is_its_own(images: KeyframeImages) -> None:
    gray = np.arange(100 * 60, dtype=np.uint8).reshape(60, 100)
    images.put_glance(0, build_pyramid(gray, n_levels=2, smooth=False))
    assert np.array_equal(images.glance(0), gray)


def test_the_plan_gets_glances_of_frames_with_a_camera_and_their_masks(
    images: KeyframeImages, tmp_path: Path
) -> None:
    for frame in range(0, 80, GLANCE_EVERY):
        images.put_glance(frame, build_pyramid(ramp(frame), n_levels=3, smooth=False))
    board = np.ones(SIZE_PX[::-1], bool)
    board[:40, :200] = False
    cameras = set(range(0, 40))
    found = glances_of(images, cameras, lambda frame: board if frame == 8 else None, tmp_path)
    assert found is not None
    with found:
        assert found.frames == tuple(range(0, 40, GLANCE_EVERY))
        assert found.trust(4) is None
        trust = found.trust(8)
        assert trust is not None
        assert not trust[:10, :50].any() and trust[12:, :].all() and trust[:, 52:].all()


def test_a_long_shot_is_glanced_at_evenly_and_a_short_one_not_at_all(
    images: KeyframeImages, tmp_path: Path
) -> None:
    n = 3 * MOST_GLANCES
    for k in range(n):
        images.put_glance(GLANCE_EVERY * k, build_pyramid(ramp(k), n_levels=3, smooth=False))
    everything = set(range(GLANCE_EVERY * n))
    found = glances_of(images, everything, lambda _: None, tmp_path)
    assert found is not None
    with found:
        assert len(found.frames) == MOST_GLANCES
        assert np.ptp(np.diff(found.frames)) <= GLANCE_EVERY
    assert (
        glances_of(images, set(range(GLANCE_EVERY * (LEAST_GLANCES - 1))), lambda _: None, tmp_path) is None
    )
