"""Records of a finished run: what archive, exports, report and compare read. No computation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatColumn = NDArray[np.float64]
IntColumn = NDArray[np.int64]

FRAME_STATUSES = ("ok", "weak", "relative", "interpolated", "lost", "graphic")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraTable:
    """camera.csv in memory: one array or tuple per column, n rows; NaN, -1 (shot) or '' is an empty cell.

    Columns, units and meaning: the README's table of camera.csv. `homography` holds h11 .. h33 row by row:
    this frame's undistorted pixels to the shot's reference frame, det 1. `k1` is OpenCV's coefficient.
    Raises ValueError when a column's length differs from the others.
    """

    frame: IntColumn
    pts_s: FloatColumn
    timecode: tuple[str, ...]
    source_frame: IntColumn
    field: IntColumn  # 0 or 1 of an interlaced source, -1 otherwise (empty in files)
    shot: IntColumn  # -1 between shots
    status: tuple[str, ...]
    reason: tuple[str, ...]
    f_px: FloatColumn
    f_std_px: FloatColumn
    f_stat_px: FloatColumn
    zoom_ratio: FloatColumn
    zoom_ratio_std: FloatColumn
    hfov_deg: FloatColumn
    pan_deg: FloatColumn
    tilt_deg: FloatColumn
    roll_deg: FloatColumn
    cx_px: FloatColumn
    cy_px: FloatColumn
    aspect: FloatColumn
    k1: FloatColumn
    residual_px: FloatColumn
    overlap: FloatColumn
    homography: FloatColumn  # (n, 3, 3)

    def __post_init__(self) -> None:
        n = len(self.frame)
        for column in fields(self):
            value = getattr(self, column.name)
            if len(value) != n:
                raise ValueError(f"column {column.name} has {len(value)} rows, frame has {n}")
            if isinstance(value, np.ndarray):
                frozen = np.array(value, copy=True)
                frozen.setflags(write=False)
                object.__setattr__(self, column.name, frozen)

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShotRecord:
    """One shot of a run, as run.json and the report state it. Values are JSON-ready (None = not known).

    first_frame, last_frame: inclusive output pictures. status: 'ok' (focal claimed), 'relative' (zoom and motion
    only), 'failed'. reason: code and sentence why it is not 'ok'. focal: min/max f_px, their f_std_px, or None.
    calibration: what the calibrator said (sigma parts, s10_px, chi2_dof, lens, level, keyframes, edges).
    panorama: surface, size, files, or None with a reason. files: names relative to OUT.
    status_counts: frames per status. timings_s: seconds per stage. merged_into: the earlier shot whose world and
    reference frame this one's cameras are in (its reference_frame is a frame of that shot), or None.
    """

    index: int
    first_frame: int
    last_frame: int
    reference_frame: int
    status: str
    reason: str
    sentence: str
    focal: Mapping[str, float] | None
    calibration: Mapping[str, Any]
    panorama: Mapping[str, Any] | None
    files: tuple[str, ...]
    status_counts: Mapping[str, int]
    timings_s: Mapping[str, float]
    warnings: tuple[str, ...] = ()
    merged_into: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """run.json: versions, the resolved configuration, facts of the input, shots, timings, warnings. JSON-ready."""

    versions: Mapping[str, str]
    config: Mapping[str, Any]
    clip: Mapping[str, Any]
    shots: tuple[ShotRecord, ...]
    timings_s: Mapping[str, float]
    world: str = "reference camera"
    warnings: tuple[str, ...] = ()
    complete: bool = True
    extra: Mapping[str, Any] = field(default_factory=dict)
