"""A fast pan after players who stay in the picture: the ground is found beside them, and nothing right is left."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.estimator import align
from mosaic.level import Linearised
from mosaic.pulled import PulledFamily
from mosaic.pyramid import build_pyramid
from mosaic.rivals import better_of_rivals, look_around, shifted
from mosaic.template import build_template, prepare
from mosaic.verdict import pixel_information
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, blocks, corner_error_px, homography, picture

FAMILY = HomographyFamily(size_px=SIZE)
STILL = np.eye(3)


def pitch(shift_px: float, players_px: float) -> np.ndarray:
    """Lines, marks and lettering on plain grass that ran by shift_px, and players who did by players_px; uint8 (h, w).

    Players move their limbs: in a second picture half of what they look like is new."""
    w, h = SIZE
    ground = np.full((h, w + 400), 90, np.uint8)
    for x in range(40, w + 400, 110):
        cv2.line(ground, (x, 0), (x - 60, h), 200, 3)
    for x in range(10, w + 400, 22):  # yard marks
        for y in (30, 120, 200):
            cv2.line(ground, (x, y), (x + 1, y + 6), 190, 2)
    cv2.putText(ground, "3 0", (160, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.6, 210, 5)
    cv2.putText(ground, "STADIUM", (330, 240), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 40, 4)
    seen = cv2.warpAffine(ground.astype(float), np.array([[1.0, 0, shift_px - 100], [0, 1.0, 0]]), (w, h))
    rng, other = np.random.default_rng(0), np.random.default_rng(1)
    for x, y in ((90, 70), (200, 100), (250, 130), (360, 60), (390, 150)):
        look, moved = (g.uniform(0, 255, (16, 6)) for g in (rng, other))
        patch = cv2.resize(
            0.5 * look + 0.5 * (moved if players_px else look), (36, 96), interpolation=cv2.INTER_CUBIC
        )
        left = round(x + players_px)
        seen[y : y + 96, left : left + 36] = patch
    return as_uint8(cv2.GaussianBlur(seen, (0, 0), 0.8), noise=1.5, seed=abs(round(shift_px)))


def prepared(gray, mask=None):
    return prepare(build_template(build_pyramid(gray, mask=mask), 0), FAMILY)


@pytest.mark.parametrize("shift", [25, -60, 31])
def test_the_ground_is_found_beside_players_who_stay(shift):
    """From rest the direct estimator ends at the players; the sweep leads it to the ground (.1 px)."""
    source, target = prepared(pitch(0, 0)), build_pyramid(pitch(shift, 1))
    fit, state = align(source, target, STILL, dst=1)
    truth = homography(shift)
    assert not fit.usable or corner_error_px(fit.H_dst_src, truth) > 10
    found, _ = better_of_rivals(source, target, fit, state, STILL, levels=(3, 2, 1, 0))
    assert found.usable and found.route == "rival"
    assert corner_error_px(found.H_dst_src, truth) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_a_right_alignment_keeps_its_place(seed):
    """30 % of the picture is foreign, noise 6: whatever the sweep finds, the answer stays where the scene is."""
    H = homography(14, -5, 1.01)
    a, b = (
        as_uint8(blocks(p, 0.3, k), noise=6, seed=k) for k, p in enumerate((picture(seed), picture(seed, H)))
    )
    source, target = prepared(a), build_pyramid(b)
    fit, state = align(source, target, homography(14.5, -5, 1.01), dst=1, levels=(1, 0))
    assert corner_error_px(fit.H_dst_src, H) < 0.6
    found, _ = better_of_rivals(source, target, fit, state, STILL, levels=(3, 2, 1, 0))
    assert corner_error_px(found.H_dst_src, H) < 0.6
    assert found.score <= fit.score


def test_what_is_masked_is_no_rival():
    """A scoreboard over half of the texture stands still; masked, the only minimum is the scene's."""
    rng = np.random.default_rng(5)
    board = cv2.resize(rng.uniform(0, 255, (20, 60)), (300, 120), interpolation=cv2.INTER_CUBIC)
    pictures = [as_uint8(picture(1, H)) for H in (None, homography(40))]
    for gray in pictures:
        gray[20:140, 60:360] = as_uint8(board)
    mask = np.ones(SIZE[::-1], bool)
    mask[15:145, 55:365] = False
    shifts = {}
    for name, usable in (("open", None), ("masked", mask)):
        source = prepared(pictures[0], usable)
        target = build_pyramid(pictures[1], mask=usable)
        shifts[name] = look_around(source, target, STILL).shifts_px
    assert np.abs(shifts["masked"][0] - [40, 0]).max() <= 2
    assert (np.abs(shifts["open"]).max(axis=1) <= 2).any()
    assert not (np.abs(shifts["masked"][:1]).max(axis=1) <= 2).any()


def test_nothing_is_found_in_a_picture_without_texture():
    """A plain picture has no minima, and that is an answer."""
    plain = np.full(SIZE[::-1], 90, np.uint8)
    around = look_around(prepared(plain), build_pyramid(plain), STILL)
    assert len(around.shifts_px) == len(around.costs) == 0


@pytest.mark.parametrize("pulled", [False, True])
def test_any_family_is_moved_by_a_shift(pulled):
    """Eight parameters exactly; with weak ones beside them too."""
    family = PulledFamily(base=FAMILY, size_px=SIZE) if pulled else FAMILY
    state = family.start(homography(3, 2, 1.02)) if pulled else homography(3, 2, 1.02)
    points = family.prepare(np.random.default_rng(0).uniform(0, 270, (40, 2)))
    moved = shifted(family, state, points, np.array([30.0, -12.0]))
    away = family.warp(moved, points)[0] - family.warp(state, points)[0]
    assert np.abs(away - [30.0, -12.0]).max() < 1e-3


def test_a_homography_whose_horizon_meets_an_anchor_has_no_information():
    """It used to raise: on wrong pairs of a fast pan the anchors' covariance is singular."""
    from mosaic import kernels
    from mosaic.coords import default_anchors
    from mosaic.level import LevelPair
    from mosaic.template import mask_arguments

    source, target = prepared(as_uint8(picture(0))), build_pyramid(as_uint8(picture(0)))
    pair = LevelPair(source, target, 0, 1.0, 0.0, mask_arguments(target), kernels.load("numba"), None)
    anchors = default_anchors(SIZE)
    x, _ = anchors[0]
    horizon = np.array([[1.0, 0, 0], [0, 1.0, 0], [1.0 / (x + 1e-9), 0, -1.0 + 1e-13]])
    fine: Linearised = pair.evaluate(STILL)
    info = pixel_information(pair, horizon / np.cbrt(np.linalg.det(horizon)), fine, anchors)
    assert info.shape == (8, 8) and np.isfinite(info).all()
