"""What bodies look like is learned where the ground is certain, and tells them where it is not."""

import cv2
import numpy as np

from mosaic.appearance import MOST, N_CLASSES, classes_of, count_classes, learn

SIZE = (80, 320)
ALL = np.ones(SIZE, bool)
SHIRT = np.array([215, 40, 45], np.uint8)


def ground_picture(seed=1):
    """Grass below, a crowd above: both busy enough to have looks of their own."""
    rng = np.random.default_rng(seed)
    picture = np.empty((*SIZE, 3), np.float32)
    picture[40:] = np.array([60, 140, 50]) + rng.normal(0, 3, (40, 320, 1))
    crowd = cv2.GaussianBlur(rng.normal(0, 1, (40, 320, 3)).astype(np.float32), (0, 0), 1.0)
    picture[:40] = 120 + 60 * crowd / crowd.std()
    return np.clip(picture, 0, 255).astype(np.uint8)


def map_of(shape, x=0, y=0):
    columns, rows = np.meshgrid(x + np.arange(shape[1]), y + np.arange(shape[0]))
    return np.stack([columns, rows], axis=-1).astype(np.float32)


def look_of(shirt=SHIRT):
    before_grass = ground_picture()
    before_grass[50:74, 100:112] = shirt
    where = np.zeros(SIZE, bool)
    where[52:72, 102:110] = True
    moving = count_classes(classes_of(before_grass), where)
    return learn(ground_picture(), ALL, ALL, 30 * moving)


def test_a_shirt_seen_before_grass_is_known_before_the_crowd():
    look, frame = look_of(), ground_picture(seed=2)
    frame[8:32, 200:212] = SHIRT
    ratio = look.ratio(frame, map_of(SIZE))
    assert ratio[12:28, 203:209].max() < -2
    others = np.ones(SIZE, bool)
    others[:48, 180:232] = False
    assert ratio[others].min() > 0 and np.abs(ratio).max() < MOST + 1e-5


def test_ground_of_the_colour_of_a_shirt_is_no_evidence_against_itself():
    board = ground_picture()
    board[16:32] = SHIRT  # a hoarding along the whole row
    where = np.zeros(SIZE, bool)
    where[52:72, 102:110] = True
    body = board.copy()
    body[50:74, 100:112] = SHIRT
    look = learn(board, ALL, ALL, 30 * count_classes(classes_of(body), where))
    # All that moves has its colour, and of what lies round about two thirds: log(2 / 3), and no more.
    assert np.median(look.ratio(board, map_of(SIZE))[22:27]) > -0.6
    assert np.median(look.ratio(body, map_of(SIZE))[56:68, 104:108]) < -2  # and before grass it still is


def test_a_body_in_the_composite_is_no_witness_that_it_is_ground():
    spoilt = ground_picture()
    spoilt[4:36, 40:200] = SHIRT  # a heap that won the median over half of the width
    where = np.zeros(SIZE, bool)
    where[52:72, 102:110] = True
    before_grass = ground_picture()
    before_grass[50:74, 100:112] = SHIRT
    moving = 30 * count_classes(classes_of(before_grass), where)
    doubted = ALL.copy()
    doubted[4:36, 40:200] = False
    ratio = {
        name: np.median(learn(spoilt, ALL, sure, moving).ratio(spoilt, map_of(SIZE))[12:28, 100:140])
        for name, sure in (("doubted", doubted), ("believed", ALL))
    }
    assert ratio["doubted"] < -2 and ratio["doubted"] < ratio["believed"] - 1


def test_where_nobody_was_seen_moving_only_the_ground_speaks():
    nothing = np.zeros(N_CLASSES, np.int64)
    look = learn(ground_picture(), ALL, ALL, nothing)
    assert np.ptp(look.body) == 0
    assert np.median(look.ratio(ground_picture(seed=3), map_of(SIZE))) > 1


def test_frames_are_judged_by_the_ground_where_they_lie():
    look = look_of()
    grass = np.full((24, 40, 3), (60, 140, 50), np.uint8)
    on_grass = look.ratio(grass, map_of((24, 40), x=140, y=50))
    in_crowd = look.ratio(grass, map_of((24, 40), x=140, y=5))
    assert np.median(on_grass) > np.median(in_crowd) + 1
    beyond = look.ratio(grass, map_of((24, 40), x=-1000, y=500))  # of the surface: its nearest cell
    assert np.isfinite(beyond).all()
