"""What moves, from small pictures before and after: runners, strollers, uncovered ground, exposure, screen graphics."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.motion import MotionOptions, Neighbour, ScreenFixed, expand_map, still_plane

SIZE = (160, 90)
TIMES = (-100, -50, -25, -12, 12, 25, 50, 100)


def wide_ground(seed=3):
    """A textured ground (150, 400, 3), coarse grain: what a camera pans over."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(70, 130, (30, 80, 3), dtype=np.uint8)
    return cv2.resize(coarse, (400, 150), interpolation=cv2.INTER_CUBIC)


def view(left, objects=(), *, gain=1.0, noise=1.5, seed=0, board=None):
    """A picture with its left border at `left` (whole px) of the ground; objects: (x, y, w, h, colour), ground px."""
    world = wide_ground().astype(np.float32)
    for x, y, w, h, colour in objects:
        world[y : y + h, max(x, 0) : max(x + w, 0)] = colour
    rgb = world[20 : 20 + SIZE[1], left : left + SIZE[0]] * gain
    rgb = rgb + np.random.default_rng([seed, left]).normal(0, noise, rgb.shape)
    picture = np.clip(rgb, 0, 255).astype(np.uint8)
    if board is not None:
        picture[5:17, 10:60] = board
    return picture


def left_at(t):
    return 120 + t // 5


def neighbour(t, picture):
    """Where the pixels of the picture at time 0 lie in the one at time t."""
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    return Neighbour(rgb=picture, frames=t, at_px=np.stack([x + left_at(0) - left_at(t), y], axis=-1))


def judged(objects_at, times=TIMES, gains=None, options=None):
    """still_plane of time 0; objects_at(t) gives the objects."""
    gains = gains or {}
    others = [
        neighbour(t, view(left_at(t), objects_at(t), gain=gains.get(t, 1.0), seed=abs(t))) for t in times
    ]
    return still_plane(view(left_at(0), objects_at(0)), others, options)


def box(x, y, w, h):
    """The part of the picture at time 0 that an object covers."""
    return np.s_[y - 20 : y - 20 + h, x - left_at(0) : x - left_at(0) + w]


@pytest.mark.parametrize("px_per_frame", [3.0, 0.8, 0.3, 0.15])
def test_objects_are_found_from_a_sprint_to_a_stroll(px_per_frame):
    def objects(t):
        return [(int(190 + px_per_frame * t), 50, 10, 26, (230, 40, 40))]

    still = judged(objects)
    here = np.zeros(still.shape, bool)
    here[box(*objects(0)[0][:4])] = True
    away = cv2.dilate(here.astype(np.uint8), np.ones((11, 11))) == 0
    assert (still[here] <= MotionOptions().low).mean() > 0.97
    assert (still[away] == 255).mean() > 0.98


def test_still_ground_stays_trusted_under_changing_exposure():
    still = judged(lambda t: [], gains={t: 1 + 0.002 * t for t in TIMES})
    assert (still == 255).mean() > 0.995


def test_ground_that_was_or_will_be_covered_is_not_distrusted():
    # The object comes to stand at a place after time 0: earlier views show ground there, and so does this one.
    still = judged(lambda t: [(190, 50, 10, 26, (240, 240, 240))] if t > 0 else [])
    assert (still == 255).all()


def test_one_side_alone_says_nothing():
    still = judged(lambda t: [(190 + 3 * t, 50, 10, 26, (230, 40, 40))], times=(12, 25, 50))
    assert (still == 255).all()


def test_a_shirt_of_the_ground_s_brightness_is_seen_by_its_colour():
    grey = (wide_ground() @ np.array([0.299, 0.587, 0.114])).mean()
    red = (170.0, 70.0, (grey - 0.299 * 170 - 0.587 * 70) / 0.114)
    assert 0 < red[2] < 255
    still = judged(lambda t: [(190 + t, 50, 10, 26, red)])
    assert (still[box(190, 50, 10, 26)] <= MotionOptions().low).mean() > 0.95


def looked_at(board, n=12):
    finder = ScreenFixed(SIZE)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    for k in range(n):
        left = 65 + 10 * k
        for shift in (-60, 60):
            later = view(left + shift, board=board)
            at_px = np.stack([x - shift, y], axis=-1)
            finder.look(view(left, board=board), Neighbour(rgb=later, frames=shift, at_px=at_px))
    return finder


def test_a_board_fixed_to_the_screen_is_found_and_nothing_else():
    mask = looked_at((20, 30, 200)).mask()
    assert mask is not None
    assert not mask[5:17, 10:60].any()
    around = np.ones(mask.shape, bool)
    around[1:21, 5:66] = False
    assert mask[around].all()


def test_without_a_board_or_without_motion_nothing_is_fixed():
    assert looked_at(None).mask() is None
    finder = ScreenFixed(SIZE)
    picture = view(130, board=(20, 30, 200))
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    assert not finder.look(picture, Neighbour(rgb=picture, frames=12, at_px=np.stack([x + 1, y], axis=-1)))
    assert finder.mask() is None


def test_a_map_given_on_a_grid_is_linear_in_between():
    rows, columns = np.meshgrid(np.arange(7) * 16.0, np.arange(11) * 16.0, indexing="ij")
    nodes = np.stack([2 * columns + rows, 3.0 - rows], axis=-1)
    at = expand_map(nodes, 16, (150, 85))
    y, x = np.mgrid[0:85, 0:150]
    np.testing.assert_allclose(at, np.stack([2 * x + y, 3.0 - y], axis=-1), atol=1e-3)
