"""Exports of a run: from names and a finished run to files, each with notes beside it that say what it holds.

A format of cameras gives a file (or folder) per shot, for every shot has its own world; tables give one of the run. The
notes, NAME.notes.json, state axes, units, numbering, what the format cannot say, and every frame that was left out with
its status and reason.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.archive import program_version, write_json
from pipelines.errors import InputError, OutputError
from pipelines.exports.cameras import ShotCameras, frames_in_no_shot, shot_cameras
from pipelines.exports.formats import ExportOptions, Format, format_named
from pipelines.records import CameraTable, RunRecord
from pipelines.report.words import reason_words

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """One export of one shot (shot None: of the run). path None: nothing could be written, `why` says so.

    n_frames: frames in it with a camera (tables: rows). n_left_out: frames of the shot without one.
    """

    name: str
    shot: int | None
    path: Path | None
    notes: Path
    n_frames: int
    n_left_out: int
    why: str = ""


def export_run(
    run: RunRecord,
    table: CameraTable,
    names: Sequence[str],
    out: Path,
    *,
    options: ExportOptions | None = None,
    shots: Sequence[int] | None = None,
    source: Path | None = None,
) -> list[Exported]:
    """Write every named export of the shots (None: all) under OUT, at the places that formats.py states.

    source: folder of the run, whose panorama.json a Hugin project takes its canvas from; None = `out`.
    Raises ValueError: no such format; MissingToolError: an extra is missing; InputError: no such shot, or a format that
    cannot hold this camera; OSError: not writable.
    """
    options = options or ExportOptions()
    results = []
    for form in [format_named(name) for name in names]:
        if not form.per_shot:
            results.append(export_table(form, run, table, out / form.file))
            continue
        for cameras in chosen_shots(run, table, options, shots):
            folder = f"shot-{cameras.shot:03d}"
            canvas = (source or out) / folder / "panorama.json"
            results.append(
                export_shot(form, cameras, out / folder / form.file, table, options, panorama_json=canvas)
            )
    return results


def export_for_run(run: RunRecord, table: CameraTable, names: Sequence[str], out: Path) -> None:
    """The exports that a run was asked for. What a format cannot hold is a warning: the run's own files stay."""
    missing: dict[str, list[str]] = {}
    for name in names:
        try:
            results = export_run(run, table, [name], out)
        except InputError as error:
            log.warning("export %s: %s", name, error)
            continue
        for result in results:
            if result.path is None:
                missing.setdefault(result.why, []).append(name)
    for why, affected in missing.items():
        log.warning("not exported to %s: %s", ", ".join(affected), why)


def chosen_shots(
    run: RunRecord, table: CameraTable, options: ExportOptions, shots: Sequence[int] | None = None
) -> list[ShotCameras]:
    """The cameras of those shots. Raises InputError: the run has no such shot, or none at all."""
    found = {c.shot: c for c in shot_cameras(run, table, options.sensor_width_mm)}
    missing = [shot for shot in shots or () if shot not in found]
    if missing:
        known = ", ".join(str(s) for s in found) or "none"
        raise InputError(f"shot {missing[0]}", "is not in this run", f"its shots: {known}")
    return list(found.values()) if shots is None else [found[shot] for shot in shots]


def export_table(form: Format, run: RunRecord, table: CameraTable, path: Path) -> Exported:
    """A table of the whole run at `path`, notes beside it."""
    form.check()
    from pipelines.exports.tables import write_table

    path.parent.mkdir(parents=True, exist_ok=True)
    write_table(form.name, path, table, run)
    notes = notes_path(path)
    write_json(notes, {**_head(form, path), "rows": len(table)})
    return Exported(name=form.name, shot=None, path=path, notes=notes, n_frames=len(table), n_left_out=0)


def export_shot(
    form: Format,
    cameras: ShotCameras,
    path: Path,
    table: CameraTable,
    options: ExportOptions,
    *,
    panorama_json: Path | None = None,
) -> Exported:
    """One shot at `path`, notes beside it. A shot without any camera gives the notes alone.

    panorama_json: the shot's, for the formats with a canvas; None = beside `path`.
    """
    module = form.load()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            path.parent, f"cannot be made ({error.strerror})", "choose another place with -o"
        ) from None
    why, special = "", {}
    if len(cameras.rows):
        canvas = panorama_json or path.with_name("panorama.json")
        more = {"panorama_json": canvas} if form.name == "pto" else {}
        special = dict(module.write(path, cameras, options, **more))
    else:
        because = cameras.why_none.rstrip(".") or "the run says no more"
        why = f"no frame of shot {cameras.shot} has a calibrated camera: {because[:1].lower()}{because[1:]}"
    notes = notes_path(path)
    write_json(notes, {**_head(form, path if not why else None), **_shot_notes(cameras, table), **special})
    return Exported(
        name=form.name,
        shot=cameras.shot,
        path=None if why else path,
        notes=notes,
        n_frames=len(cameras.rows),
        n_left_out=int((~cameras.known).sum()),
        why=why,
    )


def notes_path(path: Path) -> Path:
    """Where the notes of an export lie."""
    return path.with_name(f"{path.name}.notes.json")


def _head(form: Format, path: Path | None) -> dict[str, Any]:
    return {
        "format": "broadcast-mosaic export notes",
        "format_version": 1,
        "broadcast-mosaic": program_version(),
        "export": form.name,
        "file": None if path is None else path.name,
        "axes": form.axes,
        "units": form.units,
        "frame_numbering": form.numbering,
        "frames_without_camera": form.empty,
    }


def _shot_notes(cameras: ShotCameras, table: CameraTable) -> dict[str, Any]:
    return {
        "clip": cameras.clip,
        "clip_identity": cameras.identity,
        "shot": cameras.shot,
        "world": cameras.world,
        "picture_size_px": list(cameras.size_px),
        "pictures_per_s": cameras.picture_fps,
        "sensor_width_mm": cameras.sensor_width_mm,
        "n_frames": len(cameras.rows),
        "n_left_out": int((~cameras.known).sum()),
        "left_out": [
            {
                "first_frame": run.first_frame,
                "last_frame": run.last_frame,
                "status": run.status,
                "reason": run.reason,
                "why": reason_words(run.reason)[0] if run.reason else "",
            }
            for run in cameras.left_out
        ],
        "frames_in_no_shot": [list(stretch) for stretch in frames_in_no_shot(table)],
    }
