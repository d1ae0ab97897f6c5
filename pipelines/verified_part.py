"""The part of a shot that verified pairs hold together, solved alone where the rest drags it down.

Players who come to fill the picture make every later link doubtful. Solved together, the doubtful part decides on the
lens that all keyframes share, and the good part is lost with it; solved alone, the good part keeps its cameras.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mosaic.records import PairFit
from pipelines.links import verified_frames, verified_parts

log = logging.getLogger(__name__)

# A shot of which verified pairs join this share of the frames to the reference is solved as a whole.
WHOLE_SHARE = 0.67
LEAST_KEYFRAMES = 2


def largest_verified(frames: Sequence[int], fits: Iterable[PairFit]) -> set[int]:
    """The largest set of frames that pairs of status 'ok', none of them composed, hold together."""
    numbers = np.asarray(sorted(frames), np.int64)
    parts = verified_parts(numbers, fits)
    names, sizes = np.unique(parts, return_counts=True)
    return set(numbers[parts == names[np.argmax(sizes)]].tolist())


def part_to_solve_alone(
    frames: Sequence[int], keyframes: Iterable[int], fits: Sequence[PairFit], reference: int
) -> set[int] | None:
    """Keyframes to be solved without the others, or None where the whole shot hangs together, or nothing does.

    frames: all of the shot that were registered. fits: pairs of keyframes with each other and of frames with keyframes.
    """
    numbers = np.asarray(sorted(frames), np.int64)
    joined: NDArray[np.bool_] = verified_frames(numbers, fits, reference)
    if joined.sum() >= WHOLE_SHARE * len(numbers):
        return None
    best = largest_verified(frames, fits)
    alone = best & set(keyframes)
    if len(best) < joined.sum() or len(alone) < LEAST_KEYFRAMES or alone == set(keyframes):
        return None
    log.debug("verified pairs hold %d of %d frames together; solved alone", len(best), len(numbers))
    return alone
