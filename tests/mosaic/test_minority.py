"""The scene as a minority of the pixels: found, kept at a fixed scale, held by matches, not claimed elsewhere."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mosaic import pair
from mosaic.coords import normalise_homography, transfer
from mosaic.estimator import RegisterOptions, align, cost_at, judge_minority, settle
from mosaic.minority import AGREE_GREY, SUPPORT, of_matches
from mosaic.pair import REASONS, PairOptions, register
from mosaic.pyramid import Pyramid, build_pyramid
from mosaic.records import PairStatus
from mosaic.rescue import FeatureStart, weak_feature_starts
from mosaic.template import PreparedTemplate, build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, blocks, corner_error_px, grid, homography, picture

OPTIONS = RegisterOptions()
H = homography(14, 6, 1.02, 0.5, 0.01, 0.01)
TURNED = homography(14, 6, 1.02, 0.5, -0.004, -0.0015)  # as a camera of 4 half widths turns


def _crowded(seed: int, share: float, M: np.ndarray = H) -> tuple[np.ndarray, np.ndarray]:
    """Two pictures of one ground, M apart, each with that share of it behind things that move by themselves."""
    return (
        as_uint8(blocks(picture(seed), share, seed + 100), noise=2, seed=1),
        as_uint8(blocks(picture(seed, M), share, seed + 200), noise=2, seed=2),
    )


def _prepared(a: np.ndarray, b: np.ndarray) -> tuple[PreparedTemplate, Pyramid]:
    first, second = (build_pyramid(p, n_levels=3, smooth=True) for p in (a, b))
    template = build_template(first, 0, options=PairOptions().selection)
    return prepare(template, HomographyFamily(size_px=SIZE)), second


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_scene_that_shows_between_moving_things_is_found(seed, monkeypatch):
    a, b = _crowded(seed, 0.55, TURNED)
    fit = register(a, b)
    assert fit.status == PairStatus.WEAK and fit.route in ("minority", "matches") and fit.reason in REASONS
    assert corner_error_px(fit.H_dst_src, TURNED) < 1.0
    monkeypatch.setattr(pair, "_of_minority", lambda source, target, prepared, best, options: (best, 0))
    monkeypatch.setattr(pair, "_of_faint_matches", lambda source, target, prepared, best, options: best)
    monkeypatch.setattr(pair, "_unbent", lambda source, target, prepared, best, levels, options: best)
    before = register(a, b)
    assert not before.usable or corner_error_px(before.H_dst_src, TURNED) > 5.0


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_fixed_scale_keeps_the_truth_that_a_quantile_leaves(seed):
    source, target = _prepared(*_crowded(seed, 0.6))
    kept, _ = settle(source, target, H, levels=(0,), greys=(AGREE_GREY,), options=OPTIONS)
    _, drifted = align(source, target, H, dst=1, levels=(0,), options=OPTIONS)
    assert corner_error_px(kept, H) < 0.2 and corner_error_px(drifted, H) > 0.8
    assert (
        cost_at(source, target, kept, AGREE_GREY, OPTIONS)[0]
        < cost_at(source, target, drifted, AGREE_GREY, OPTIONS)[0]
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_matches_hold_is_the_second_motion_where_a_board_is_the_first(seed):
    """A board over a third of the picture moves by 15 px on its own: both motions are among the starts."""
    usable = grid()[..., 1] > 180
    board = (homography(dx=15), homography())
    a, b = (
        as_uint8(np.where(usable, picture(seed + 40, M), picture(seed, G)), noise=2, seed=seed + k)
        for k, (M, G) in enumerate(zip(board, (None, H), strict=True))
    )
    starts = list(weak_feature_starts(a, b, SIZE, SIZE))
    errors = [[corner_error_px(s.H_dst_src, M) for s in starts] for M in (H, np.linalg.inv(board[0]))]
    assert all(min(e) < 2.0 for e in errors)
    assert all(s.support(s.H_dst_src) == len(s.src_px) >= 12 for s in starts)


def test_between_different_scenes_no_matches_support_anything():
    found = []
    for seed in range(6):
        a, b = as_uint8(picture(seed), noise=2), as_uint8(picture(seed + 20), noise=2, seed=1)
        found += [len(s.src_px) for s in weak_feature_starts(a, b, SIZE, SIZE)]
    assert max(found, default=0) < SUPPORT / 2


def test_a_scene_shows_in_regions_all_over_and_a_wrong_place_does_not():
    source, target = _prepared(*_crowded(1, 0.5))

    def judged(state):
        return judge_minority(
            source, target, state, dst=1, grey=AGREE_GREY, options=OPTIONS, route="minority", n_steps=0,
            supported=False,
        )  # fmt: skip

    right, wrong = judged(H), judged(homography(30, -12))
    assert right.status == PairStatus.WEAK and corner_error_px(right.H_dst_src, H) == 0.0
    assert (wrong.status, wrong.reason) == (PairStatus.FAILED, "score")


def test_without_texture_the_start_comes_back():
    flat = np.full((270, 480), 90, np.uint8)
    source, target = _prepared(flat, flat)
    state, steps = settle(source, target, H, levels=(0,), greys=(AGREE_GREY,), options=OPTIONS)
    assert steps == 0 and np.array_equal(state, H)
    assert list(weak_feature_starts(flat, flat, SIZE, SIZE)) == []


def _matched(rng: np.random.Generator, n: int, px: float) -> FeatureStart:
    """A start at the truth with n matches, each off by a normal deviate of px."""
    src = rng.uniform([40, 40], [SIZE[0] - 40, SIZE[1] - 40], (n, 2))
    dst = transfer(TURNED, src) + px * rng.normal(size=(n, 2))
    return FeatureStart(H_dst_src=TURNED, src_px=src, dst_px=dst, within_px=2.0)


def test_many_matches_are_an_answer_where_no_score_holds_one_and_few_are_none():
    source, target = _prepared(*_crowded(1, 0.75, TURNED))
    lost, _ = align(source, target, homography(60, -40), dst=1, levels=(0,), options=OPTIONS)
    assert lost.status == PairStatus.FAILED
    rng = np.random.default_rng(5)
    found = of_matches(source, target, _matched(rng, SUPPORT, 0.3), lost, OPTIONS)
    assert (found.status, found.reason, found.route) == (PairStatus.WEAK, "minority", "matches")
    assert corner_error_px(found.H_dst_src, TURNED) < 1e-9
    assert of_matches(source, target, _matched(rng, SUPPORT - 1, 0.3), lost, OPTIONS) is lost


def test_matches_replace_an_alignment_that_they_contradict_and_leave_the_better_one():
    source, target = _prepared(
        as_uint8(picture(2), noise=2, seed=1), as_uint8(picture(2, TURNED), noise=2, seed=2)
    )
    right, _ = align(source, target, TURNED, dst=1, levels=(0,), options=OPTIONS)
    start = _matched(np.random.default_rng(6), 80, 0.4)
    assert of_matches(source, target, start, right, OPTIONS) is right
    wrong = replace(right, H_dst_src=homography(-20, 9))
    assert of_matches(source, target, start, wrong, OPTIONS).route == "matches"


def test_the_stated_error_of_matches_is_that_of_their_scatter():
    """Four times the variance of independent matches (TOGETHER), so a chi-square of a quarter for ones that are."""
    source, target = _prepared(*_crowded(1, 0.75, TURNED))
    lost, _ = align(source, target, homography(60, -40), dst=1, levels=(0,), options=OPTIONS)
    chi2 = []
    for seed in range(30):
        start = _matched(np.random.default_rng(seed), 60, 0.5)
        # The least-squares homography of the matches stands where a search would have ended.
        H_ls, _ = cv2.findHomography(start.src_px, start.dst_px, 0)
        fitted = FeatureStart(
            H_dst_src=normalise_homography(H_ls), src_px=start.src_px, dst_px=start.dst_px, within_px=2.0
        )
        fit = of_matches(source, target, fitted, lost, OPTIONS)
        d = (transfer(fit.H_dst_src, fit.anchors_px) - transfer(TURNED, fit.anchors_px)).ravel()
        chi2.append(d @ fit.info @ d / 8)
    assert 0.12 < np.mean(chi2) < 1.0


def test_what_matches_hold_is_not_aligned_again_by_pixels(monkeypatch):
    source, target = _crowded(0, 0.55, TURNED)
    assert register(source, target).route == "matches"
    asked = []
    monkeypatch.setattr(pair, "equally_sharp", lambda *pictures: asked.append(pictures))
    assert register(source, target).route == "matches" and not asked
    register(*(as_uint8(picture(0, M), noise=2, seed=3) for M in (None, TURNED)))
    assert len(asked) == 1
