"""Which frames hang on verified links: a chain of doubtful registrations may follow the players instead of the ground.

Each doubtful pair looks plausible alone, and a chain of them drifts by tens of per cent without any residual saying so
(seen where players held most of the texture). So a camera counts only if verified pairs lead from it to the reference.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.records import Solution
from mosaic.records import PairFit, PairStatus

BRIDGE_FRAMES = 6  # frames that frame-to-frame steps alone may carry from a verified one
# Rms residual of a frame's pairs beyond which its camera contradicts its pictures: px at W = 1280, times the shot's
# median, and px at W = 1280 whatever the median is. Frames that follow their pictures stay below 3 times the median
# (817 frames of a real clip, 14 generator clips); those that a giant carried off had 4 and more, focals 1 to 5 % wrong.
MISFIT_PX, MISFIT_TIMES, MISFIT_ANY_PX = 1.0, 4.0, 5.0


def contradicted_frames(solution: Solution) -> NDArray[np.bool_]:
    """(n,) bool: frames whose own pairs do not fit their camera; never the reference, which all are related to."""
    px = solution.lens.size_px[0] / 1280
    known = solution.rms_px[np.isfinite(solution.rms_px)]
    usual = float(np.median(known)) if len(known) else np.inf
    limit = min(max(MISFIT_PX * px, MISFIT_TIMES * usual), MISFIT_ANY_PX * px)
    with np.errstate(invalid="ignore"):
        return np.asarray((solution.rms_px > limit) & (solution.frames != solution.reference))


def verified_frames(frames: NDArray[np.int64], fits: Iterable[PairFit], reference: int) -> NDArray[np.bool_]:
    """(n,) bool: frames that pairs of status 'ok', none of them composed, join to the reference frame."""
    root = {int(f): int(f) for f in frames}

    def find(frame: int) -> int:
        while root[frame] != frame:
            root[frame] = root[root[frame]]
            frame = root[frame]
        return frame

    for fit in fits:
        if fit.status == PairStatus.OK and fit.route != "composed" and fit.src in root and fit.dst in root:
            root[find(fit.src)] = find(fit.dst)
    if reference not in root:
        return np.zeros(len(frames), bool)
    home = find(reference)
    return np.array([find(int(f)) == home for f in frames], bool)


def without_doubtful(solution: Solution, fits: Iterable[PairFit]) -> tuple[Solution, set[int]]:
    """The solution with the cameras of unverified frames taken out, and those frames' numbers.

    fits: pairs of keyframes with each other and of frames with keyframes, no frame-to-frame steps. A run of up to
    BRIDGE_FRAMES unverified frames beside a verified one stays: the steps carry that far.
    """
    frames = np.asarray(solution.frames, np.int64)
    good = verified_frames(frames, fits, solution.reference)
    if not good.any():
        return solution, set()
    places = np.flatnonzero(good)
    rows = np.arange(len(frames))
    after = np.searchsorted(places, rows)
    to_next = np.where(after < len(places), places[np.minimum(after, len(places) - 1)] - rows, len(frames))
    to_last = np.where(after > 0, rows - places[np.maximum(after - 1, 0)], len(frames))
    keep = good | (np.minimum(to_next, to_last) <= BRIDGE_FRAMES)
    if keep.all():
        return solution, set()
    return (
        replace(solution, log_f=np.where(keep, solution.log_f, np.nan)),
        {int(f) for f, k, v in zip(frames, keep, solution.log_f, strict=True) if not k and np.isfinite(v)},
    )
