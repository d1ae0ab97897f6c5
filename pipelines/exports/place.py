"""Where the exports of a finished run go: into its own folder (and its list of files), or to a place of the user's.

A single export of a single shot takes the path as its name; several are laid out under it as in a run's folder.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pipelines.archive import read_camera_csv, read_run, write_json
from pipelines.errors import InputError, OutputError
from pipelines.exports.exporter import Exported, chosen_shots, export_run, export_shot, export_table
from pipelines.exports.formats import ExportOptions, format_named


def export_folder(
    out: str | Path,
    names: Sequence[str],
    *,
    target: str | Path | None = None,
    options: ExportOptions | None = None,
    shots: Sequence[int] | None = None,
) -> list[Exported]:
    """Write exports of the finished run in folder `out`. target: None = into OUT/shot-NNN/ and OUT.

    Raises InputError: no finished run, no such shot; OutputError: target not writable; MissingToolError: an extra.
    """
    out, options = Path(out), options or ExportOptions()
    run, table = read_run(out), read_camera_csv(out / "camera.csv")
    if not run.shots and any(format_named(name).per_shot for name in names):
        raise InputError(
            out, "the run found no shot", "export json or csv, which say what is known of each frame"
        )
    place = Path(target) if target is not None else out
    try:
        if target is None or place.is_dir() or len(names) > 1:
            results = export_run(run, table, names, place, options=options, shots=shots, source=out)
        else:
            results = _named(out, names[0], place, options, shots)
    except OSError as error:
        cause = f"cannot be written ({error.strerror or error})"
        raise OutputError(place, cause, "choose another place with -o") from None
    if target is None:
        _add_to_run(out, results)
    return results


def _named(
    out: Path, name: str, path: Path, options: ExportOptions, shots: Sequence[int] | None
) -> list[Exported]:
    run, table = read_run(out), read_camera_csv(out / "camera.csv")
    form = format_named(name)
    if not form.per_shot:
        return [export_table(form, run, table, path)]
    found = chosen_shots(run, table, options, shots)
    # Shots without a camera give no file, so one file is enough when only one shot has any.
    having = [cameras for cameras in found if len(cameras.rows)] or found[:1]
    if len(having) > 1:
        return export_run(run, table, [name], path, options=options, shots=shots, source=out)
    panorama = out / f"shot-{having[0].shot:03d}" / "panorama.json"
    return [export_shot(form, having[0], path, table, options, panorama_json=panorama)]


def _add_to_run(out: Path, results: Sequence[Exported]) -> None:
    """Add the files to run.json's `files`, so that the next run into this folder clears them away as outdated."""
    path = out / "run.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    files = set(data.get("files", []))
    for result in results:
        for written in (result.path, result.notes):
            if written is None:
                continue
            inside = written.rglob("*") if written.is_dir() else [written]
            files |= {p.relative_to(out).as_posix() for p in inside if p.is_file()}
    data["files"] = sorted(files)
    write_json(path, data)
