"""A scene between people who fill the picture: its pair, its mask, and no scene where there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.crowd import find_scene, scene_of_pair, settle_scene
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import build_pyramid, with_scene
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import as_uint8, corner_error_px, homography, picture
from tests.synth.clip import ClipSpec, SynthClip
from tests.synth.paths import PathSpec

CROWD = ClipSpec(
    seed=61, width=960, height=540, n_frames=200, n_players=30, player_share=0.4, board_height_m=5.0,
    led_scroll_m_s=2.5, path=PathSpec(pan_deg=25, zoom=1.7, tilt_deg=2.0),
)  # fmt: skip
FIRST = 60


@pytest.fixture(scope="module")
def crowd():
    """Pyramids of two neighbours without a lens, their true H, and the true masks of their players."""
    clip = SynthClip(CROWD)
    frames = [clip.frame(k) for k in (FIRST, FIRST + 1)]
    pyramids = [build_pyramid(cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY)) for f in frames]
    a, b = (clip.cameras[k] for k in (FIRST, FIRST + 1))
    H = b.K @ b.R_cam_world @ a.R_cam_world.T @ np.linalg.inv(a.K)
    return pyramids, H, [f.player_mask for f in frames]


def rms_px(H, H_true):
    return corner_error_px(H, H_true, size_px=(CROWD.width, CROWD.height))


def test_the_scene_is_found_where_most_of_the_picture_is_people(crowd):
    (a, b), H, _ = crowd
    found = find_scene(a, b, None)
    assert found is not None and found.fit.usable and rms_px(found.fit.H_dst_src, H) < 1.0
    prepared = prepare(build_template(a, 0), HomographyFamily(size_px=b.size_px))
    plain, _ = align(prepared, b, np.eye(3), dst=1, options=RegisterOptions())
    assert not plain.usable or rms_px(plain.H_dst_src, H) > 2.0


def test_its_mask_takes_the_strong_edges_of_people_and_leaves_the_ground(crowd):
    (a, b), _, players = crowd
    found = find_scene(a, b, None)
    assert found is not None
    for pyramid, scene, who in zip((a, b), (found.scene.source, found.scene.target), players, strict=True):
        assert scene.shape == (135, 240) and set(np.unique(scene)) <= {0, 1}
        template = build_template(with_scene(pyramid, scene), 0, levels=(0,)).levels[0]
        everyone = build_template(pyramid, 0, levels=(0,)).levels[0]
        of_people, before = (
            who[tuple(np.rint(level.src_px[:, ::-1]).astype(int).T)] for level in (template, everyone)
        )
        assert of_people.sum() < 0.3 * before.sum()
    assert 0.15 < found.share < 0.7


def test_what_moved_before_is_doubted_longer(crowd):
    (a, b), _, _ = crowd
    found = find_scene(a, b, None)
    assert found is not None
    doubtful = np.zeros_like(found.scene.source)
    again = scene_of_pair(a, b, found.fit, doubtful)
    assert again.source.mean() < found.scene.source.mean()
    settled = settle_scene(a, b, found.fit)
    assert settled is not None and rms_px(settled.fit.H_dst_src, found.fit.H_dst_src) < 0.3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_pictures_of_one_still_scene_are_all_scene(seed):
    H = homography(9, -4, 1.01, 0.3)
    a, b = (build_pyramid(as_uint8(picture(seed, M), noise=2, seed=k)) for k, M in enumerate((None, H)))
    found = find_scene(a, b, None)
    assert found is not None and corner_error_px(found.fit.H_dst_src, H) < 0.2
    assert found.scene.source.mean() > 0.97 and found.scene.target.mean() > 0.97


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_different_scenes_have_none_in_common(seed):
    a, b = (build_pyramid(as_uint8(picture(seed + 10 * k), noise=2, seed=k)) for k in (1, 2))
    assert find_scene(a, b, None) is None
