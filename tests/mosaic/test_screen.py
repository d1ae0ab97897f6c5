"""A graphic that has just appeared: the pair that it would hold is set free, and a mask of it grows in a few frames."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.coords import transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import build_pyramid
from mosaic.screen import ScreenVotes, moves_more_widely, without_still
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, homography, picture

BOARD, CAPTION = np.s_[190:240, 90:390], np.s_[8:34, 230:460]  # a lower third; place and event, at the top


def frame(index, step_px, *, board=True, contrast=12.0, mover=None):
    """Frame of a pan over weak texture, a strong graphic fixed on the screen; mover: a box that moves on its own."""
    gray = picture(1, homography(dx=step_px * index), contrast=contrast)
    if board:
        for part in (BOARD, CAPTION):
            gray[part] = picture(2, contrast=60.0, finest_px=1.2)[part]
    if mover is not None:
        x = 60 + round(mover * index)
        gray[60:220, x : x + 110] = picture(3, contrast=50.0)[60:220, 60:170]
    return build_pyramid(as_uint8(gray, noise=1.0, seed=index))


class Translation:
    """As stiff as a camera that is known: eight parameters would bend between graphic and scene."""

    n_parameters = 2

    def prepare(self, src_px):
        return np.ascontiguousarray(src_px)

    def warp(self, state, src):
        one = np.broadcast_to(np.eye(2), (len(src), 2, 2))
        return src + state, np.ascontiguousarray(one, np.float32), np.ascontiguousarray(one)

    def update(self, state, step):
        return state + step


def pair(a, b, start, levels=None, family=None):
    """(template of frame a, fit, state) registered to frame b."""
    template = build_template(a, 0)
    family = family or HomographyFamily(size_px=SIZE)
    fit, state = align(prepare(template, family), b, start, dst=1, levels=levels, options=RegisterOptions())
    return template, fit, state


def shift_of(fit):
    centre = np.array([[SIZE[0] / 2, SIZE[1] / 2]])
    return (transfer(fit.H_dst_src, centre) - centre)[0]


def test_a_pair_held_by_a_graphic_is_set_free():
    a, b = frame(0, 4.0), frame(1, 4.0)
    template, held, state = pair(a, b, np.zeros(2), family=Translation())
    assert np.hypot(*state) < 0.1, "the scene must be one where the graphic holds the plain fit"
    free_template = without_still(template, b, held)
    assert free_template is not None
    free, state = align(prepare(free_template, Translation()), b, np.zeros(2), dst=1)
    assert free.usable
    assert state == pytest.approx([4.0, 0.0], abs=0.15)
    assert moves_more_widely(template, b, held, free)


def test_a_big_player_before_a_resting_camera_is_not_followed():
    a, b = (
        frame(0, 0.0, board=False, contrast=30.0, mover=4.0),
        frame(1, 0.0, board=False, contrast=30.0, mover=4.0),
    )
    template, resting, _ = pair(a, b, np.eye(3))
    assert np.hypot(*shift_of(resting)) < 0.1
    free_template = without_still(template, b, resting)
    if free_template is None:
        return
    follows, _ = align(prepare(free_template, HomographyFamily(size_px=SIZE)), b, homography(dx=4.0), dst=1)
    assert not (follows.usable and moves_more_widely(template, b, resting, follows))


def votes_after(n_pairs, step_px, **look):
    votes = ScreenVotes(SIZE)
    for k in range(n_pairs):
        a, b = frame(k, step_px, **look), frame(k + 1, step_px, **look)
        template, fit, _ = pair(a, b, homography(dx=step_px), levels=(1, 0))
        votes.look(template, b, fit)
    return votes


def test_a_graphic_is_masked_after_a_few_pairs():
    cells = votes_after(5, 4.0, contrast=25.0).mask()
    assert cells is not None
    votes = ScreenVotes(SIZE)
    scene = votes.full_size(cells)
    assert scene.shape == (SIZE[1], SIZE[0])
    board = np.zeros_like(scene)
    board[BOARD] = board[CAPTION] = True
    assert (~scene[board]).mean() > 0.9
    assert (~scene[~board]).mean() < 0.08


@pytest.mark.parametrize(
    ("step_px", "look"), [(4.0, {"board": False, "contrast": 25.0}), (0.0, {"contrast": 25.0})]
)
def test_nothing_is_masked_without_a_graphic_or_without_motion(step_px, look):
    assert votes_after(5, step_px, **look).mask() is None


def test_a_mask_is_doubted_again_when_the_graphic_has_gone():
    votes = votes_after(5, 4.0, contrast=25.0)
    assert votes.mask() is not None
    for k in range(5, 25):
        a, b = frame(k, 4.0, board=False, contrast=25.0), frame(k + 1, 4.0, board=False, contrast=25.0)
        template, fit, _ = pair(a, b, homography(dx=4.0), levels=(1, 0))
        votes.look(template, b, fit)
    assert votes.mask() is None
