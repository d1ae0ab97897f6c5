"""Commands besides the main job: export and doctor; the others have modules of their own (cli_*.py).

`register` puts them all into the application.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.errors import EXIT_OK, EXIT_SHOTS_FAILED, EXIT_USAGE, InputError, OutputError
from pipelines.exports.formats import FORMATS, NAMES, ExportOptions, format_named, parse_names

Out = Annotated[Path, typer.Argument(help="Folder of a finished run.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on stdout, errors too.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Nothing but errors.")]

# One line break: typer shows it as one, and two as an empty line.
FORMAT_HELP = "\n".join(f"{entry.name}: {entry.what}" for entry in FORMATS)


def register(app: typer.Typer) -> None:
    """Add the commands of this module, of cli_rays, cli_pitch, cli_render and cli_serve."""
    from pipelines.cli_pitch import flight, pitch
    from pipelines.cli_rays import rays
    from pipelines.cli_render import EPILOG, render
    from pipelines.cli_serve import serve

    app.command("export", epilog=FORMAT_HELP)(export)
    app.command("rays")(rays)
    app.command("pitch")(pitch)
    app.command("flight")(flight)
    app.command("render", epilog=EPILOG)(render)
    app.command("serve")(serve)
    app.command("doctor")(doctor)


def print_json(document: Mapping[str, Any]) -> None:
    """One JSON document on stdout."""
    from pipelines.archive import to_json

    print(json.dumps(to_json(document), indent=2, ensure_ascii=False, allow_nan=False))


def refuse_settings(context: typer.Context, command: str) -> None:
    """Raises a usage error when `--section.key` was given to a command that has no settings."""
    if context.obj:
        raise typer.BadParameter(f"{command} has no settings, but was given {context.obj[0]}")


def format_names(text: str) -> tuple[str, ...]:
    """The names of --to or --export. Raises a usage error that names the nearest one."""
    try:
        return parse_names(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def complete_names(incomplete: str) -> list[str]:
    """Shell completion of a list with commas: the names that the last word may become."""
    done, comma, last = incomplete.rpartition(",")
    return [f"{done}{comma}{name}" for name in NAMES if name.startswith(last)]


def export(
    context: typer.Context,
    out: Out,
    to: Annotated[
        str,
        typer.Option(
            "--to", help="Format, or several with commas; listed below.", autocompletion=complete_names
        ),
    ],
    path: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Where to: the file (or folder, for formats that are one). With several shots or formats, a "
            "folder for them. Default: into the run's own folder.",
        ),
    ] = None,
    shot: Annotated[int | None, typer.Option(min=0, help="This shot only; default: all.")] = None,
    sensor_width_mm: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=100, help="Width of the camera's sensor; without it mm are nominal or left out."
        ),
    ] = None,
    first_frame: Annotated[
        int | None, typer.Option(help="Number of the clip's picture 0 in chan (default 1) and usd (0).")
    ] = None,
    camera_id: Annotated[int, typer.Option(min=0, max=255, help="Camera id in FreeD packets.")] = 1,
    udp: Annotated[
        str, typer.Option(help="HOST:PORT; send the FreeD packets there at frame rate, instead of a file.")
    ] = "",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> int:
    """The camera of a finished run in another program's format, with notes on what it holds beside it."""
    refuse_settings(context, "export")
    names = format_names(to)
    if udp and names != ("freed",):
        raise typer.BadParameter("--udp goes with --to freed alone")
    for name in names:
        format_named(name).check()  # a missing extra shows before anything is written
    options = ExportOptions(sensor_width_mm=sensor_width_mm, first_frame=first_frame, camera_id=camera_id)
    shots = None if shot is None else [shot]
    if udp:
        return _send(out, options, shots, _address(udp), as_json, quiet)
    from pipelines.exports.place import export_folder

    results = export_folder(out, names, target=path, options=options, shots=shots)
    failed = [result for result in results if result.path is None]
    code = EXIT_SHOTS_FAILED if failed else EXIT_OK
    for result in failed:
        print(f"broadcast-mosaic: export {result.name}: {result.why}; see {result.notes}", file=sys.stderr)
    if as_json:
        exports = [
            {
                "export": r.name,
                "shot": r.shot,
                "path": None if r.path is None else str(r.path),
                "notes": str(r.notes),
                "n_frames": r.n_frames,
                "n_left_out": r.n_left_out,
                "why": r.why,
            }
            for r in results
        ]
        print_json({"exit_code": code, "exports": exports})
    elif not quiet:
        for result in results:
            if result.path is not None:
                left = (
                    f", {result.n_left_out} left out (see {result.notes.name})" if result.n_left_out else ""
                )
                print(f"{result.path}: {result.n_frames} frames{left}")
    return code


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdigit() or not 0 < int(port) < 65536:
        raise typer.BadParameter(f"--udp is HOST:PORT, for example 127.0.0.1:6301; it is {text!r}")
    return (host.strip("[]") or "127.0.0.1", int(port))


def _send(
    out: Path,
    options: ExportOptions,
    shots: list[int] | None,
    address: tuple[str, int],
    as_json: bool,
    quiet: bool,
) -> int:
    from pipelines.archive import read_camera_csv, read_run
    from pipelines.exports.exporter import chosen_shots
    from pipelines.exports.freed import facts, send

    found = chosen_shots(read_run(out), read_camera_csv(out / "camera.csv"), options, shots)
    cameras = [c for c in found if len(c.rows)]
    if len(cameras) != 1:
        # Two shots have two worlds: a stream that jumps from one into the other says something false.
        cause = "no frame has a calibrated camera" if not cameras else f"{len(cameras)} shots have a camera"
        cure = "give a focal length to the run" if not cameras else "choose one with --shot"
        raise InputError(out, cause, cure)
    try:
        sent = send(cameras[0], options, address)
    except OSError as error:
        raise OutputError(
            f"{address[0]}:{address[1]}", f"cannot be sent to ({error})", "check --udp"
        ) from None
    law = facts(cameras[0])["zoom_law"]
    if as_json:
        print_json({"exit_code": EXIT_OK, "sent": sent, "shot": cameras[0].shot, "zoom_law": law})
    elif not quiet:
        print(f"{sent} packets sent to {address[0]}:{address[1]}; {law}")
    return EXIT_OK


def doctor(context: typer.Context, as_json: AsJson = False) -> int:
    """What this installation can do: versions, codecs, GPU, threads, and what to do about what is missing."""
    refuse_settings(context, "doctor")
    from pipelines.doctor import as_document, as_text, examine

    findings = examine()
    document = as_document(findings)
    code = EXIT_OK if document["ok"] else EXIT_USAGE
    if as_json:
        print_json({"exit_code": code, **document})
    else:
        print(as_text(findings))
    return code
