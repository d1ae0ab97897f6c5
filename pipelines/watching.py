"""The search for fixed graphics in a thread of its own, beside the first pass.

Which mask a frame is prepared with must not depend on how fast threads are: a mask is asked for every MASK_EVERY frames
and taken into use LATER frames after, waited for if need be.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.overlays import OverlayFinder

MASK_EVERY = 25  # frames between two looks for fixed graphics: a look costs as much as registering two frames
LATER = 3

Mask = NDArray[np.bool_] | None


class OverlayWatch:
    """Feed it the first pass's frames in order. Other uses of the finder: settle() before."""

    def __init__(self, finder: OverlayFinder, thread: ThreadPoolExecutor) -> None:
        """thread: of one worker, so that frames are taken in order."""
        self._finder, self._thread = finder, thread
        self._updates: deque[Future[None]] = deque()
        self._asked: tuple[int, Future[Mask]] | None = None

    def push(self, count: int, gray: NDArray[Any], motion_px: float, mask: Mask) -> Mask:
        """Take the count-th frame (from 1) in; returns the mask that holds from here on: `mask`, or a newer one."""
        while self._updates and self._updates[0].done():
            self._updates.popleft().result()
        if np.isfinite(motion_px):
            self._updates.append(self._thread.submit(self._finder.update, gray, motion_px))
        if count % MASK_EVERY == 0:
            self._asked = count, self._thread.submit(self._finder.mask)
        if self._asked is not None and count >= self._asked[0] + LATER:
            mask, self._asked = self._asked[1].result(), None
        return mask

    def settle(self) -> None:
        """Wait until every frame is taken in. Raises what taking one in raised."""
        while self._updates:
            self._updates.popleft().result()
        if self._asked is not None:
            self._asked[1].result()
