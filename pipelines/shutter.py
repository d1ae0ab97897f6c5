"""How long the shutter is open, as a share of a frame's time: from how much more fast frames are smeared than slow.

Two frames of one shot that see the same place at unlike speeds differ in sharpness by share^2 (v v' - w w') / 12 px^2,
v and w the picture's motion in a frame's time: the variance of a straight smear. Which frames are sharp enough to show
in a panorama hangs on it, and who composites into the clip smears by it. Generator clips of 960x540 that move by up to
32 px a frame, shares 0, .25, .5: found 0, .25, .57.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib.linear import weighted_median
from mosaic.blur import spread_difference
from mosaic.coords import transfer
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit
from pipelines.chain import centre_motion

if TYPE_CHECKING:
    from pipelines.keyframe_graph import KeyframePictures  # which holds a Shutter itself

MOST_PAIRS = 40  # looked at: those that tell most
# Of difference, were the shutter always open. A difference is found to about 2 px^2 (mosaic/blur.py).
LEAST_PX2, SPREAD_PX2 = 2.0, 2.0
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
    found: list[tuple[float, PairFit, FloatArray]] = []
    for fit in pairs:
        if not fit.usable or fit.src not in speed or fit.dst not in speed or _zooms(fit, size_px):
            continue
        v, w = speed[fit.dst], speed[fit.src]
        open_px2 = (np.outer(v, v) - np.outer(w, w)) / 12
        size = float(np.linalg.norm(open_px2))
        if size >= LEAST_PX2:
            found.append((size, fit, open_px2))
    found.sort(key=lambda one: (-one[0], one[1].src, one[1].dst))
    sizes, ratios = [], []
    known: dict[int, Pyramid] = {}
    for size, fit, open_px2 in found[:MOST_PAIRS]:
        for frame in (fit.src, fit.dst):
            if frame not in known:
                known[frame] = pictures.pyramid(frame, n_levels, mask)
        spread = spread_difference(known[fit.src], known[fit.dst], fit.H_dst_src, fit.gain, fit.offset)
        if spread is not None:
            sizes.append(size)
            ratios.append(float((spread * open_px2).sum()) / size**2)
    if not ratios:
        return None
    weight = np.square(sizes)
    square = float(np.clip(weighted_median(np.array(ratios), weight), 0.0, 1.0))
    # What the measurement leaves, or what the pairs disagree by, whichever is more.
    apart = 1.4826 * float(np.median(np.abs(np.array(ratios) - square))) / np.sqrt(len(ratios))
    std = max(SPREAD_PX2 / float(np.sqrt(weight.sum())), float(apart))
    if std > LARGEST_STD:
        return None
    share = float(np.sqrt(square))
    # Of a root: near 0 the deviation of the square has no slope to go by.
    share_std = float(min(std / (2 * share), np.sqrt(std))) if share > 0 else float(np.sqrt(std))
    return Shutter(share=share, share_std=share_std, n_pairs=len(ratios))


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
