"""Repeated pictures, as conversions from 24 to 30 pictures a second leave them."""

from __future__ import annotations

import statistics
from collections import deque
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

USUAL_OF = 25  # pictures: those that the usual change is the median of
# Mean absolute change in grey levels. Below the first a picture is a repeat, whatever its shot; below the second if it
# is also less than this share of the usual change.
SAME_GREY, NEARLY_GREY, NEARLY_SHARE = 0.02, 0.6, 0.25


class Repeats:
    """Tells a picture that repeats the one before: it differs far less from it than pictures of the shot usually do."""

    def __init__(self) -> None:
        self._changes: deque[float] = deque(maxlen=USUAL_OF)

    def is_repeat(self, before: NDArray[np.generic], picture: NDArray[np.generic]) -> bool:
        """Of two coarse gray pictures (h, w), 0..255; to be asked once for each picture, in order."""
        if before.dtype != picture.dtype:  # images of unlike depth in one folder
            before, picture = before.astype(np.float32), picture.astype(np.float32)
        change = float(cv2.norm(cast(Any, picture), cast(Any, before), cv2.NORM_L1)) / picture.size
        usual = statistics.median(self._changes) if len(self._changes) >= 3 else float("nan")
        if change < SAME_GREY or (change < NEARLY_SHARE * usual and change < NEARLY_GREY):
            return True
        self._changes.append(change)
        return False
