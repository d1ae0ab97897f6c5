"""Boards whose text scrolls or switches: shown in whole pieces, each of one frame, cut where two frames agree.

No colour of such a board comes again often enough to be its ground. Asked pixel by pixel for the likeliest it becomes
the dark between letters with scraps of them, however well neighbours are heard (states.py). So there a frame is chosen
for each column of the board, for all of them at once: one that sees it with nobody before it, and next to it the same
frame or one that differs little along the cut. It is the seam of Agarwala et al. ("Interactive Digital Photomontage",
SIGGRAPH 2004) between columns, where it has an exact answer (Viterbi).
"""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

# px of a picture about 320 wide: gaps between letters and lines that are closed; the least length of a board, and a
# height that it has not. Where bodies pass restless pixels lie in heaps, before a crowd alone.
GAP_PX, LONG_PX, HIGH_PX = (9, 3), 25, 25
RIM_PX = (9, 5)  # by which it is widened: letters reach as far as their board
TEXT_PX, TEXT_SHARE = (15, 7), 0.1  # about a word; share of its pixels that differ in another one
MARGIN_PX = 6  # above and below a board: who stands before it is seen there as well
BODY_GREY = 30.0  # difference from the ground there
MOST_VIEWS = 96  # asked about a board; of more some are left out, evenly
# Costs of a column: none of it seen; bodies all along its margins. And of a cut: any, and one whose pixels all differ
# by UNLIKE_GREY or more.
UNSEEN, BODY = 4.0, 4.0
CUT, CUT_UNLIKE, UNLIKE_GREY = 0.5, 8.0, 40.0

Picture = NDArray[np.uint8]


def find_boards(restless: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where restless pixels (h, w; see states.States) lie in low, long strips."""
    closed = cv2.morphologyEx(
        restless.astype(np.uint8), cv2.MORPH_CLOSE, np.ones(GAP_PX[::-1], np.uint8), borderValue=0
    )
    heaps = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((HIGH_PX, 1), np.uint8), borderValue=0)
    low = np.where(cv2.dilate(heaps, np.ones((1, LONG_PX), np.uint8)) > 0, np.uint8(0), closed)
    long = cv2.morphologyEx(low, cv2.MORPH_OPEN, np.ones((1, LONG_PX), np.uint8), borderValue=0)
    return np.asarray(cv2.dilate(long, np.ones(RIM_PX[::-1], np.uint8)) > 0)


def other_text(differs: NDArray[np.bool_], board: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where a frame shows a board (h, w) with another text: some of its pixels differ, and then none of them counts."""
    share = cv2.blur(differs.astype(np.float32), TEXT_PX)
    return np.asarray(board & (share > TEXT_SHARE))


def column_costs(
    views: Picture, usable: NDArray[np.bool_], image: Picture, board: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """What is against each view (n, h, w, 3) in each column (n, w); usable (n, h, w); image (h, w, 3): the ground about
    the board (h, w)."""
    near = cv2.dilate(board.astype(np.uint8), np.ones((2 * MARGIN_PX + 1, 1), np.uint8)) > 0
    margin = usable & near & ~board
    away = np.abs(views.astype(np.int16) - image).mean(axis=-1) > BODY_GREY
    bodies = (away & margin).sum(axis=1) / np.maximum(margin.sum(axis=1), 1)
    unseen = 1 - (usable & board).sum(axis=1) / np.maximum(board.sum(axis=0), 1)
    return np.asarray(UNSEEN * unseen + BODY * bodies, np.float32)


@numba.njit(cache=True, nogil=True)
def cut_columns(views, usable, board, costs):  # type: ignore[no-untyped-def]
    """The view (w,) of each column for which costs (n, w), and those of the cuts between unlike ones, are least.

    views (n, h, w, 3) uint8; usable (n, h, w), board (h, w) bool."""
    n, _, width = usable.shape
    best = costs[:, 0].copy()
    came = np.zeros((width, n), np.int16)
    total = np.empty(n, np.float32)
    for j in range(1, width):
        least = best.min()
        for a in range(n):
            came[j, a], total[a] = a, best[a]
            if best[a] <= least + CUT:
                continue  # no cut is cheaper
            for b in range(n):
                if best[b] + CUT >= total[a]:
                    continue
                cost = (
                    best[b]
                    + np.float32(CUT)
                    + np.float32(CUT_UNLIKE) * _unlike(views, usable, board, a, b, j)
                )
                if cost < total[a]:
                    total[a], came[j, a] = cost, b
        for a in range(n):
            best[a] = total[a] + costs[a, j]
    chosen = np.zeros(width, np.int64)
    chosen[width - 1] = np.argmin(best)
    for j in range(width - 1, 0, -1):
        chosen[j - 1] = came[j, chosen[j]]
    return chosen


@numba.njit(cache=True, nogil=True)
def _unlike(views, usable, board, a, b, j):  # type: ignore[no-untyped-def]
    """How unlike views a and b are along the cut before column j, 0..1; half where one of them sees nothing."""
    total, count = np.float32(0), 0
    for i in range(board.shape[0]):
        for side in range(j - 1, j + 1):
            if not board[i, side]:
                continue
            count += 1
            if usable[a, i, side] and usable[b, i, side]:
                apart = np.int32(0)
                for c in range(3):
                    apart += abs(np.int32(views[a, i, side, c]) - np.int32(views[b, i, side, c]))
                total += min(np.float32(apart) / np.float32(3 * UNLIKE_GREY), np.float32(1))
            else:
                total += np.float32(0.5)
    return total / np.float32(max(count, 1))
