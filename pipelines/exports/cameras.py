"""The cameras of one shot as an exporter takes them: every frame of the shot, which of them have a whole camera, and
why the others have not. From camera.csv and run.json; no file is written here and nothing is filled in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.rotation import from_pan_tilt_roll
from pipelines.archive import read_camera_csv, read_run
from pipelines.errors import InputError
from pipelines.records import CameraTable, RunRecord
from pipelines.report.words import reason_words

FloatArray = NDArray[np.float64]

# formats.md: formats that cannot be without millimetres get this width and say that it is nominal. Only ratios matter.
NOMINAL_SENSOR_MM = 9.6

CAMERA = ("f_px", "aspect", "cx_px", "cy_px", "k1", "pan_deg", "tilt_deg", "roll_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """A run of frames without a whole camera: inclusive frame numbers, their status and reason code."""

    first_frame: int
    last_frame: int
    status: str
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False)
class ShotCameras:
    """All n frames of one shot, in order; NaN where a value is not known.

    known (n,) bool: the frame has focal length, principal point, aspect, k1 and attitude. f_px is fx, aspect fx / fy,
    k1 OpenCV's; angles in degrees as in camera.csv, pan continuous (not wrapped). world: what the angles are relative
    to. size_px (w, h) of the frame as decoded. picture_fps: rows per second, fps: the clip's own rate (half of it where
    fields are rows). sensor_width_mm: None = not known. Raises ValueError when columns differ in length.
    """

    clip: str
    identity: str
    shot: int
    reference_frame: int
    world: str
    size_px: tuple[int, int]
    fps: float
    picture_fps: float
    sensor_width_mm: float | None
    why_none: str  # what the run says of a shot that no focal length could be found for
    frame: NDArray[np.int64]
    pts_s: FloatArray
    timecode: tuple[str, ...]
    status: tuple[str, ...]
    reason: tuple[str, ...]
    f_px: FloatArray
    aspect: FloatArray
    cx_px: FloatArray
    cy_px: FloatArray
    k1: FloatArray
    pan_deg: FloatArray
    tilt_deg: FloatArray
    roll_deg: FloatArray

    def __post_init__(self) -> None:
        n = len(self.frame)
        for name in ("pts_s", "timecode", "status", "reason", *CAMERA):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} rows, frame has {n}")

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """(n,) whether a frame has a whole camera."""
        return np.isfinite(np.stack([getattr(self, name) for name in CAMERA])).all(axis=0)

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """Rows of the frames that have a whole camera."""
        return np.flatnonzero(self.known)

    @cached_property
    def R_cam_world(self) -> FloatArray:
        """(n, 3, 3) shot world to camera axes (x right, y down, z forward); NaN where not known."""
        return from_pan_tilt_roll(*np.radians([self.pan_deg, self.tilt_deg, self.roll_deg]))

    @property
    def fy_px(self) -> FloatArray:
        """(n,) vertical focal length, px."""
        return self.f_px / self.aspect

    @property
    def sensor_mm(self) -> float:
        """Sensor width that is written where a format cannot be without one: the known one, else the nominal one."""
        return NOMINAL_SENSOR_MM if self.sensor_width_mm is None else self.sensor_width_mm

    @cached_property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Frames without a whole camera, as runs of the same status and reason."""
        runs = []
        rows = [(i, self.status[i], self.reason[i]) for i in np.flatnonzero(~self.known).tolist()]
        # Rows of a run go up in step with their place in the list, so row minus place is the same throughout.
        for (_, status, reason), run in groupby(enumerate(rows), lambda e: (e[1][0] - e[0], *e[1][1:])):
            members = [row for _, (row, _, _) in run]
            first, last = int(self.frame[members[0]]), int(self.frame[members[-1]])
            runs.append(LeftOut(first_frame=first, last_frame=last, status=status, reason=reason))
        return tuple(runs)

    def largest_distortion_px(self) -> float:
        """Largest shift by the lens distortion at a picture's corner, px; 0 without a camera."""
        if not len(self.rows):
            return 0.0
        w, h = self.size_px
        x = np.array([-0.5, w - 0.5])[:, None, None] - self.cx_px[self.rows]
        y = np.array([-0.5, h - 0.5])[None, :, None] - self.cy_px[self.rows]
        r2 = (x / self.f_px[self.rows]) ** 2 + (y / self.fy_px[self.rows]) ** 2
        return float(np.abs(self.k1[self.rows] * r2 * np.hypot(x, y)).max())

    def largest_pp_offset_px(self) -> float:
        """Largest distance of the principal point from the picture's middle, px; 0 without a camera."""
        if not len(self.rows):
            return 0.0
        w, h = self.size_px
        return float(np.hypot(self.cx_px[self.rows] - (w - 1) / 2, self.cy_px[self.rows] - (h - 1) / 2).max())


def shot_cameras(
    run: RunRecord, table: CameraTable, sensor_width_mm: float | None = None
) -> list[ShotCameras]:
    """The cameras of every shot of a run. sensor_width_mm: None = as the run's configuration says, if it does.

    Raises InputError: the record does not say how large the pictures are.
    """
    if sensor_width_mm is None:
        sensor_width_mm = run.config.get("calibration", {}).get("sensor_width_mm")
    clip = run.clip
    if not clip.get("size_px"):
        raise InputError("run.json", "does not say how large the pictures are", "run again")
    fps = float(clip.get("fps") or 25.0)
    result = []
    for shot in run.shots:
        rows = np.flatnonzero(table.shot == shot.index)
        result.append(
            ShotCameras(
                clip=Path(str(clip.get("path", "clip"))).name,
                identity=str(clip.get("identity", "")),
                shot=shot.index,
                reference_frame=shot.reference_frame,
                world=world_of(shot.calibration)
                + ("" if shot.merged_into is None else f", of shot {shot.merged_into}"),
                size_px=(int(clip["size_px"][0]), int(clip["size_px"][1])),
                fps=fps,
                picture_fps=float(clip.get("picture_fps") or fps),
                sensor_width_mm=sensor_width_mm,
                why_none=(shot.sentence or reason_words(shot.reason)[0]) if shot.reason else "",
                frame=table.frame[rows],
                pts_s=table.pts_s[rows],
                timecode=_texts(table.timecode, rows),
                status=_texts(table.status, rows),
                reason=_texts(table.reason, rows),
                **{name: getattr(table, name)[rows] for name in CAMERA},
            )
        )
    return result


def read_shot_cameras(out: str | Path, sensor_width_mm: float | None = None) -> list[ShotCameras]:
    """The same from the folder of a finished run. Raises InputError: none there, damaged."""
    run = read_run(out)
    return shot_cameras(run, read_camera_csv(Path(out) / "camera.csv"), sensor_width_mm)


def frames_in_no_shot(table: CameraTable) -> list[tuple[int, int]]:
    """First and last frame, inclusive, of every stretch between the shots."""
    rows = np.flatnonzero(table.shot < 0)
    breaks = np.flatnonzero(np.diff(rows) > 1) + 1
    return [(int(table.frame[p[0]]), int(table.frame[p[-1]])) for p in np.split(rows, breaks) if len(p)]


def world_of(calibration: Mapping[str, Any]) -> str:
    """What a shot's angles are relative to, in words."""
    level = calibration.get("level") or {}
    if level.get("observable"):
        return "levelled head frame: y along the pan axis"
    return "axes of the reference frame's camera"


def _texts(column: Sequence[str], rows: NDArray[np.intp]) -> tuple[str, ...]:
    return tuple(column[i] for i in rows)


def plain(value: float) -> str:
    """A float as text that gives the same float back, without numpy's type name. Raises ValueError: not finite."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} has no place in an export")
    return repr(number)
