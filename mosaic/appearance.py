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
PLAIN, BUSY = (
    14,
    40,
)  # local contrast, grey levels: below the one cloth and grass, above the other letters and crowds
N_CLASSES = LEVELS**3 * 3
CELL_PX = (8, 32)  # rows and columns of the surface whose pixels are counted together
AROUND = (
    1,
    3,
)  # cells up and down, and to both sides, that say what the ground there looks like: it lies in rows
PRIOR = 0.5  # pixels of every class that are taken for seen
MOST = 6.0  # nats that one pixel may say
OUTLINE_PX = (
    2.0  # sigma over which neighbours speak for each other: 1 tells limbs, 3 the trunks of a crowd of bodies
)

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


def learn(composite: Picture, seen: NDArray[np.bool_], moving: NDArray[np.int64]) -> Appearance:
    """The appearance from a composite (h, w, 3), where it was seen (h, w), and counts of what moves (N_CLASSES,)."""
    height, width = seen.shape
    rows, columns = -(-height // CELL_PX[0]), -(-width // CELL_PX[1])
    classes = classes_of(composite)
    cell = np.arange(width) // CELL_PX[1]
    counts = np.zeros((rows, columns, N_CLASSES), np.uint16)  # a cell has 256 pixels
    for row in range(rows):
        band = np.s_[row * CELL_PX[0] : (row + 1) * CELL_PX[0]]
        index = (cell * N_CLASSES + classes[band])[seen[band]]
        counts[row] = np.bincount(index, minlength=columns * N_CLASSES).reshape(columns, N_CLASSES)
    ground = np.empty(counts.shape, np.float16)
    for row in range(rows):
        near = counts[max(row - AROUND[0], 0) : row + AROUND[0] + 1].sum(axis=0, dtype=np.float32)
        wide = np.array([near[max(i - AROUND[1], 0) : i + AROUND[1] + 1].sum(axis=0) for i in range(columns)])
        ground[row] = _log_share(wide)
    return Appearance(body=_log_share(moving[None].astype(np.float32))[0], ground=ground)


def _log_share(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of counts (n, N_CLASSES), neighbouring colours spread into each other by a triangle of three levels."""
    spread = counts.reshape(-1, LEVELS, LEVELS, LEVELS, 3)
    for axis in (1, 2, 3):
        low, high = [0, *range(LEVELS - 1)], [*range(1, LEVELS), LEVELS - 1]
        spread = 0.5 * spread + 0.25 * (np.take(spread, low, axis) + np.take(spread, high, axis))
    flat = spread.reshape(len(counts), N_CLASSES) + PRIOR
    return np.asarray(np.log(flat / flat.sum(axis=1, keepdims=True)), np.float32)
