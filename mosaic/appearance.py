"""What bodies look like in a shot, and what the ground looks like where they pass: which of the two a pixel shows.

Two players may hide a place in most of the frames, but they wear what they wear where the ground is seen well: before
grass, all over the picture. A histogram of those pixels, colour with local contrast, is the look of bodies in this
shot; histograms of the composite round about are the look of the ground there. The ratio of the two tells a white
shirt from a crowd and a red one from a hoarding next to red ones only a little: it is evidence, weighed against how
often a colour comes again (ground.py). Nothing is known in advance of people, kits or pitches.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.motion import local_contrast

LEVELS = 8  # of each channel
# Local contrast, grey levels: cloth and grass below the first, letters and crowds above the second.
PLAIN, BUSY = 14, 40
N_CLASSES = LEVELS**3 * 3
CELL_PX = (8, 32)  # rows and columns of the surface whose pixels are counted together
# Cells up and down, and to both sides, that say what the ground there looks like. It lies in rows, and a heap of bodies
# that won the median must not be the ground's own witness: two widths of a frame to either side.
AROUND = (1, 20)
SURE = 9  # a pixel that is taken for the ground counts as so many that are contested
PRIOR = 0.5  # pixels of every class that are taken for seen
MOST = 6.0  # nats that one pixel may say
# Sigma over which neighbours speak for each other: 1 finds limbs, 3 trunks in a crowd of bodies.
OUTLINE_PX = 2.0

Picture = NDArray[np.uint8]


def classes_of(picture: Picture) -> NDArray[np.int32]:
    """Class 0 .. N_CLASSES - 1 of each pixel of a picture (h, w, 3): colour and local contrast."""
    red, green, blue = np.moveaxis(picture.astype(np.int32) * LEVELS // 256, -1, 0)
    contrast = local_contrast(picture)
    busy = (contrast >= PLAIN).astype(np.int32) + (contrast >= BUSY)
    return np.asarray(((red * LEVELS + green) * LEVELS + blue) * 3 + busy, np.int32)


def count_classes(classes: NDArray[np.int32], where: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many pixels of each class (N_CLASSES,) lie `where`."""
    return np.bincount(classes[where], minlength=N_CLASSES)


class Appearance(NamedTuple):
    """Logarithms of shares: body (N_CLASSES,) of what moves; ground (rows, columns, N_CLASSES) float16 of the composite
    about each cell of CELL_PX."""

    body: NDArray[np.float32]
    ground: NDArray[np.float16]

    def ratio(self, picture: Picture, at: NDArray[np.float32]) -> NDArray[np.float32]:
        """log P(colour | ground there) / P(colour | body) of each pixel (h, w), its neighbours' heard.

        picture (h, w, 3), levelled as the composite is; at (h, w, 2): where on the surface its pixels lie."""
        rows, columns, _ = self.ground.shape
        column, row = (
            np.clip(at[..., i], 0, n * size - 1).astype(np.int32) // size
            for i, (n, size) in enumerate(zip((columns, rows), CELL_PX[::-1], strict=True))
        )
        seen = classes_of(picture)
        says = self.ground[row, column, seen].astype(np.float32) - self.body[seen]
        return np.asarray(cv2.GaussianBlur(np.clip(says, -MOST, MOST), (0, 0), OUTLINE_PX), np.float32)


def learn(
    composite: Picture, seen: NDArray[np.bool_], sure: NDArray[np.bool_], moving: NDArray[np.int64]
) -> Appearance:
    """The appearance from a composite (h, w, 3), where it was seen and where it is taken for the ground (h, w), and
    counts of what moves (N_CLASSES,)."""
    height, width = seen.shape
    rows, columns = -(-height // CELL_PX[0]), -(-width // CELL_PX[1])
    classes = classes_of(composite)
    weight = np.where(seen, np.where(sure, SURE, 1), 0)
    cell = np.arange(width) // CELL_PX[1]
    counts = np.empty((rows, columns, N_CLASSES), np.uint16)  # at most SURE times 256 pixels
    for row in range(rows):
        band = np.s_[row * CELL_PX[0] : (row + 1) * CELL_PX[0]]
        index = cell * N_CLASSES + classes[band]
        counted = np.bincount(index.ravel(), weight[band].ravel(), columns * N_CLASSES)
        counts[row] = counted.reshape(columns, N_CLASSES)
    first = np.maximum(np.arange(columns) - AROUND[1], 0)
    last = np.minimum(np.arange(columns) + AROUND[1] + 1, columns)
    ground = np.empty(counts.shape, np.float16)
    for row in range(rows):
        near = counts[max(row - AROUND[0], 0) : row + AROUND[0] + 1].sum(axis=0, dtype=np.int64)
        before = np.concatenate([np.zeros((1, N_CLASSES), np.int64), np.cumsum(near, axis=0)])
        ground[row] = _log_share((before[last] - before[first]).astype(np.float32) / SURE)
    return Appearance(body=_log_share(moving[None].astype(np.float32))[0], ground=ground)


def _log_share(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of counts (n, N_CLASSES), neighbouring colours spread into each other by a triangle of three levels."""
    spread = counts.reshape(-1, LEVELS, LEVELS, LEVELS, 3)
    for axis in (1, 2, 3):
        low, high = [0, *range(LEVELS - 1)], [*range(1, LEVELS), LEVELS - 1]
        spread = 0.5 * spread + 0.25 * (np.take(spread, low, axis) + np.take(spread, high, axis))
    flat = spread.reshape(len(counts), N_CLASSES) + PRIOR
    return np.asarray(np.log(flat / flat.sum(axis=1, keepdims=True)), np.float32)
