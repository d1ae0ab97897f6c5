"""Where an invented camera looks: a real path smoothed, or keyframes joined. Mathematics only; angles in radians."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.csv_input import read_csv_rows
from pipelines.errors import InputError

FloatArray = NDArray[np.float64]

REACH = 3.0  # sigmas of the kernel that count
KEYS = ("time_s", "pan_deg", "tilt_deg", "hfov_deg")
KEY_CURE = f"it needs {', '.join(KEYS)} (and roll_deg if you like), a row or an object a keyframe"


def smoothed(times_s: ArrayLike, values: ArrayLike, sigma_s: float) -> FloatArray:
    """Values (n, k) at times (n,), each replaced by the line fitted to its neighbours with Gaussian weights.

    A line, not a mean: at both ends of a pan the mean would lag behind. sigma_s > 0, s. Raises ValueError: shapes,
    times that do not rise.
    """
    t, v = np.asarray(times_s, np.float64), np.asarray(values, np.float64)
    if v.ndim != 2 or t.shape != v.shape[:1] or not sigma_s > 0:
        raise ValueError(f"times {t.shape}, values {v.shape}, sigma {sigma_s} do not go together")
    if len(t) > 1 and not (np.diff(t) > 0).all():
        raise ValueError("times do not rise")
    first = np.searchsorted(t, t - REACH * sigma_s)
    last = np.searchsorted(t, t + REACH * sigma_s, side="right")
    out = np.empty_like(v)
    for i, (a, b) in enumerate(zip(first, last, strict=True)):
        d = (t[a:b] - t[i]) / sigma_s
        weight = np.exp(-0.5 * d**2)
        s0, s1, s2 = weight.sum(), weight @ d, weight @ d**2
        spread = s0 * s2 - s1**2
        m0, m1 = weight @ v[a:b], (weight * d) @ v[a:b]
        # Alone, or with neighbours at the same distance only by rounding: the mean.
        out[i] = (s2 * m0 - s1 * m1) / spread if spread > 1e-9 * s0**2 else m0 / s0
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyedMove:
    """Keyframes of a camera move: time_s (n,) rising, pan, tilt, roll (rad) and horizontal field of view (rad)."""

    time_s: FloatArray
    pan_rad: FloatArray
    tilt_rad: FloatArray
    roll_rad: FloatArray
    hfov_rad: FloatArray

    @property
    def duration_s(self) -> float:
        """Seconds from the first keyframe to the last."""
        return float(self.time_s[-1] - self.time_s[0])

    def at(self, seconds: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Pan, tilt, roll and field of view (rad) at times after the first keyframe.

        Cubic pieces that never overshoot a keyframe; the focal length moves evenly in its logarithm, as zooms are felt.
        """
        from scipy.interpolate import PchipInterpolator

        t = np.asarray(seconds, np.float64) + self.time_s[0]
        log_f = -np.log(np.tan(self.hfov_rad / 2))
        columns = (self.pan_rad, self.tilt_rad, self.roll_rad, log_f)
        pan, tilt, roll, zoom = (PchipInterpolator(self.time_s, column)(t) for column in columns)
        return pan, tilt, roll, 2 * np.arctan(np.exp(-zoom))


def read_move(path: Path) -> KeyedMove:
    """Keyframes from a CSV (columns) or a JSON (list of objects) with time_s, pan_deg, tilt_deg, hfov_deg, roll_deg.

    Raises InputError: no such file, fewer than two keyframes, a value missing or impossible, times that do not rise.
    """
    rows: list[dict[str, Any]]
    if path.suffix.lower() == ".json":
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(path, "no such file", "check the path") from None
        except (OSError, ValueError) as error:
            raise InputError(path, f"cannot be read ({error})", KEY_CURE) from None
        if not isinstance(data, list) or not all(isinstance(row, dict) for row in data):
            raise InputError(path, "is not a list of objects", KEY_CURE)
        rows = data
    else:
        rows = list(read_csv_rows(path, KEY_CURE, encoding="utf-8-sig")[1])
    if len(rows) < 2:
        raise InputError(
            path, f"has {len(rows)} keyframe{'' if len(rows) == 1 else 's'}, two are needed", KEY_CURE
        )
    try:
        values = np.array([[float(row[key]) for key in KEYS] for row in rows])
        roll = np.array([float(row.get("roll_deg") or 0.0) for row in rows])
    except KeyError as error:
        raise InputError(path, f"a keyframe lacks {error.args[0]}", KEY_CURE) from None
    except (TypeError, ValueError, csv.Error) as error:
        raise InputError(path, f"a value is no number ({error})", KEY_CURE) from None
    time_s, pan, tilt, hfov = values.T
    if not (np.isfinite(values).all() and np.isfinite(roll).all()):
        raise InputError(path, "a value is not finite", KEY_CURE)
    if not (np.diff(time_s) > 0).all():
        raise InputError(path, "time_s does not rise from keyframe to keyframe", "sort the keyframes")
    if not ((hfov > 0) & (hfov < 170)).all():
        raise InputError(path, "hfov_deg must be between 0 and 170", "it is the width of the view in degrees")
    pan, tilt, roll, hfov = np.radians([pan, tilt, roll, hfov])
    return KeyedMove(time_s=time_s, pan_rad=np.unwrap(pan), tilt_rad=tilt, roll_rad=roll, hfov_rad=hfov)
