"""Metres on the pitch from a finished run and a few clicks: the pitch camera of a shot, pixels to metres, ball flights.

The frame of the metres: `calib.pitch`; clicks and how they are read: clicks.py; fields: pitch_templates.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.flight import Flight, fit_flight
from calib.pitch import PitchCamera, TrackCamera, fit_pitch_camera
from calib.rotation import exp as rotation_exp
from calib.rotation import from_pan_tilt_roll
from pipelines.archive import read_camera_csv, read_run
from pipelines.clicks import Clicks
from pipelines.errors import InputError
from pipelines.frame_geometry import MOST_ROUNDS, SETTLED_PX, FrameGeometry, frame_geometry
from pipelines.rays import pixel_to_ray, rows_of
from pipelines.records import CameraTable, RunRecord

FloatArray = NDArray[np.float64]

CLICK_STD_PX = 1.0
# Frames of a shot lie beside each other to this, px: an ordinary residual_px of camera.csv. It is added to every click.
ALIGNMENT_STD_PX = 0.3
MISFIT = 6.0  # chi2 per degree of freedom above which clicks and camera contradict each other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pitch:
    """A shot's camera on the pitch. camera: where it stands, with its covariance; table: the run's frames.

    chi2_dof of the camera is about 1 for clicks as good as stated; above 6 `pitch_of` refuses. geometry: of the run;
    rows have their own cameras by it. A pupil before the pan axis is left out: it moves by less than the clicks tell.
    """

    shot: int
    camera: PitchCamera
    table: CameraTable
    reference_frame: int
    clicked_frames: tuple[int, ...]
    pixel_std: float
    geometry: FrameGeometry | None = None

    def to_metres(
        self, frame: ArrayLike, xy_px: ArrayLike, height_m: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Points (n, 2) m at height_m above the pitch of pixels (n, 2) of frames (n,) or one; covariances (n, 2, 2).

        NaN above the horizon and where the frame has no camera. Raises ValueError: a frame that the run lacks.
        """
        xy = np.atleast_2d(np.asarray(xy_px, np.float64))
        frames = np.broadcast_to(np.asarray(frame, np.int64), (len(xy),))
        track = self._track(frames, xy[:, 1])
        points = self.camera.on_plane(track, xy, height_m)
        return points, self.camera.on_plane_cov(track, xy, self.pixel_std, height_m)

    def to_pixels(self, frame: ArrayLike, points_m: ArrayLike) -> FloatArray:
        """Pixels (n, 2) of points (n, 2) on the pitch or (n, 3) above it, in frames (n,) or one; NaN behind it."""
        points = np.atleast_2d(np.asarray(points_m, np.float64))
        if points.shape[1] == 2:
            points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
        frames = np.broadcast_to(np.asarray(frame, np.int64), (len(points),))
        xy = self.camera.project(self._track(frames, None), points)
        if (
            self.geometry is not None and self.geometry.rolling
        ):  # which row sees a point depends on where it is seen
            for _ in range(MOST_ROUNDS):
                before, xy = xy, self.camera.project(self._track(frames, xy[:, 1]), points)
                if not np.nanmax(np.abs(xy - before), initial=0.0) > SETTLED_PX:
                    break
        return xy

    def to_rays(self, points_m: ArrayLike) -> FloatArray:
        """Directions (n, 3) in the shot's own world of points (n, 2) on the pitch, as the run's cameras see them.

        By the clicked frame that has them nearest to its middle: the run's cameras, not the corrected ones, are what
        frames are laid over each other with. Raises ValueError: no clicked frame has them before it.
        """
        best: tuple[float, FloatArray] | None = None
        for frame in self.clicked_frames:
            row = int(rows_of(self.table, frame))
            xy = self.to_pixels(frame, points_m)
            away = float(np.max(np.linalg.norm(xy - [self.table.cx_px[row], self.table.cy_px[row]], axis=1)))
            if np.isfinite(away) and (best is None or away < best[0]):
                best = (away, pixel_to_ray(self.table, frame, xy, self.geometry))
        if best is None or not np.isfinite(best[1]).all():
            raise ValueError("the points lie behind the camera of every clicked frame")
        return best[1]

    def flight(self, frame: ArrayLike, xy_px: ArrayLike, *, pixel_std: float = 1.0) -> Flight:
        """The flight of a ball seen at pixels (n, 2) of frames (n,). Raises ValueError: too few, or no camera."""
        frames, xy = np.asarray(frame, np.int64), np.asarray(xy_px, np.float64)
        if xy.shape != (len(frames), 2):
            raise ValueError(f"pixels {xy.shape} do not go with {len(frames)} frames")
        track = self._track(frames, xy[:, 1])
        times = self.table.pts_s[rows_of(self.table, frames)] + self._late_s(frames, xy[:, 1])
        if not (np.isfinite(track.f_px).all() and np.isfinite(times).all()):
            missing = frames[~(np.isfinite(track.f_px) & np.isfinite(times))][0]
            raise ValueError(f"frame {missing} has no camera or no time")
        std = float(np.hypot(pixel_std, ALIGNMENT_STD_PX))
        return fit_flight(self.camera, track, times, xy, pixel_std=std)

    def _track(self, frames: ArrayLike, y_px: FloatArray | None) -> TrackCamera:
        return track_of(self.table, frames, self.reference_frame, self.geometry, y_px)

    def _late_s(self, frames: NDArray[np.int64], y_px: FloatArray) -> FloatArray:
        """Seconds (n,) by which a pixel's row is read after the middle one; 0 where the rows are read at once."""
        if self.geometry is None or not self.geometry.rolling:
            return np.zeros(len(frames))
        mine = self.table.shot == self.shot
        steps = np.diff(self.table.pts_s[mine]) / np.diff(self.table.frame[mine])
        steps = steps[np.isfinite(steps) & (steps > 0)]
        interval = float(np.median(steps)) if len(steps) else 0.0
        return interval * self.geometry.late(rows_of(self.table, frames), y_px)


def track_of(
    table: CameraTable,
    frames: ArrayLike,
    reference_frame: int,
    geometry: FrameGeometry | None = None,
    y_px: ArrayLike | None = None,
) -> TrackCamera:
    """calib's cameras of frames (n,), as their rows at y_px (n,) were read with a geometry, else the middle rows.

    Angles are relative to the reference frame's, or the first that has one.
    """
    rows = rows_of(table, frames)

    def axes(at: NDArray[np.int64]) -> FloatArray:
        return from_pan_tilt_roll(*np.radians([table.pan_deg[at], table.tilt_deg[at], table.roll_deg[at]]))

    reference = np.atleast_1d(rows_of(table, reference_frame))
    if not np.isfinite(table.pan_deg[reference]).all():
        shot = table.shot[reference[0]]
        known = np.flatnonzero((table.shot == shot) & np.isfinite(table.pan_deg))
        reference = known[:1] if len(known) else reference
    f, k1, R = table.f_px[rows], table.k1[rows], axes(rows)
    if geometry is not None and geometry.rolling and y_px is not None:
        factor, vector = geometry.turn(rows, geometry.late(rows, y_px))
        f, k1, R = f * factor, k1 * factor**2, rotation_exp(vector) @ R
    return TrackCamera(
        f_px=f,
        aspect=table.aspect[rows],
        k1=k1,
        pp_px=np.stack([table.cx_px[rows], table.cy_px[rows]], axis=-1),
        R_cam_world=R,
        R_ref_world=axes(reference)[0],
    )


def pitch_of(
    out: str | Path,
    clicks: Clicks,
    *,
    click_std_px: float = CLICK_STD_PX,
    position_m: Sequence[float] | None = None,
    source: object = "clicks",
) -> Pitch:
    """The pitch camera of a run's shot from clicks. position_m: where the camera stands, if that is known.

    Raises InputError: no run, a frame without a camera, clicks of two shots, too few, in one line, or contradicting.
    """
    run, table = read_run(out), read_camera_csv(Path(out) / "camera.csv")
    return fit_pitch(run, table, clicks, click_std_px=click_std_px, position_m=position_m, source=source)


def fit_pitch(
    run: RunRecord,
    table: CameraTable,
    clicks: Clicks,
    *,
    click_std_px: float = CLICK_STD_PX,
    position_m: Sequence[float] | None = None,
    source: object = "clicks",
) -> Pitch:
    """`pitch_of` with the run's records at hand."""
    try:
        rows = rows_of(table, clicks.frame)
    except ValueError as error:
        known = (
            f"the run has frames {table.frame[0]} to {table.frame[-1]}"
            if len(table)
            else "the run has no frames"
        )
        raise InputError(source, str(error), known) from None
    shots = sorted(set(table.shot[rows].tolist()))
    if len(shots) != 1:
        cause = f"its clicks are in {len(shots)} shots ({', '.join(map(str, shots))}), which have worlds of their own"
        raise InputError(source, cause, "a file for each shot")
    without = clicks.frame[~np.isfinite(table.f_px[rows])]
    if len(without):
        cause = f"frame {without[0]} has no calibrated camera"
        raise InputError(source, cause, "click in frames with a focal length in camera.csv")
    reference = next(s.reference_frame for s in run.shots if s.index == shots[0])
    geometry = frame_geometry(run, table)
    relative = table.f_std_px[rows] / table.f_px[rows]
    focal_std = float(np.median(relative[np.isfinite(relative)])) if np.isfinite(relative).any() else 0.05
    std = float(np.hypot(click_std_px, ALIGNMENT_STD_PX))
    try:
        camera = fit_pitch_camera(
            track_of(table, clicks.frame, reference, geometry, clicks.xy_px[:, 1]),
            clicks.xy_px,
            clicks.XY_m,
            click_std_px=std,
            log_focal_std=max(focal_std, 1e-4),
            position_m=position_m,
            position_std_m=0.1,
        )
    except ValueError as error:
        raise InputError(source, str(error), "click more points, far apart, in X and in Y") from None
    if camera.chi2_dof > MISFIT:
        worst = int(np.argmax(np.linalg.norm(camera.residual_px, axis=1)))
        away = float(np.linalg.norm(camera.residual_px[worst]))
        where = f"point {worst + 1}, in frame {clicks.frame[worst]}"
        cause = f"the clicks contradict each other: {where}, is {away:.1f} px off"
        raise InputError(
            source, cause, "check that point, its metres, and the field's size; or raise --click-px"
        )
    return Pitch(
        shot=shots[0], camera=camera, table=table, reference_frame=reference,
        clicked_frames=tuple(sorted(set(clicks.frame.tolist()))), pixel_std=std, geometry=geometry,
    )  # fmt: skip
