"""Clicked points of a pitch, and a ball's pixels: from a CSV or from rows of Python, with the mistake named.

Clicks have frame, x_px, y_px and either X_m, Y_m or `point`, a name of the template. All of one shot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.csv_input import read_csv_rows
from pipelines.errors import InputError
from pipelines.pitch_templates import PitchTemplate

FloatArray = NDArray[np.float64]

CLICK_CURE = "it needs frame, x_px, y_px and X_m, Y_m (or point, a name of the template)"
BALL_CURE = "it needs frame, x_px, y_px"
NAMED, METRIC = 4, 5  # values in a click: frame, x, y and a name, or X and Y


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clicks:
    """n clicked points: frame (n,), xy_px (n, 2), XY_m (n, 2)."""

    frame: NDArray[np.int64]
    xy_px: FloatArray
    XY_m: FloatArray


def read_clicks(path: Path, template: PitchTemplate | None = None) -> Clicks:
    """A CSV of clicks. Raises InputError: no file, columns or rows; a name that the template lacks."""
    header, rows = read_csv_rows(path, CLICK_CURE, encoding="utf-8-sig")
    names = {name.strip(): name for name in header}
    metric = {"X_m", "Y_m"} <= set(names)
    if not {"frame", "x_px", "y_px"} <= set(names) or not (metric or "point" in names) or not rows:
        raise InputError(path, "has no rows" if not rows else "lacks columns", CLICK_CURE)
    if not metric and template is None:
        raise InputError(path, "names points, but no template was chosen", "add --template")
    points = [_metres(row, names, metric, template, path) for row in rows]
    frame, xy = _frames_and_pixels(path, rows, names, CLICK_CURE)
    return Clicks(frame=frame, xy_px=xy, XY_m=np.array(points))


def clicks_of(rows: Sequence[Sequence[object]], template: PitchTemplate | None = None) -> Clicks:
    """Clicks from rows (frame, x_px, y_px, X_m, Y_m) or (frame, x_px, y_px, name of the template's point).

    Raises InputError: another length, no number, a name that the template lacks.
    """
    frame, xy, points = [], [], []
    for row in rows:
        if len(row) not in (NAMED, METRIC):
            cause = f"a row has {len(row)} values"
            raise InputError(
                "clicks", cause, "it is (frame, x_px, y_px, name) or (frame, x_px, y_px, X_m, Y_m)"
            )
        try:
            numbers = [float(str(value)) for value in (row[:3] if len(row) == NAMED else row)]
        except ValueError as error:
            raise InputError("clicks", f"a value is no number ({error})", CLICK_CURE) from None
        frame.append(int(numbers[0]))
        xy.append(numbers[1:3])
        if len(row) == METRIC:
            points.append((numbers[3], numbers[4]))
            continue
        if template is None:
            raise InputError("clicks", "names points, but no template was chosen", "give template='football'")
        points.append(_named(str(row[3]), template, "clicks"))
    if not frame:
        raise InputError("clicks", "has no rows", CLICK_CURE)
    return Clicks(frame=np.array(frame, np.int64), xy_px=np.array(xy), XY_m=np.array(points))


def read_ball(path: Path) -> tuple[NDArray[np.int64], FloatArray]:
    """Frames (n,) and pixels (n, 2) of a ball from a CSV. Raises InputError as `read_clicks`."""
    header, rows = read_csv_rows(path, BALL_CURE, encoding="utf-8-sig")
    names = {name.strip(): name for name in header}
    if not {"frame", "x_px", "y_px"} <= set(names) or not rows:
        raise InputError(path, "has no rows" if not rows else "lacks columns", BALL_CURE)
    return _frames_and_pixels(path, rows, names, BALL_CURE)


def _frames_and_pixels(
    path: Path, rows: Sequence[Mapping[str, str]], names: Mapping[str, str], cure: str
) -> tuple[NDArray[np.int64], FloatArray]:
    try:
        frame = np.array([int(row[names["frame"]]) for row in rows], np.int64)
        xy = np.array([[float(row[names["x_px"]]), float(row[names["y_px"]])] for row in rows])
    except (TypeError, ValueError) as error:
        raise InputError(path, f"a cell is no number ({error})", cure) from None
    if not np.isfinite(xy).all():
        raise InputError(path, "a pixel is not finite", cure)
    return frame, xy


def _metres(
    row: Mapping[str, str], names: Mapping[str, str], metric: bool, template: PitchTemplate | None, path: Path
) -> tuple[float, float]:
    if metric and (row[names["X_m"]] or "").strip():
        try:
            return float(row[names["X_m"]]), float(row[names["Y_m"]])
        except (TypeError, ValueError) as error:
            raise InputError(path, f"a cell is no number ({error})", CLICK_CURE) from None
    return _named((row.get(names.get("point", "")) or "").strip(), template, path)


def _named(name: str, template: PitchTemplate | None, source: object) -> tuple[float, float]:
    if template is None or name not in template.points:
        near = get_close_matches(name, template.points if template else [], 1)
        cure = (
            f"did you mean {near[0]!r}?"
            if near
            else "the names: broadcast-mosaic pitch --list-points TEMPLATE"
        )
        raise InputError(source, f"no point is called {name!r}", cure)
    return template.points[name]
