"""The search for fixed graphics in a thread: the same masks at the same frames however slow it is; nothing lost."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pipelines.watching import LATER, MASK_EVERY, OverlayWatch

GRAY = np.zeros((4, 6), np.uint8)


class Finder:
    """Counts what it is given; its mask's first cell says how many frames it had seen."""

    def __init__(self, delay_s: float, fails_at: int = -1) -> None:
        self.delay_s, self.fails_at, self.seen = delay_s, fails_at, 0

    def update(self, gray, motion_px):
        time.sleep(self.delay_s)
        self.seen += 1
        if self.seen == self.fails_at:
            raise ValueError("wrong size")

    def mask(self):
        time.sleep(5 * self.delay_s)
        return np.full((1, 1), self.seen)


def masks(delay_s):
    finder, mask, found = Finder(delay_s), None, []
    with ThreadPoolExecutor(1) as thread:
        watch = OverlayWatch(finder, thread)
        for count in range(1, 2 * MASK_EVERY + LATER + 1):
            mask = watch.push(count, GRAY, float("nan") if count == 3 else 1.0, mask)
            found.append(None if mask is None else int(mask[0, 0]))
        watch.settle()
    return finder.seen, found


@pytest.mark.parametrize("delay_s", [0.0, 0.003])
def test_a_mask_holds_from_the_same_frame_on_however_slow_the_search_is(delay_s):
    seen, found = masks(delay_s)
    assert seen == 2 * MASK_EVERY + LATER - 1  # the frame that was not registered is left out
    first = [None] * (MASK_EVERY + LATER - 1) + [MASK_EVERY - 1] * MASK_EVERY + [2 * MASK_EVERY - 1]
    assert found == first


def test_what_fails_in_the_thread_is_raised_when_settled():
    with ThreadPoolExecutor(1) as thread:
        watch = OverlayWatch(Finder(0.0, fails_at=2), thread)
        watch.push(1, GRAY, 1.0, None)
        with pytest.raises(ValueError, match="wrong size"):
            for count in (2, 3):
                watch.push(count, GRAY, 1.0, None)
            watch.settle()
