"""The commands `pitch` and `flight`: pixels of a finished run to metres on the pitch; a ball's way through the air."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli_rays import outside_note
from pipelines.cli_results import AsJson, print_json, refuse_settings
from pipelines.csv_output import write_csv
from pipelines.errors import EXIT_OK, EXIT_SHOTS_FAILED, InputError

if TYPE_CHECKING:
    from pipelines.pitch import Pitch
    from pipelines.pitch_templates import PitchTemplate

OutFolder = Annotated[Path | None, typer.Argument(help="Folder of a finished run.", show_default=False)]
Clicked = Annotated[
    Path | None,
    typer.Option("--clicks", help="CSV: frame, x_px, y_px and X_m, Y_m, or point (a template's name)."),
]


def complete_templates(incomplete: str) -> list[str]:
    """Shell completion of a template's name."""
    from pipelines.pitch_templates import TEMPLATES

    return [name for name in TEMPLATES if name.startswith(incomplete)]


Template = Annotated[
    str,
    typer.Option(
        help="football, basketball, american-football; football:100x64 for its size.",
        autocompletion=complete_templates,
    ),
]
Position = Annotated[
    str, typer.Option("--camera", help="X,Y,Z in m of the camera, if known: two clicks are enough then.")
]
ClickPx = Annotated[
    float, typer.Option("--click-px", min=0.05, max=50, help="One-sigma error of a click, px.")
]

POINT_COLUMNS = ("frame", "x_px", "y_px", "X_m", "Y_m", "std_X_m", "std_Y_m", "cov_XY_m2")
FLIGHT_COLUMNS = ("time_s", "X_m", "Y_m", "Z_m", "std_X_m", "std_Y_m", "std_Z_m")


def pitch(
    context: typer.Context,
    out: OutFolder = None,
    clicks: Clicked = None,
    template: Template = "",
    camera: Position = "",
    click_px: ClickPx = 1.0,
    frame: Annotated[int | None, typer.Option(min=0, help="Frame of --pixel.")] = None,
    pixel: Annotated[list[str] | None, typer.Option(help="X,Y in px of that frame; may come again.")] = None,
    points: Annotated[
        Path | None, typer.Option(help="CSV with frame, x_px, y_px of the pixels wanted.")
    ] = None,
    path: Annotated[Path | None, typer.Option("-o", "--out", help="CSV to write; default: stdout.")] = None,
    list_points: Annotated[
        str, typer.Option(help="List the points of a template, and stop.", autocompletion=complete_templates)
    ] = "",
    as_json: AsJson = False,
) -> int:
    """Where on the pitch a pixel is, in metres with error bars, from four clicked points or more."""
    refuse_settings(context, "pitch")
    if list_points:
        known = template_named(list_points)
        if as_json:
            print_json({"exit_code": EXIT_OK, "template": known.name, "points": known.points})
        else:
            print("\n".join(f"{name}: {x:g}, {y:g}" for name, (x, y) in known.points.items()))
        return EXIT_OK
    if (points is None) == (frame is None or not pixel):
        raise typer.BadParameter("give --points FILE, or --frame N with --pixel X,Y")
    found = fitted(out, clicks, template, camera, click_px)
    import numpy as np

    from pipelines.archive import read_run
    from pipelines.clicks import read_ball

    if points is not None:
        frames, xy = read_ball(points)
    else:
        xy = np.array([_numbers(text, 2, "--pixel") for text in pixel or []])
        frames = np.full(len(xy), frame, np.int64)
    try:
        metres, cov = found.to_metres(frames, xy)
    except ValueError as error:
        raise InputError(points or "--frame", str(error), "choose a frame of the run") from None
    rows = [
        dict(zip(POINT_COLUMNS, (int(f), *p, *m, c[0, 0] ** 0.5, c[1, 1] ** 0.5, c[0, 1]), strict=True))
        for f, p, m, c in zip(frames, xy.tolist(), metres, cov, strict=True)
    ]
    unknown = int((~np.isfinite(metres).all(axis=1)).sum())
    if unknown:
        print(
            f"broadcast-mosaic: {unknown} of {len(rows)} pixels are not on the pitch: above its horizon, "
            "or in a frame without a camera",
            file=sys.stderr,
        )
    size_px = read_run(out).clip.get("size_px") if out is not None else None
    if note := outside_note([row for row in rows if np.isfinite(row["X_m"])], size_px):
        print(f"broadcast-mosaic: {note}", file=sys.stderr)
    code = EXIT_SHOTS_FAILED if unknown == len(rows) else EXIT_OK
    if as_json:
        print_json({"exit_code": code, "camera": camera_facts(found), "points": rows})
    else:
        _write(rows, POINT_COLUMNS, path)
    return code


def flight(
    context: typer.Context,
    out: OutFolder = None,
    ball: Annotated[
        Path | None, typer.Option(help="CSV with frame, x_px, y_px of the ball in the air.")
    ] = None,
    clicks: Clicked = None,
    template: Template = "",
    camera: Position = "",
    click_px: ClickPx = 1.0,
    ball_px: Annotated[
        float, typer.Option("--ball-px", min=0.05, max=50, help="One-sigma error of the ball, px.")
    ] = 1.0,
    path: Annotated[Path | None, typer.Option("-o", "--out", help="CSV to write; default: stdout.")] = None,
    as_json: AsJson = False,
) -> int:
    """A ball's flight in metres, with error bars, from where it is seen: a parabola under gravity, without drag."""
    refuse_settings(context, "flight")
    if ball is None:
        raise typer.BadParameter("give --ball FILE with frame, x_px, y_px")
    found = fitted(out, clicks, template, camera, click_px)
    import numpy as np

    from pipelines.clicks import read_ball
    from pipelines.pitch import MISFIT
    from pipelines.rays import rows_of

    frames, xy = read_ball(ball)
    try:
        flown = found.flight(frames, xy, pixel_std=ball_px)
        times = found.table.pts_s[rows_of(found.table, frames)]
    except ValueError as error:
        raise InputError(
            ball, str(error), "give four frames or more of the ball in the air, of the clicked shot"
        ) from None
    std = np.sqrt(np.diagonal(flown.at_cov(times), axis1=-2, axis2=-1))
    rows = [
        dict(zip(FLIGHT_COLUMNS, (t, *p, *s), strict=True))
        for t, p, s in zip(times, flown.at(times), std, strict=True)
    ]
    at, where, cov = flown.landing()
    landing = {
        "time_s": at, "X_m": where[0], "Y_m": where[1], "std_X_m": cov[0, 0] ** 0.5, "std_Y_m": cov[1, 1] ** 0.5,
    }  # fmt: skip
    if flown.chi2_dof > MISFIT:
        print(
            f"broadcast-mosaic: misfit {flown.chi2_dof:.1f} times what the errors explain: touched, spun, "
            "or slowed by the air?",
            file=sys.stderr,
        )
    if as_json:
        speed = float(np.linalg.norm(flown.velocity_m_s))
        print_json(
            {
                "exit_code": EXIT_OK, "camera": camera_facts(found), "landing": landing, "chi2_dof": flown.chi2_dof,
                "speed_m_s": speed, "points": rows,
            }
        )  # fmt: skip
        return EXIT_OK
    _write(rows, FLIGHT_COLUMNS, path)
    print(
        f"comes down at {where[0]:.2f} ± {landing['std_X_m']:.2f}, {where[1]:.2f} ± {landing['std_Y_m']:.2f} m",
        file=sys.stderr,
    )
    return EXIT_OK


def fitted(out: Path | None, clicks: Path | None, template: str, camera: str, click_px: float) -> Pitch:
    """The pitch camera that the options ask for. Raises usage errors, and InputError as pitch.pitch_of."""
    if out is None or clicks is None:
        raise typer.BadParameter("give the folder of a finished run and --clicks FILE")
    from pipelines.clicks import read_clicks
    from pipelines.pitch import pitch_of

    position = _numbers(camera, 3, "--camera") if camera else None
    known = template_named(template) if template else None
    return pitch_of(
        out, read_clicks(clicks, known), click_std_px=click_px, position_m=position, source=clicks
    )


def template_named(text: str) -> PitchTemplate:
    """pitch_templates.template_named with a usage error."""
    from pipelines.pitch_templates import template_named as named

    try:
        return named(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def camera_facts(found: Pitch) -> dict[str, Any]:
    """JSON-ready: where the camera stands, with errors."""
    camera = found.camera
    return {
        "shot": found.shot,
        "position_m": camera.position_m.tolist(),
        "position_std_m": [float(camera.cov[i, i]) ** 0.5 for i in range(3)],
        "focal_correction": float(camera.log_focal),
        "focal_correction_std": float(camera.cov[6, 6]) ** 0.5,
        "chi2_dof": camera.chi2_dof,
        "residual_px": camera.residual_px.tolist(),
    }


def _numbers(text: str, n: int, option: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != n:
        raise typer.BadParameter(f"{option} takes {n} numbers with commas between, not {text!r}")
    return values


def _write(rows: Sequence[dict[str, Any]], columns: Sequence[str], path: Path | None) -> None:
    plain = [
        {k: "" if v != v else (v if isinstance(v, int) else float(v)) for k, v in row.items()} for row in rows
    ]
    write_csv(plain, columns, path)
