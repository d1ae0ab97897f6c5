"""The command `rays`: pixels of a finished run's frames to directions and back; from options or from a CSV."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli_results import AsJson, Out, print_json, refuse_settings
from pipelines.csv_input import read_csv_rows
from pipelines.csv_output import write_csv
from pipelines.errors import EXIT_OK, EXIT_SHOTS_FAILED, InputError

if TYPE_CHECKING:
    from pipelines.frame_geometry import FrameGeometry
    from pipelines.records import CameraTable

COLUMNS = ("frame", "x_px", "y_px", "pan_deg", "tilt_deg", "ray_x", "ray_y", "ray_z", "axis_angle_std_deg")
FORWARD, BACK = ("x_px", "y_px"), ("pan_deg", "tilt_deg")


def rays(
    context: typer.Context,
    out: Out,
    frame: Annotated[
        int | None, typer.Option(min=0, max=10**12, help="Frame number, as in camera.csv.")
    ] = None,
    pixel: Annotated[
        list[str] | None, typer.Option(help="X,Y in px, (0, 0) the top-left pixel's centre; may come again.")
    ] = None,
    pan_tilt: Annotated[
        list[str] | None, typer.Option(help="PAN,TILT in degrees: which pixel sees it; may come again.")
    ] = None,
    points: Annotated[
        Path | None, typer.Option(help="CSV with columns frame, x_px, y_px, or frame, pan_deg, tilt_deg.")
    ] = None,
    path: Annotated[Path | None, typer.Option("-o", "--out", help="CSV to write; default: stdout.")] = None,
    as_json: AsJson = False,
) -> int:
    """Where a pixel of a frame looks: ray, pan and tilt in the shot's world; and which pixel sees a direction."""
    refuse_settings(context, "rays")
    from pipelines.archive import read_camera_csv, read_run
    from pipelines.frame_geometry import frame_geometry

    if (points is None) == (frame is None):
        raise typer.BadParameter("give --points FILE, or --frame N with --pixel X,Y or --pan-tilt PAN,TILT")
    if points is not None and (pixel or pan_tilt):
        raise typer.BadParameter("--points takes its pixels from the file")
    if frame is not None and not pixel and not pan_tilt:
        raise typer.BadParameter("--frame needs --pixel X,Y or --pan-tilt PAN,TILT")
    run, table = read_run(out), read_camera_csv(out / "camera.csv")
    geometry = frame_geometry(run, table)
    if points is not None:
        rows = answer(table, *read_points(points), str(points), geometry)
    else:
        rows = []
        for texts, columns, option in ((pixel, FORWARD, "--pixel"), (pan_tilt, BACK, "--pan-tilt")):
            if texts:
                pairs = [_pair(text, option) for text in texts]
                rows += answer(table, columns, [frame or 0] * len(pairs), pairs, "--frame", geometry)
    unknown = [row for row in rows if row["x_px"] is None or row["ray_x"] is None]
    code = EXIT_SHOTS_FAILED if unknown and len(unknown) == len(rows) else EXIT_OK
    if unknown:
        print(f"broadcast-mosaic: {_why(table, unknown, len(rows))}", file=sys.stderr)
    if note := outside_note(rows, run.clip.get("size_px")):
        print(f"broadcast-mosaic: {note}", file=sys.stderr)
    if as_json:
        print_json({"exit_code": code, "points": rows})
    else:
        write_csv(rows, COLUMNS, path)
    return code


def outside_note(rows: Sequence[dict[str, Any]], size_px: Sequence[int] | None) -> str:
    """A line about pixels that no picture has; '' where there are none. Their rays follow from the lens model alone."""
    known = [(row["x_px"], row["y_px"]) for row in rows if row["x_px"] is not None]
    if not size_px:
        return ""
    w, h = size_px
    n = sum(not (-0.5 <= x <= w - 0.5 and -0.5 <= y <= h - 0.5) for x, y in known)
    if not n:
        return ""
    which = "the point lies" if len(rows) == 1 else f"{n} of {len(rows)} points {'lies' if n == 1 else 'lie'}"
    return f"{which} outside the {w} x {h} picture"


def answer(
    table: CameraTable,
    columns: Sequence[str],
    frames: Sequence[int],
    pairs: Sequence[tuple[float, float]],
    source: str,
    geometry: FrameGeometry | None = None,
) -> list[dict[str, Any]]:
    """A row of COLUMNS per point; None where it is not known. columns: FORWARD or BACK, what the pairs are.

    Raises InputError: a frame that the run does not have.
    """
    import numpy as np

    from pipelines.archive import to_json
    from pipelines.rays import axis_angle_std_deg, pan_tilt_to_pixel, pixel_to_pan_tilt, pixel_to_ray

    given, at = np.array(pairs, float).reshape(-1, 2), np.array(frames, np.int64)
    try:
        xy = given if tuple(columns) == FORWARD else pan_tilt_to_pixel(table, at, given, geometry)
        angles = pixel_to_pan_tilt(table, at, given, geometry) if tuple(columns) == FORWARD else given
        ray, std = pixel_to_ray(table, at, xy, geometry), axis_angle_std_deg(table, at, xy)
    except ValueError as error:
        cause = str(error)
        raise InputError(source, cause, f"the run has frames {table.frame[0]} to {table.frame[-1]}") from None
    values = np.column_stack([xy, angles, ray, std])
    return [
        dict(zip(COLUMNS, (int(f), *to_json(line)), strict=True)) for f, line in zip(at, values, strict=True)
    ]


def read_points(path: Path) -> tuple[tuple[str, ...], list[int], list[tuple[float, float]]]:
    """(FORWARD or BACK, frames, pairs) of a CSV. Raises InputError: no file, no such columns, no number."""
    header, rows = read_csv_rows(
        path, "it must be a CSV", encoding="utf-8-sig"
    )  # spreadsheets write a mark first
    cure = "it needs frame, x_px, y_px, or frame, pan_deg, tilt_deg"
    columns = next((c for c in (FORWARD, BACK) if {"frame", *c} <= set(header)), None)
    if columns is None or not rows:
        raise InputError(path, "has no rows" if columns else "lacks columns", cure)
    try:
        pairs = [(float(row[columns[0]]), float(row[columns[1]])) for row in rows]
        return columns, [int(row["frame"]) for row in rows], pairs
    except (TypeError, ValueError) as error:
        raise InputError(path, f"a cell is no number ({error})", cure) from None


def _pair(text: str, option: str) -> tuple[float, float]:
    try:
        a, b = (float(part) for part in text.split(","))
        if not (math.isfinite(a) and math.isfinite(b)):
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f"{option} takes two numbers with a comma between, not {text!r}") from None
    return a, b


def _why(table: CameraTable, unknown: Sequence[dict[str, Any]], n: int) -> str:
    from pipelines.rays import rows_of
    from pipelines.report.words import STATUS_SIGNS, reason_words

    frame = unknown[0]["frame"]
    row = int(rows_of(table, frame))
    status, reason = table.status[row], table.reason[row]
    known = table.f_px[row] == table.f_px[row]  # NaN is not equal to itself
    if known:
        cause = f"frame {frame} does not see that direction"
    else:
        words = reason_words(reason)[0] if reason else STATUS_SIGNS.get(status, ("", "no camera"))[1]
        cause = f"frame {frame} is {status or 'without a camera'}: {words}"
    return cause if n == 1 else f"{len(unknown)} of {n} points have no answer; first: {cause}"
