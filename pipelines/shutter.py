"""How long the shutter is open, as a share of a frame's time: from how much more fast frames are smeared than slow.

Two frames of one shot that see the same place at unlike speeds differ in sharpness by share^2 (v v' - w w') / 12 px^2,
v and w the picture's motion in a frame's time: the variance of a straight smear. Which frames are sharp enough to show
in a panorama hangs on it, and who composites into the clip smears by it. Generator clips of 960x540 that move by up to
32 px a frame, shares 0, .25, .5: found 0, .25, .57.

A slow camera's smears are too small to be seen in the reduced pictures that show large ones. Where these leave the
share open it is looked for in finer ones, in pairs that cannot differ by more than those can bear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.linear import weighted_median
from mosaic.blur import COARSE, spread_difference
from mosaic.coords import transfer
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit
from pipelines.chain import centre_motion

if TYPE_CHECKING:
    from pipelines.keyframe_graph import KeyframePictures  # which holds a Shutter itself

MOST_PAIRS = 40  # looked at: those that tell most
LEAST_PX2 = 2.0  # of difference, were the shutter always open
SPREAD_PX2 = (0.25, 0.6, 2.0)  # to what a difference is found on each level of a pyramid (mosaic/blur.py)
FINE_MOST_PX2 = (1.0, 5.0)  # the largest difference that is small enough for the two finer levels
FINE_STD = 0.02  # of the share's square: where it is known less well, the finer levels are asked
FINE_LARGEST = 0.3  # the largest square that is looked for there where the reduced pictures say nothing
FINE_PX = 512  # side of the part of a picture that is looked at
LARGEST_ZOOM = 0.3  # change of log f between the two: a lens, too, is less sharp where it magnifies
LARGEST_STD = 0.15  # of a share's square, beyond which nothing is said
# Taken where nothing is known: the root of the mean square of all shares from 0 to a half, 180 degrees, because cameras
# of sports use any of these.
USUAL = 0.29

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shutter:
    """share: 0 (instant) to 1 (always open); share_std: its standard deviation; n_pairs: that it was found in."""

    share: float
    share_std: float
    n_pairs: int


def find_shutter(
    pairs: Iterable[PairFit],
    steps: Iterable[PairFit],
    pictures: KeyframePictures,
    size_px: tuple[int, int],
    n_levels: int,
    mask: NDArray[np.bool_] | None,
) -> Shutter | None:
    """The shutter of a shot; None where its keyframes move too little, or all alike.

    pairs: of keyframes with each other; steps: of frames with the ones before them; mask (h, w): True = usable."""
    speed = {f.dst: _motion(f, size_px) for f in steps if f.usable}
    sights: list[_Sight] = []
    for fit in pairs:
        if not fit.usable or fit.src not in speed or fit.dst not in speed or _zooms(fit, size_px):
            continue
        v, w = speed[fit.dst], speed[fit.src]
        sights.append(_Sight(fit, (np.outer(v, v) - np.outer(w, w)) / 12))

    @cache
    def pyramid(frame: int) -> Pyramid:
        return pictures.pyramid(frame, n_levels, mask)

    coarse = _measured([(s, COARSE) for s in sights if s.size >= LEAST_PX2], pyramid)
    if coarse is not None and coarse.std <= FINE_STD:
        return coarse.shutter()
    most = FINE_LARGEST if coarse is None else min(coarse.square + 3 * coarse.std, FINE_LARGEST)
    levels = [(s, next((k for k in (0, 1) if s.size * most <= FINE_MOST_PX2[k]), COARSE)) for s in sights]
    fine = _measured([(s, k) for s, k in levels if k < COARSE and s.size >= SPREAD_PX2[k]], pyramid)
    if fine is not None and fine.square <= most and (coarse is None or fine.std < coarse.std):
        return fine.shutter()
    return None if coarse is None else coarse.shutter()


class _Sight(NamedTuple):
    """A pair of keyframes, and by what its point spreads would differ were the shutter always open (2, 2) px^2."""

    fit: PairFit
    open_px2: FloatArray

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.open_px2))


class _Square(NamedTuple):
    """The square of a shutter's share as n pairs show it, and its standard deviation."""

    square: float
    std: float
    n_pairs: int

    def shutter(self) -> Shutter | None:
        if self.std > LARGEST_STD:
            return None
        share = float(np.sqrt(self.square))
        # Of a root: near 0 the deviation of the square has no slope to go by.
        share_std = (
            float(min(self.std / (2 * share), np.sqrt(self.std))) if share > 0 else float(np.sqrt(self.std))
        )
        return Shutter(share=share, share_std=share_std, n_pairs=self.n_pairs)


def _measured(sights: Sequence[tuple[_Sight, int]], pyramid: Callable[[int], Pyramid]) -> _Square | None:
    """What these pairs show, each on its level; None: nothing."""

    def telling(one: tuple[_Sight, int]) -> float:
        return one[0].size / SPREAD_PX2[one[1]]

    ordered = sorted(sights, key=lambda one: (-telling(one), one[0].fit.src, one[0].fit.dst))
    ratios, weights = [], []
    for sight, level in ordered[:MOST_PAIRS]:
        fit, open_px2 = sight.fit, sight.open_px2
        spread = spread_difference(
            pyramid(fit.src), pyramid(fit.dst), fit.H_dst_src, fit.gain, fit.offset,
            level=level, most_px=None if level == COARSE else FINE_PX,
        )  # fmt: skip
        if spread is None:
            continue
        if level < COARSE:
            # The lens and the coder blur all directions alike, and not every frame as much.
            spread, open_px2 = _one_sided(spread), _one_sided(open_px2)
        ratios.append(float((spread * open_px2).sum() / (open_px2**2).sum()))
        weights.append(telling((sight, level)) ** 2)
    if not ratios:
        return None
    square = float(np.clip(weighted_median(np.array(ratios), np.array(weights)), 0.0, 1.0))
    # What the measurement leaves, or what the pairs disagree by, whichever is more.
    apart = 1.4826 * float(np.median(np.abs(np.array(ratios) - square))) / np.sqrt(len(ratios))
    return _Square(square, max(1 / float(np.sqrt(np.sum(weights))), float(apart)), len(ratios))


def _one_sided(px2: FloatArray) -> FloatArray:
    """A covariance (2, 2) without what it has in all directions."""
    return px2 - np.eye(2) * np.trace(px2) / 2


def shutter_facts(shutter: Shutter | None) -> dict[str, Any]:
    """What run.json says; nulls: nothing is known, and USUAL is taken."""
    if shutter is None:
        return {"share_of_frame": None, "std": None, "pairs": 0}
    return {"share_of_frame": shutter.share, "std": shutter.share_std, "pairs": shutter.n_pairs}


def _motion(fit: PairFit, size_px: tuple[int, int]) -> FloatArray:
    """Motion (2,) of the centre in a pair, px."""
    centre = (np.array(size_px, np.float64) - 1) / 2
    return np.asarray(transfer(fit.H_dst_src, centre) - centre)


def _zooms(fit: PairFit, size_px: tuple[int, int]) -> bool:
    _, zoom = centre_motion(fit.H_dst_src, size_px)
    return bool(abs(np.log(zoom)) > LARGEST_ZOOM)
