"""What the run knows of its frames beyond camera.csv: rows read one after the other, a pupil before the pan axis.

camera.csv has one camera a frame, that of its middle row. In a fast pan of a rolling shutter the first row belongs to a
camera on its way there (2 px on a real soccer clip), and a pupil in front of the pan axis does not see what the
panorama, which the axis sees, has at that place. Both are found by the run and stated in run.json; everything that maps
pixels to directions takes them from here: rays, pitch, serve, render.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.parallax import Parallax
from calib.rolling_shutter import motion_rates, row_delay
from calib.rotation import from_pan_tilt_roll
from pipelines.pupil_facts import parallax_of
from pipelines.records import CameraTable, RunRecord

FloatArray = NDArray[np.float64]

# Rows beyond the picture have no time: half a picture above and below it, where a pixel is still worth naming.
FARTHEST = 1.0
SETTLED_PX = 1e-7
MOST_ROUNDS = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameGeometry:
    """Aligned with the n rows of camera.csv. share (n,): of the time between pictures from the first picture row to the
    last, 0 where the shot shows no rolling shutter; rates (n, 4): change of log f and left rotation vector (rad) per
    picture, 0 where no neighbour has a camera; parallax: by shot, where a pupil was found; height_px of the pictures.
    """

    share: FloatArray
    rates: FloatArray
    height_px: int
    parallax: Mapping[int, Parallax]

    def late(self, row: ArrayLike, y_px: ArrayLike) -> FloatArray:
        """By how many pictures' time (...) a pixel at y_px (...) was read after its frame's middle; 0 for NaN."""
        where = row_delay(np.nan_to_num(np.asarray(y_px, np.float64)), self.height_px)
        return np.asarray(self.share[np.asarray(row)] * np.clip(where, -FARTHEST, FARTHEST))

    def turn(self, row: ArrayLike, late: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """What the camera did within `late` (...): factor of its focal length (...), left rotation vector (..., 3)."""
        motion = self.rates[np.asarray(row)] * np.asarray(late, np.float64)[..., None]
        return np.exp(motion[..., 0]), motion[..., 1:]

    @property
    def rolling(self) -> bool:
        """Whether any frame's rows see different cameras."""
        return bool(np.any(self.share > 0))


def frame_geometry(run: RunRecord, table: CameraTable) -> FrameGeometry:
    """Of a finished run. Where no rolling shutter was found, or it was refused, a frame has all rows at once."""
    n = len(table)
    share, rates = np.zeros(n), np.zeros((n, 4))
    pupils = {}
    for shot in run.shots:
        pupil = parallax_of(shot.calibration)
        if pupil is not None:
            pupils[shot.index] = pupil
        found = shot.calibration.get("rolling_shutter") or {}
        rows = np.flatnonzero(table.shot == shot.index)
        if not found.get("found") or not len(rows):
            continue
        share[rows] = float(found["share_of_frame"])
        angles = [np.radians(a[rows]) for a in (table.pan_deg, table.tilt_deg, table.roll_deg)]
        with np.errstate(invalid="ignore"):
            moved = motion_rates(table.frame[rows], np.log(table.f_px[rows]), from_pan_tilt_roll(*angles))
        # A frame without a neighbour is taken to stand still, as registration took it.
        rates[rows] = np.where(np.isfinite(moved).all(axis=1, keepdims=True), moved, 0.0)
    height = run.clip.get("size_px", (0, 1))[1] or 1
    return FrameGeometry(share=share, rates=rates, height_px=int(height), parallax=pupils)
