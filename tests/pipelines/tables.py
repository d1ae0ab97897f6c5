"""Camera tables and records for the tests of archive, compare and the command line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from pipelines.archive import COLUMNS
from pipelines.records import CameraTable, RunRecord, ShotRecord
from tests.synth.camera import SynthCamera

EMPTY = math.nan


def camera_table(n: int, **columns: Any) -> CameraTable:
    """n rows with nothing known, but for `columns`."""
    texts = {name: ("",) * n for name in ("timecode", "status", "reason")}
    counts = {
        "frame": np.arange(n),
        "source_frame": np.arange(n),
        "field": np.full(n, -1),
        "shot": np.zeros(n, int),
    }
    plain = {f.name for f in fields(CameraTable)}
    floats = [name for name, kind, _ in COLUMNS if kind == "float" and name in plain]
    values: dict[str, Any] = {**texts, **counts, **{name: np.full(n, EMPTY) for name in floats}}
    values["homography"] = np.full((n, 3, 3), EMPTY)
    return CameraTable(**{**values, **columns})


def table_of_cameras(cameras: Sequence[SynthCamera], **columns: Any) -> CameraTable:
    """A row a camera of the generator, with nothing else known, but for `columns`."""
    return camera_table(
        len(cameras),
        f_px=np.array([c.f_px for c in cameras]),
        aspect=np.ones(len(cameras)),
        cx_px=np.array([c.cx_px for c in cameras]),
        cy_px=np.array([c.cy_px for c in cameras]),
        k1=np.array([c.k1_opencv for c in cameras]),
        pan_deg=np.degrees([c.pan_rad for c in cameras]),
        tilt_deg=np.degrees([c.tilt_rad for c in cameras]),
        roll_deg=np.degrees([c.roll_rad for c in cameras]),
        **columns,
    )


def shot_record(index: int = 0, **values: Any) -> ShotRecord:
    """A finished shot of ten frames."""
    defaults: dict[str, Any] = {
        "index": index,
        "first_frame": 10 * index,
        "last_frame": 10 * index + 9,
        "reference_frame": 10 * index + 4,
        "status": "ok",
        "reason": "",
        "sentence": "",
        "focal": {"min_px": 2000.0, "max_px": 2500.5, "min_std_px": 20.0, "max_std_px": 25.25},
        "calibration": {"s10_px": 0.5, "lens": {"c0": 0.03, "c1": -0.01}},
        "panorama": None,
        "files": (),
        "status_counts": {"ok": 9, "lost": 1},
        "timings_s": {"register": 1.25},
        "warnings": ("one thing",),
    }
    return ShotRecord(**{**defaults, **values})


def run_record(shots: tuple[ShotRecord, ...] = (), **values: Any) -> RunRecord:
    """A run of those shots."""
    defaults: dict[str, Any] = {
        "versions": {"broadcast-mosaic": "0"},
        "config": {"run": {"resume": False}},
        "clip": {"path": "clip.mp4", "size_px": [640, 360]},
        "shots": shots,
        "timings_s": {"total": 2.5},
    }
    return RunRecord(**{**defaults, **values})
