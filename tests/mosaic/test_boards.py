"""Boards that change their text are found by it, and shown in pieces that some frame saw."""

from itertools import product

import cv2
import numpy as np

from mosaic.boards import CUT, CUT_UNLIKE, UNLIKE_GREY, column_costs, cut_columns, find_boards, other_text
from mosaic.ground import Witness, decide, evidence
from mosaic.surface import Surface
from tests.mosaic.pinhole import Pinhole

SIZE_PX = (320, 120)
BOARD = np.s_[50:66, :]
TEXTS = ("RIVA AIR FJORDLINE", "QUARZ VELOCE MIRA", "HEXAGON MANGOLD XII", "ALPINA NORDLICHT")


def ground_with(text):
    picture = np.full((SIZE_PX[1], SIZE_PX[0], 3), (70, 120, 60), np.uint8)
    picture[:40] = np.random.default_rng(1).integers(40, 160, (40, SIZE_PX[0], 3))
    picture[BOARD] = (40, 40, 45)
    cv2.putText(picture, text, (3, 63), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (235, 235, 235), 2)
    return picture


def witness(frame, picture):
    placement = Pinhole(frame=frame, size_px=SIZE_PX, f_px=300.0)
    says = evidence(np.zeros(picture.shape[:2], np.float32))
    box = (0.0, 0.0, float(SIZE_PX[0]), float(SIZE_PX[1]))
    return Witness(placement, np.dstack([picture, says]), np.ones(picture.shape[:2], np.uint8), 1, box)


def decided(witnesses):
    surface = Surface(kind="planar", scale_px=300.0, cx=159.5, cy=59.5, width=320, height=120)
    composite = np.median([w.picture[..., :3] for w in witnesses], axis=0).astype(np.uint8)
    return decide(witnesses, composite, np.ones((120, 320), bool), surface, 1)


def test_boards_are_low_long_strips_of_what_is_restless():
    restless = np.zeros((200, 600), bool)
    restless[100:112:2, 100:400:2] = True  # letters
    restless[20:80, 300:420] = True  # bodies pass before a stand
    restless[150:190, 40:44] = True  # a flag post
    restless[np.random.default_rng(0).uniform(size=restless.shape) < 0.005] = True
    boards = find_boards(restless)
    assert boards[102:110, 110:390].all()
    assert not boards[:95].any() and not boards[120:].any()
    assert not find_boards(np.zeros((200, 600), bool)).any()


def test_the_cuts_are_the_cheapest_there_are():
    rng = np.random.default_rng(3)
    n, height, width = 3, 4, 6
    for _ in range(20):
        views = rng.integers(0, 60, (n, height, width, 3)).astype(np.uint8)
        usable, board = rng.uniform(size=(n, height, width)) < 0.9, rng.uniform(size=(height, width)) < 0.9
        costs = rng.uniform(0, 4, (n, width)).astype(np.float32)

        def total(path, views=views, usable=usable, board=board, costs=costs):
            spent = sum(float(costs[a, j]) for j, a in enumerate(path))
            for j in range(1, width):
                a, b = path[j - 1], path[j]
                if a == b:
                    continue
                here = board[:, j - 1 : j + 1]
                both = (usable[a] & usable[b])[:, j - 1 : j + 1]
                apart = np.abs(views[a].astype(int) - views[b])[:, j - 1 : j + 1].mean(axis=-1) / UNLIKE_GREY
                unlike = np.where(both, np.minimum(apart, 1), 0.5)[here]
                spent += CUT + CUT_UNLIKE * (unlike.mean() if here.any() else 0.0)
            return spent

        best = min(total(path) for path in product(range(n), repeat=width))
        assert abs(total(cut_columns(views, usable, board, costs)) - best) < 1e-4


def test_a_switching_board_is_of_one_text():
    boards = [ground_with(text) for text in TEXTS]
    image, _, where = decided([witness(10 * k, boards[k // 2 % 4]) for k in range(16)])
    assert where[BOARD][4:12, 20:150].all()
    off = [np.abs(image[BOARD].astype(int) - board[BOARD]).mean(axis=-1) for board in boards]
    assert min((away > 20).mean() for away in off) < 0.01


def test_nobody_stands_before_the_board():
    boards = [ground_with(text) for text in TEXTS]
    pictures = []
    for k in range(16):
        picture = boards[k // 2 % 4].copy()
        x = 20 + 18 * k  # who runs along the board
        picture[44:90, x : x + 14] = (200, 30, 30)
        pictures.append(picture)
    image, _, _ = decided([witness(10 * k, picture) for k, picture in enumerate(pictures)])
    red = (image[BOARD][..., 0].astype(int) - image[BOARD][..., 1]) > 100
    assert red.mean() < 0.005


def test_columns_that_a_view_does_not_see_cost_most():
    views = np.zeros((2, 20, 8, 3), np.uint8)
    board = np.zeros((20, 8), bool)
    board[8:12] = True
    usable = np.ones((2, 20, 8), bool)
    usable[1, :, 4:] = False
    costs = column_costs(views, usable, np.zeros((20, 8, 3), np.uint8), board)
    assert (costs[0] == 0).all() and (costs[1, 4:] > costs[1, :4]).all()


def test_another_text_counts_nowhere_on_its_board():
    differs = np.zeros((40, 200), bool)
    differs[10:20:2, 20:100:2] = True
    board = np.zeros((40, 200), bool)
    board[8:22] = True
    other = other_text(differs, board)
    assert other[11:19, 25:95].all() and not other[:, 120:].any() and not other[25:].any()
