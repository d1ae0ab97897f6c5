"""What an encoder leaves of itself in pictures, and how far that may displace what they show.

An encoder copies weak texture from frames before, by vectors of a quarter of a pixel that neighbours share: regions of
any size are where the vectors put them, not where the camera saw them, and as the copy is exact no residual shows it.
What shows are the borders of its blocks: the more it copies, the more of them. Only the grid of 8 px is looked for; a
picture that was scaled after coding has another, and its stated error is too small, as it was.
"""

from __future__ import annotations

from typing import Any

import numpy as np

BLOCK_PX = 8
ROWS = 180  # of a picture that are looked at
# Differences count up to so many grey levels: an outline is no border of a block.
MOST_GREY = 15.0
# Of pictures that nobody coded (.013 in the mean over 58 pairs at 360p, standard deviation .004).
UNCODED = 0.015
# Displacement, px a grey level of the residuals and unit of blockiness: under it the errors of 236 pairs at CRF 0 to 35
# are the likeliest (docs/registration.md).
PX_PER_GREY = 0.1
# Columns and rows of the regions that are displaced as a whole: the picture, its quarters, down to the cells.
DISPLACED = ((1, 1), (2, 2), (4, 3), (8, 5))


def blockiness(gray: Any) -> float:
    """Logarithm of how much larger differences of neighbours are across borders of blocks; 0: no blocks are seen.

    gray: (h, w), 0..255, as it was decoded: any smoothing hides the borders. Columns only: lines of a pitch and tiers
    of a stand lie along rows. At CRF 23 .03, at 35 .08 (360p).
    """
    n = (gray.shape[1] - 1) // BLOCK_PX * BLOCK_PX
    if n < 4 * BLOCK_PX:
        return 0.0
    # Some ROWS rows: the borders run through them all.
    picture = np.asarray(gray[:: max(1, gray.shape[0] // ROWS)], np.float32)
    across = np.minimum(np.abs(np.diff(picture, axis=1)[:, :n]), MOST_GREY).mean(axis=0)
    phases = across.reshape(-1, BLOCK_PX).mean(axis=0)
    middle = float(np.median(phases))
    return max(0.0, float(np.log(phases.max() / middle)) - UNCODED) if middle > 0 else 0.0


def displacement_px(blocks_a: float, blocks_b: float, sigma_grey: float) -> float:
    """How far regions of two pictures may be displaced against each other, px; sigma_grey: of residuals that agree."""
    return PX_PER_GREY * sigma_grey * (blocks_a + blocks_b) / 2
