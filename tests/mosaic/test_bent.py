"""A homography that two motions bend is doubted, the camera's own is looked for, and what no camera made stays ok."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.coords import transfer
from mosaic.estimator import RegisterOptions, cost_at, costs_around
from mosaic.pair import REASONS, PairOptions, register
from mosaic.pyramid import build_pyramid
from mosaic.records import PairStatus
from mosaic.template import build_template, prepare
from mosaic.turning import IMPOSSIBLE, contradiction
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, corner_error_px, grid, homography, look, picture

TURN = homography(4, 1, 1.003, 0.05)
FREE = PairOptions(turning=False)


def _stand_board_ground(
    seed: int, H: np.ndarray | None, board_rows: tuple[int, int], ground_grey: float, runs_px: float
) -> np.ndarray:
    """A stand of 25 grey levels, below it a board of 60 whose content has run by runs_px, below that weak ground."""
    xy = grid() if H is None else transfer(np.linalg.inv(H), grid())
    top, bottom = board_rows
    stand = look(seed, xy, contrast=25)
    board = look(seed + 50, xy - np.array([runs_px, 0.0]), finest_px=4, contrast=60)
    ground = look(seed + 90, xy, contrast=ground_grey)
    return np.where(xy[..., 1] < top, stand, np.where(xy[..., 1] < bottom, board, ground))


def _pair(seed: int, board_rows: tuple[int, int], ground_grey: float, runs_px: float) -> list[np.ndarray]:
    return [
        as_uint8(_stand_board_ground(seed, H, board_rows, ground_grey, runs), noise=2, seed=seed + k)
        for k, (H, runs) in enumerate(((None, 0.0), (TURN, runs_px)))
    ]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_homography_that_is_sheared_between_a_stand_and_a_board_is_doubted(seed):
    """Without a word of cameras it is called ok, 6 px off at the corners."""
    a, b = _pair(seed, (40, 90), 3.0, 1.5)
    fit = register(a, b)
    assert fit.status == PairStatus.WEAK and fit.reason == "bent" and fit.reason in REASONS
    free = register(a, b, options=FREE)
    assert free.status == PairStatus.OK and corner_error_px(free.H_dst_src, TURN) > 4.0


@pytest.mark.parametrize(("board_rows", "ground_grey"), [((80, 120), 4.0), ((55, 85), 3.0)])
def test_the_camera_between_two_motions_a_pixel_or_two_apart_is_found(board_rows, ground_grey):
    a, b = _pair(1, board_rows, ground_grey, 2.0)
    fit = register(a, b)
    assert fit.route == "other motion" and corner_error_px(fit.H_dst_src, TURN) < 0.5
    free = register(a, b, options=FREE)
    assert corner_error_px(free.H_dst_src, TURN) > 4.0


def test_a_plane_that_another_camera_saw_stays_ok():
    """Sheared by 10 px at its side: no camera turns so, but all of the picture agrees."""
    w, h = SIZE
    C = np.array([[w / 2, 0, (w - 1) / 2], [0, w / 2, (h - 1) / 2], [0, 0, 1.0]])
    H = C @ np.array([[1, 0.04, 0.02], [0.04, 1, 0.01], [0.02, 0.03, 1.0]]) @ np.linalg.inv(C)
    a, b = as_uint8(picture(3), noise=2, seed=1), as_uint8(picture(3, H), noise=2, seed=2)
    fit = register(a, b)
    assert contradiction(fit, SIZE, SIZE) > 10 * IMPOSSIBLE
    assert fit.status == PairStatus.OK and corner_error_px(fit.H_dst_src, H) < 0.1


@pytest.mark.parametrize("kernel", ["numba", "torch"])
def test_costs_around_are_those_of_the_shifted_states(kernel):
    a, b = as_uint8(picture(4), noise=2, seed=1), as_uint8(picture(4, TURN), noise=2, seed=2)
    source, target = (build_pyramid(p, n_levels=2, smooth=True) for p in (a, b))
    prepared = prepare(
        build_template(source, 0, options=PairOptions().selection), HomographyFamily(size_px=SIZE)
    )
    options = RegisterOptions(kernel=kernel)
    shifts = np.array([[0.0, 0.0], [1.5, 0.0], [0.0, -2.0]])
    costs = costs_around(prepared, target, TURN, shifts, level=0, grey=4.0, n_pixels=10**6, options=options)
    for cost, (dx, dy) in zip(costs, shifts, strict=True):
        moved = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]]) @ TURN
        # The light is estimated at the unshifted state.
        assert cost == pytest.approx(cost_at(prepared, target, moved, 4.0, options)[0], abs=0.02)
    assert costs[0] < 0.3 * costs[1:].min()
