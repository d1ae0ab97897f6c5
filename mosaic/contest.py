"""Where a frame and the composite differ: which of the two shows an object, and what the ground there looks like.

An object's colour breaks off at its outline, the ground goes on beyond it. Outside the outline of a difference both
pictures agree; the one that agrees with that outside a few pixels further in shows the ground. It needs no plain
ground, nothing known of players, and holds for one frame. Single frames err, so the frames that show ground must also
agree with each other about its colour, at more than one moment, and the picture with that colour put in must pass the
same test. (Stationary against removed objects are told apart by their outlines in surveillance; growing the background
from what is known already is Colombari and Fusiello 2010, patch-based background initialisation.)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

NEAREST_PX, FARTHEST_PX = 3, 5  # steps from inside to outside: over the blur of an edge, still close by
WINDOW_PX = 6.0  # outlines so near speak for a pixel ...
WHOLE = 0.1  # ... and that of its whole region with this weight: deep inside nothing else is there
GHOST = -0.15  # verdict below which a frame is taken to show ground where the composite shows an object
ACCEPTED = -0.1  # verdict below which the composite with the new ground is taken for the better one
SAME_GREY = 16.0  # frames that differ by less show the same ground
MOMENT_FRAMES = 6  # views nearer than this say the same about a place
MOMENTS = 2  # at which the ground must have been seen

Picture = NDArray[np.uint8]
Flags = NDArray[np.bool_]


@numba.njit(cache=True, nogil=True)
def apart(a, b):  # type: ignore[no-untyped-def]
    """Mean difference (h, w) float32 of the channels of two pictures, green twice."""
    out = np.empty(a.shape[:2], np.float32)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            red = abs(np.int32(a[i, j, 0]) - np.int32(b[i, j, 0]))
            green = abs(np.int32(a[i, j, 1]) - np.int32(b[i, j, 1]))
            blue = abs(np.int32(a[i, j, 2]) - np.int32(b[i, j, 2]))
            out[i, j] = np.float32(0.25) * np.float32(red + 2 * green + blue)
    return out


def verdict(
    picture: Picture, other: Picture, labels: NDArray[np.int32], area: NDArray[np.intp]
) -> NDArray[np.float32]:
    """(h, w) in -1..1: + where `picture` shows an object before the ground of `other`, - the other way round.

    picture, other (h, w, 3). labels (h, w): connected regions where they differ, 0 = they agree; area: px of each.
    """
    differs = (labels > 0).astype(np.uint8)
    near = cv2.dilate(differs, np.ones((3, 3), np.uint8))
    both = (cv2.blur(picture, (3, 3)), cv2.blur(other, (3, 3)))
    balance = np.zeros(labels.shape, np.float32)
    total = np.zeros(labels.shape, np.float32)
    _break_off(*both, differs, near, NEAREST_PX, FARTHEST_PX, balance, total)
    if not total.any():
        return balance
    blurred = []
    for plane in (balance, total):
        whole = np.bincount(labels.ravel(), weights=plane.ravel(), minlength=len(area)) / np.maximum(area, 1)
        whole[0] = 0
        around = cv2.GaussianBlur(plane, (0, 0), WINDOW_PX)
        blurred.append(around + np.float32(WHOLE) * whole.astype(np.float32)[labels])
    return np.asarray(blurred[0] / np.maximum(blurred[1], np.float32(1e-3)), np.float32)


@numba.njit(cache=True, nogil=True)
def _break_off(a, b, differs, near, first, last, balance, total):  # type: ignore[no-untyped-def]
    """At each pixel of `differs`, for every pixel `first` to `last` px up, down, left or right of it that is not
    `near` one: squared distance of a, and of b, to b's colour out there. Into balance (a - b) and total (a + b)."""
    height, width = differs.shape
    for i in range(height):
        for j in range(width):
            if differs[i, j] == 0:
                continue
            for side in range(4):
                dy = (side == 2) - (side == 3)
                dx = (side == 0) - (side == 1)
                for n in range(first, last + 1):
                    y, x = i + n * dy, j + n * dx
                    if y < 0 or y >= height or x < 0 or x >= width or near[y, x] != 0:
                        continue
                    for c in range(3):
                        out = np.float32(b[y, x, c])
                        of_a, of_b = np.float32(a[i, j, c]) - out, np.float32(b[i, j, c]) - out
                        balance[i, j] += of_a * of_a - of_b * of_b
                        total[i, j] += of_a * of_a + of_b * of_b


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """accepted (h, w) uint8 over the small surface, 1 where the composite shows an object; ground (h, w, 3): what is
    there instead."""

    accepted: Picture
    ground: Picture


class GroundVote:
    """The colour, at each pixel of a surface, that most of the frames which show ground there agree on.

    Feed it the frames in the order of time. A majority kept in one pass: a frame that agrees adds one, once a moment,
    another one takes one away, and at none the next colour comes in."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._count = np.zeros(shape, np.int16)
        self._ground = np.zeros((*shape, 3), np.uint8)
        self._moment = np.full(shape, -(10**6), np.int32)
        self._hit = np.full(shape, -1, np.int32)  # the last frame that shows ground here, and what it shows
        self._shown = np.zeros((*shape, 3), np.uint8)

    def add(self, frame: int, picture: Picture, ghost: Flags, at_px: NDArray[np.float32]) -> None:
        """picture (h, w, 3) of a frame, where it shows ground and the composite does not (h, w), and where on the
        surface its pixels lie (h, w, 2)."""
        if ghost.any():
            _vote(
                frame, picture, ghost, at_px, self._count, self._ground, self._moment, self._hit, self._shown,
                np.float32(SAME_GREY), MOMENT_FRAMES,
            )  # fmt: skip

    def correct(self, image: Picture, different_grey: float) -> Correction:
        """Where the composite's image (h, w, 3) is to be corrected."""
        agreed = (self._count >= MOMENTS) & (apart(self._ground, image) > different_grey)
        opened = cv2.morphologyEx(agreed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        n, found = cv2.connectedComponents(opened, connectivity=8)
        labels = np.asarray(found, np.int32)
        corrected = np.where(opened[..., None] > 0, self._ground, image)
        better = verdict(corrected, image, labels, np.bincount(labels.ravel(), minlength=n)) < ACCEPTED
        return Correction(((opened > 0) & better).astype(np.uint8), self._ground)


@numba.njit(cache=True, nogil=True)
def _vote(frame, picture, ghost, at, count, ground, moment, hit, shown, same, gap):  # type: ignore[no-untyped-def]
    """Put the ground's pixels to the nearest places of the surface, then let every place vote that was hit or has three
    hits about it: gaps, and a rim of a pixel, which else would break off in the next round's composite."""
    height, width = count.shape
    first_x, first_y, last_x, last_y = width, height, -1, -1
    for i in range(ghost.shape[0]):
        for j in range(ghost.shape[1]):
            if not ghost[i, j]:
                continue
            x, y = int(np.rint(at[i, j, 0])), int(np.rint(at[i, j, 1]))
            if x < 0 or x >= width or y < 0 or y >= height:
                continue
            hit[y, x] = frame
            shown[y, x] = picture[i, j]
            first_x, first_y, last_x, last_y = (
                min(first_x, x),
                min(first_y, y),
                max(last_x, x),
                max(last_y, y),
            )
    colour = np.empty(3, np.int32)
    for y in range(max(first_y - 1, 0), min(last_y + 2, height)):
        for x in range(max(first_x - 1, 0), min(last_x + 2, width)):
            n = 0
            colour[:] = 0
            if hit[y, x] == frame:
                n = 1
                colour[:] = shown[y, x]
            else:
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        if hit[v, u] == frame:
                            n += 1
                            for c in range(3):
                                colour[c] += shown[v, u, c]
                if n < 3:
                    continue
            red, green, blue = colour[0] // n, colour[1] // n, colour[2] // n
            if count[y, x] <= 0:
                ground[y, x, 0], ground[y, x, 1], ground[y, x, 2] = red, green, blue
                count[y, x] = 1
                moment[y, x] = frame
                continue
            off = abs(red - ground[y, x, 0]) + 2 * abs(green - ground[y, x, 1]) + abs(blue - ground[y, x, 2])
            if np.float32(0.25) * np.float32(off) >= same:
                count[y, x] -= 1
            elif frame - moment[y, x] >= gap:
                count[y, x] += 1
                moment[y, x] = frame
