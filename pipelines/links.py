"""Which frames hang on verified links: a chain of doubtful registrations may follow the players instead of the ground.

Each doubtful pair looks plausible alone, and a chain of them drifts by tens of per cent without any residual saying so
(seen where players held most of the texture). So a camera counts only if verified pairs lead from it to the reference.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
# A frame that fits half as badly is out if its zoom also leaves what the frames about it allow: px at W = 1280 at the
# side of the picture, beyond the line between them and the lines that each side goes on in (a zoom starts or ends).
SUSPECT_PX, SUSPECT_TIMES, DEPARTED_PX = 0.6, 3.0, 3.0
SIDE_FRAMES = 5  # that give a side's rate of zoom


def contradicted_frames(solution: Solution) -> NDArray[np.bool_]:
    """(n,) bool: frames whose own pairs do not fit their camera; never the reference, which all are related to."""
    px = solution.lens.size_px[0] / 1280
    known = solution.rms_px[np.isfinite(solution.rms_px)]
    usual = float(np.median(known)) if len(known) else np.inf
    limit = min(max(MISFIT_PX * px, MISFIT_TIMES * usual), MISFIT_ANY_PX * px)
    with np.errstate(invalid="ignore"):
        out = solution.rms_px > limit
        out |= _leaves_the_line(solution, max(SUSPECT_PX * px, SUSPECT_TIMES * usual))
        return np.asarray(out & (solution.frames != solution.reference))


def _leaves_the_line(solution: Solution, limit_px: float) -> NDArray[np.bool_]:
    """(n,) bool: frames with a residual beyond limit_px whose log f departs from that of the frames about them."""
    solved = np.isfinite(solution.log_f)
    suspect = solved & (solution.rms_px > limit_px) & (solution.frames != solution.reference)
    sound = solved & ~suspect
    if not suspect.any() or sound.sum() < 2:
        return np.zeros(len(solved), bool)
    at, there = solution.frames[sound], solution.log_f[sound]
    out = np.zeros(len(solved), bool)
    for row in np.flatnonzero(suspect):
        frame = solution.frames[row]
        middle = int(np.searchsorted(at, frame))
        allowed = [float(np.interp(frame, at, there))]
        for side in (slice(max(middle - SIDE_FRAMES, 0), middle), slice(middle, middle + SIDE_FRAMES)):
            if len(at[side]) >= 2:
                allowed.append(float(np.polyval(np.polyfit(at[side] - frame, there[side], 1), 0.0)))
        departed = max(min(allowed) - solution.log_f[row], solution.log_f[row] - max(allowed))
        out[row] = departed * 640 > DEPARTED_PX
    return out


def verified_parts(frames: NDArray[np.int64], fits: Iterable[PairFit]) -> NDArray[np.int64]:
    """(n,) one of its own frames for each part that pairs of status 'ok', none of them composed, hold together."""
    root = {int(f): int(f) for f in frames}

    def find(frame: int) -> int:
        while root[frame] != frame:
            root[frame] = root[root[frame]]
            frame = root[frame]
        return frame

    for fit in fits:
        if fit.status == PairStatus.OK and fit.route != "composed" and fit.src in root and fit.dst in root:
            root[find(fit.src)] = find(fit.dst)
    return np.array([find(int(f)) for f in frames], np.int64)


def verified_frames(frames: NDArray[np.int64], fits: Iterable[PairFit], reference: int) -> NDArray[np.bool_]:
    """(n,) bool: frames that are in the reference's part; none where the reference is not among them."""
    parts = verified_parts(frames, fits)
    home = parts[np.asarray(frames) == reference]
    return np.isin(parts, home)


def without_doubtful(
    solution: Solution, fits: Iterable[PairFit], repeats: Mapping[int, int]
) -> tuple[Solution, set[int]]:
    """The solution with the cameras of unverified frames taken out, and those frames' numbers.

    fits: pairs of keyframes with each other and of frames with keyframes, no frame-to-frame steps. repeats: the
    picture that each repeated one repeats, which has no pairs of its own and is as good as that one, however long it
    stands. A run of up to BRIDGE_FRAMES unverified frames beside a verified one stays: the steps carry that far.
    """
    frames = np.asarray(solution.frames, np.int64)
    good = verified_frames(frames, fits, solution.reference)
    verified = set(frames[good].tolist())
    good |= np.array([repeats.get(int(f)) in verified for f in frames], np.bool_)
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
