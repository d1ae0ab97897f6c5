"""Errors of a finished run against a known camera track, with the gauge removed. What the numbers mean is in COLUMNS.

The gauge: the world's axes are the estimate's own choice, so its rotations are turned such that the reference frame of
each shot has its true attitude. Nothing else is fitted: focal lengths, zooms and homographies are compared as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.distortion import undistorted_radius
from calib.rotation import from_pan_tilt_roll, to_pan_tilt_roll
from pipelines.archive import read_camera_csv, read_run
from pipelines.csv_input import read_csv_rows
from pipelines.errors import InputError
from pipelines.records import CameraTable, ShotRecord

FloatArray = NDArray[np.float64]

TRUTH_COLUMNS = ("frame", "f_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "aspect", "k1", "shot")
UNCALIBRATED = ("lost", "graphic")

# Key in the result, heading, format, meaning; the order of the text table.
COLUMNS: tuple[tuple[str, str, str, str], ...] = (
    ("focal_median", "f med %", "%", "median of |f / true f - 1|"),
    ("focal_p95", "f p95 %", "%", "95th percentile of it"),
    ("focal_bias", "f bias %", "%", "mean of f / true f - 1, with its sign"),
    ("focal_std_claimed", "f std %", "%", "median of the error bar that the run states, f_std_px / f_px"),
    ("inside_1_sigma", "in 1 s %", "%", "share of frames whose true f lies within one stated error"),
    ("inside_2_sigma", "in 2 s %", "%", "... within two"),
    ("zoom_rms", "zoom rms %", "%", "rms of log(zoom ratio / true ratio), to the reference frame"),
    ("zoom_max", "zoom max %", "%", "largest of it"),
    ("corner_px", "corner px", ".2f", "rms of corners sent to the reference frame and truly back; undistorted px"),
    ("corner_in_reference_px", "in ref px", ".2f", "the same error measured in the plane of the reference frame"),
    ("transfer_px", "raw px", ".2f", "rms of frame points, through either lens, that the reference frame sees too"),
    ("pan_rms_deg", "pan deg", ".3f", "rms pan error"),
    ("tilt_rms_deg", "tilt deg", ".3f", "rms tilt error"),
    ("roll_rms_deg", "roll deg", ".3f", "rms roll error"),
)  # fmt: skip


def compare_run(out: str | Path, truth: str | Path) -> dict[str, Any]:
    """Errors of the run in folder `out` against the track in the CSV `truth`; JSON-ready, None: not comparable.

    Keys: out, truth, columns (key -> meaning), shots (a dict each: COLUMNS, counts, status, reason), frames.
    Raises InputError: no finished run, a truth column missing, no frame in common.
    """
    out, truth = Path(out), Path(truth)
    run = read_run(out)
    table = read_camera_csv(out / "camera.csv")
    track = read_truth(truth)
    size_px = run.clip["size_px"]
    rows = {int(frame): i for i, frame in enumerate(track["frame"])}
    at = np.array([rows.get(int(frame), -1) for frame in table.frame])
    if not (at >= 0).any():
        raise InputError(truth, "has no frame in common with the run", "give the truth of the same clip")
    # Where the truth ends, there is nothing to say; the count of such frames is in the result.
    usable = {name: np.where(at >= 0, values[at], np.nan) for name, values in track.items()}
    shots = [compare_shot(shot, table, usable, (int(size_px[0]), int(size_px[1]))) for shot in run.shots]
    return {
        "out": str(out),
        "truth": str(truth),
        "columns": {key: meaning for key, _, _, meaning in COLUMNS},
        "shots": shots,
        "frames": {"run": len(table), "truth": len(rows), "both": int((at >= 0).sum())},
    }


def read_truth(path: str | Path) -> dict[str, FloatArray]:
    """Columns of a known track, units as camera.csv. Raises InputError: no file, a column missing, no number."""
    path = Path(path)
    header, rows = read_csv_rows(path, "it must be a CSV of a camera track")
    missing = [name for name in TRUTH_COLUMNS if name not in header]
    if missing or not rows:
        cause = f"has no column {missing[0]}" if missing else "has no rows"
        raise InputError(path, cause, f"it needs {', '.join(TRUTH_COLUMNS)}")
    try:
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in TRUTH_COLUMNS}
    except (TypeError, ValueError) as error:
        raise InputError(path, f"a cell is no number ({error})", "mend that line") from None


def compare_shot(
    shot: ShotRecord, table: CameraTable, truth: Mapping[str, FloatArray], size_px: tuple[int, int]
) -> dict[str, Any]:
    """Errors of one shot. truth: columns aligned with the table's rows, NaN where the truth has no such frame.

    Frames that truly belong to another shot than the reference frame are counted (`wrong_shot`) and left out. The
    reference of a merged shot is a frame of the earlier one: its frames belong where most of them do.
    """
    mine = table.shot == shot.index
    home = shot.index if shot.merged_into is None else shot.merged_into
    reference = np.flatnonzero((table.shot == home) & (table.frame == shot.reference_frame))
    result: dict[str, Any] = {
        "shot": shot.index,
        "status": shot.status,
        "reason": shot.reason,
        "frames": int(mine.sum()),
        "reference_frame": shot.reference_frame,
        **{key: None for key, _, _, _ in COLUMNS},
    }
    known = mine & np.isfinite(truth["f_px"])
    if len(reference) != 1 or not np.isfinite(truth["f_px"][reference[0]]) or not known.any():
        return {**result, "compared": 0, "wrong_shot": 0, "note": "the reference frame is not in the truth"}
    ref = int(reference[0])
    true_shot = truth["shot"][ref] if home == shot.index else np.median(truth["shot"][known])
    wrong = known & (truth["shot"] != true_shot)
    rows = np.flatnonzero(known & ~wrong)
    result |= {"compared": len(rows), "wrong_shot": int(wrong.sum())}
    result["registered"] = int(sum(table.status[i] not in UNCALIBRATED for i in rows))
    result |= _focal_errors(table, truth, rows)
    result |= _zoom_errors(table, truth, rows, ref)
    result |= _rotation_errors(table, truth, rows, ref)
    result |= _homography_errors(table, truth, rows, ref, size_px)
    return result


def _focal_errors(
    table: CameraTable, truth: Mapping[str, FloatArray], rows: NDArray[np.intp]
) -> dict[str, Any]:
    rows = rows[np.isfinite(table.f_px[rows])]
    if not len(rows):
        return {"with_focal": 0}
    f, true = table.f_px[rows], truth["f_px"][rows]
    std = table.f_std_px[rows]
    # A focal without an error bar is inside nothing: claiming no error cannot earn coverage.
    with np.errstate(invalid="ignore"):
        sigmas = np.where(std > 0, np.abs(f - true) / std, np.inf)
    return {
        "with_focal": len(rows),
        "focal_median": float(np.median(np.abs(f / true - 1))),
        "focal_p95": float(np.percentile(np.abs(f / true - 1), 95)),
        "focal_bias": float(np.mean(f / true - 1)),
        "focal_std_claimed": _finite(float(np.median(std / f))),
        "inside_1_sigma": float(np.mean(sigmas <= 1)),
        "inside_2_sigma": float(np.mean(sigmas <= 2)),
    }


def _zoom_errors(
    table: CameraTable, truth: Mapping[str, FloatArray], rows: NDArray[np.intp], ref: int
) -> dict[str, Any]:
    rows = rows[np.isfinite(table.zoom_ratio[rows])]
    if not len(rows):
        return {}
    log_error = np.log(table.zoom_ratio[rows]) - np.log(truth["f_px"][rows] / truth["f_px"][ref])
    return {"zoom_rms": _rms(log_error), "zoom_max": float(np.abs(log_error).max())}


def _rotation_errors(
    table: CameraTable, truth: Mapping[str, FloatArray], rows: NDArray[np.intp], ref: int
) -> dict[str, Any]:
    estimate = _rotations(table.pan_deg, table.tilt_deg, table.roll_deg)
    true = _rotations(truth["pan_deg"], truth["tilt_deg"], truth["roll_deg"])
    rows = rows[np.isfinite(estimate[rows]).all((1, 2))]
    if not len(rows) or not np.isfinite(estimate[ref]).all():
        return {}
    turned = estimate[rows] @ estimate[ref].T @ true[ref]
    names = ("pan_rms_deg", "tilt_rms_deg", "roll_rms_deg")
    errors = {}
    for name, got, wanted in zip(names, to_pan_tilt_roll(turned), to_pan_tilt_roll(true[rows]), strict=True):
        errors[name] = _rms(np.degrees((got - wanted + np.pi) % (2 * np.pi) - np.pi))
    return errors


def _homography_errors(
    table: CameraTable,
    truth: Mapping[str, FloatArray],
    rows: NDArray[np.intp],
    ref: int,
    size_px: tuple[int, int],
) -> dict[str, Any]:
    rows = rows[np.isfinite(table.homography[rows]).all((1, 2))]
    if not len(rows):
        return {}
    w, h = size_px
    corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 5)), -1).reshape(-1, 2)
    true_R = _rotations(truth["pan_deg"], truth["tilt_deg"], truth["roll_deg"])
    true_K = _intrinsics(truth)
    in_frame, in_reference, raw = [], [], []
    for i in rows:
        H = table.homography[i]
        true_H = true_K[ref] @ true_R[ref] @ true_R[i].T @ np.linalg.inv(true_K[i])
        there = _apply(true_H, corners)
        in_reference.append(np.sum((_apply(H, corners) - there) ** 2, -1))
        in_frame.append(np.sum((_apply(np.linalg.inv(H), there) - corners) ** 2, -1))
        raw.append(_raw_transfer(table, truth, int(i), ref, H, true_H, grid, size_px))
    return {
        "corner_px": _finite(float(np.sqrt(np.mean(in_frame)))),
        "corner_in_reference_px": _finite(float(np.sqrt(np.mean(in_reference)))),
        "transfer_px": _root_mean(np.concatenate(raw)),
    }


def _raw_transfer(
    table: CameraTable,
    truth: Mapping[str, FloatArray],
    i: int,
    ref: int,
    H: FloatArray,
    true_H: FloatArray,
    grid: FloatArray,
    size_px: tuple[int, int],
) -> FloatArray:
    """Squared errors, px^2, of the points that the reference frame truly sees; empty where the lens is not known."""
    estimate = {name: getattr(table, name) for name in ("f_px", "cx_px", "cy_px", "aspect", "k1")}
    if not all(np.isfinite(estimate[name][[i, ref]]).all() for name in estimate):
        return np.empty(0)
    truly = _lens(truth, ref, _apply(true_H, _lens(truth, i, grid, undo=True)))
    seen = ((truly > -0.5) & (truly < np.array(size_px) - 0.5)).all(-1)
    back = _lens(estimate, i, _apply(np.linalg.inv(H), _lens(estimate, ref, truly[seen], undo=True)))
    return np.sum((back - grid[seen]) ** 2, -1)


def _lens(
    columns: Mapping[str, FloatArray], i: int, points_px: FloatArray, *, undo: bool = False
) -> FloatArray:
    """Distort undistorted px (m, 2) of frame i, or undo that; OpenCV's k1, radii in units of the focal length."""
    f = float(columns["f_px"][i])
    scale = np.array([f, f / float(columns["aspect"][i])])
    centre = np.array([columns["cx_px"][i], columns["cy_px"][i]])
    xy = (points_px - centre) / scale
    k1 = float(columns["k1"][i])
    r = np.linalg.norm(xy, axis=-1)
    if undo:
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(r > 0, undistorted_radius(r, k1) / r, 1.0)
    else:
        factor = 1 + k1 * r**2
    return xy * factor[:, None] * scale + centre


def _rotations(pan_deg: FloatArray, tilt_deg: FloatArray, roll_deg: FloatArray) -> FloatArray:
    return from_pan_tilt_roll(np.radians(pan_deg), np.radians(tilt_deg), np.radians(roll_deg))


def _intrinsics(truth: Mapping[str, FloatArray]) -> FloatArray:
    K = np.zeros((len(truth["f_px"]), 3, 3))
    K[:, 0, 0] = truth["f_px"]
    K[:, 1, 1] = truth["f_px"] / truth["aspect"]
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = truth["cx_px"], truth["cy_px"], 1.0
    return K


def _apply(H: NDArray[np.floating[Any]], points: FloatArray) -> FloatArray:
    mapped = points @ H[:, :2].T + H[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _root_mean(squares: FloatArray) -> float | None:
    return _finite(float(np.sqrt(np.mean(squares)))) if len(squares) else None


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


# ---- as text


def comparison_table(comparison: Mapping[str, Any]) -> str:
    """The comparison for people: a line a quantity, a column a shot, what each means at the end of its line."""
    shots: Sequence[Mapping[str, Any]] = comparison["shots"]
    lines = [("", [f"shot {shot['shot']}" for shot in shots], "")]
    lines.append(("status", [str(shot["status"]) for shot in shots], ""))
    lines.append(
        ("frames", [f"{shot['compared']}/{shot['frames']}" for shot in shots], "compared / in the shot")
    )
    for key, heading, form, meaning in COLUMNS:
        lines.append((heading, [_shown(shot[key], form) for shot in shots], meaning))
    width = [
        max(len(line[0]) for line in lines),
        max((len(c) for _, cells, _ in lines for c in cells), default=0),
    ]
    return "\n".join(
        f"{name:<{width[0]}}  {'  '.join(f'{cell:>{width[1]}}' for cell in cells)}  {meaning}".rstrip()
        for name, cells, meaning in lines
    )


def _shown(value: float | None, form: str) -> str:
    if value is None:
        return "-"
    return f"{100 * value:.3f}" if form == "%" else f"{value:{form}}"
