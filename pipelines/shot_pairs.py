"""Pairs of keyframes of different shots: which to compare, features as a start, the direct estimator as the judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.records import Solution
from mosaic.estimator import align
from mosaic.records import PairFit, PairStatus
from mosaic.rescue import match_features
from mosaic.template import prepare
from mosaic.warp import HomographyFamily
from pipelines.kept_shots import KeptShot, ShotShelf

STRUCTURE_GREY = 12.0  # local contrast (standard deviation) of letters and lines; grass has 2 to 5


def spread(solution: Solution, frames: Sequence[int], n: int) -> list[int]:
    """Up to n of the frames, far apart in direction and zoom, the most typical one first; all that are solved, or all
    where none is."""
    rows = {int(f): i for i, f in enumerate(solution.frames)}
    known = [f for f in frames if f in rows and np.isfinite(solution.log_f[rows[f]])]
    if not known:
        return list(frames)[:n]
    at = [rows[f] for f in known]
    width = solution.lens.size_px[0]
    place = np.column_stack(
        [solution.R[at, 2] * np.exp(np.mean(solution.log_f[at])) / width, 2 * solution.log_f[at]]
    )
    away = np.linalg.norm(place[:, None] - place, axis=-1)
    chosen = [int(np.argmin(away.mean(axis=1)))]
    while len(chosen) < min(n, len(known)):
        chosen.append(int(np.argmax(away[:, chosen].min(axis=1))))
    return [known[i] for i in chosen]


def cross_pairs(
    ours: Sequence[int],
    theirs: Sequence[int],
    shots: Mapping[int, KeptShot],
    shelf: ShotShelf,
    *,
    n_first: int,
    enough: int,
) -> tuple[list[PairFit], int, int]:
    """Verified pairs from our keyframes to theirs; how many were compared, and in how many features matched.

    shots: by keyframe. n_first: keyframes of each side after which no more are compared if nothing matched. enough:
    verified pairs at which to stop.
    """
    order = sorted(
        ((a, b) for a in range(len(ours)) for b in range(len(theirs))), key=lambda ab: (max(ab), ab)
    )
    small = {k: scene_only(shots[k].keyframes[k].small, shots[k].mask) for k in (*ours, *theirs)}
    fits: list[PairFit] = []
    n_tried = n_matched = 0
    for a, b in order:
        if (max(a, b) >= n_first and n_matched == 0) or len(fits) >= enough:
            break
        src, dst = ours[a], theirs[b]
        shot = shots[dst]
        n_tried += 1
        H = match_features(*without_common(small[src], small[dst]), shot.size_px)
        if H is None:
            continue
        n_matched += 1
        target = shelf.pyramid(shot, dst)
        # A start from features is good to a px or two: the coarsest levels could only carry it off.
        levels = (2, 1, 0) if len(target.levels) > 2 else (1, 0)
        source = prepare(shots[src].keyframes[src].template, HomographyFamily(size_px=shot.size_px))
        fit, _ = align(source, target, H, dst=dst, levels=levels, options=shot.register, route="across shots")
        if fit.status == PairStatus.OK:
            fits.append(fit)
    return fits, n_tried, n_matched


def scene_only(small: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """A small picture with fixed graphics filled in from around: they match themselves, wherever the camera looks."""
    if mask is None or mask.all() or not mask.any():
        return small
    hidden = cv2.resize((~mask).astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_AREA)
    hidden = cv2.dilate((hidden > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(cv2.inpaint(small, hidden, 3, cv2.INPAINT_TELEA), np.uint8)


def without_common(
    a: NDArray[np.uint8], b: NDArray[np.uint8], side_px: int = 9
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two small pictures without the structure that stands at the same place of the screen in both.

    A graphic that no mask knows (it had appeared for too short a time) would match itself and outvote the scene. Where
    half of all structure stands still the camera itself looks the same way, and nothing is taken out.
    """

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values, (side_px, side_px)), np.float32)

    x, y = a.astype(np.float32), b.astype(np.float32)
    contrast = [np.sqrt(np.maximum(mean(v * v) - mean(v) ** 2, 0)) for v in (x, y)]
    structured = [c > STRUCTURE_GREY for c in contrast]
    same = structured[0] & structured[1] & (mean(np.abs(x - y)) < 0.4 * np.minimum(*contrast))
    if not same.any() or same.sum() > 0.5 * (structured[0] | structured[1]).sum():
        return a, b
    hidden = cv2.dilate(same.astype(np.uint8), np.ones((side_px, side_px), np.uint8))
    a, b = (np.asarray(cv2.inpaint(v, hidden, 3, cv2.INPAINT_TELEA), np.uint8) for v in (a, b))
    return a, b
