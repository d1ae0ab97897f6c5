"""The table at the end of a run, for people."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.archive import read_camera_csv
from pipelines.exports.formats import format_named
from pipelines.records import CameraTable, RunRecord
from pipelines.report.words import listed_files

WIDTH = 120  # columns where stdout is no terminal and has no width of its own


def print_summary(out: Path, record: RunRecord) -> None:
    """Shots with status, focal range with error, zoom and files; then the warnings, on stdout. Reads OUT/camera.csv."""
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    camera = read_camera_csv(out / "camera.csv")
    table = Table("shot", "pictures", "status", "focal length px", "zoom", "files", title=escape(str(out)))
    for shot in record.shots:
        counts = ", ".join(f"{n} {status}" for status, n in shot.status_counts.items() if n)
        rows = camera.shot == shot.index
        cells = (
            str(shot.index),
            f"{shot.first_frame}-{shot.last_frame} ({counts})",
            shot.status,  # the sentence below the table says why
            focal_range(camera, rows),
            zoom_range(camera, rows),
            file_names(shot.files),
        )
        table.add_row(*(escape(cell) for cell in cells))
    console.print(table)
    for shot in record.shots:
        if why := shot.sentence or shot.reason.replace("_", " "):
            console.print(escape(f"shot {shot.index}: {why}"))
    for warning in record.warnings:
        console.print(escape(f"note: {warning}"))
    exports = record.config.get("output", {}).get("exports") or ()
    if exports:
        console.print(escape(f"exports: {', '.join(export_words(out, record, name) for name in exports)}"))
    console.print(escape(f"results: {out / 'report.html'}, {out / 'camera.csv'}, {out / 'run.json'}"))


def print_clips(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A line a clip, of the rows of summary.csv, on stdout; `path` is that file."""
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    table = Table("folder", "status", "frames", "shots", "focal length px", "s", "reason")
    for row in rows:
        ends = [
            f"{row[f'f_{end}_px']:.0f} ± {row[f'f_{end}_std_px']:.0f}"
            for end in ("min", "max")
            if row[f"f_{end}_px"] is not None
        ]
        counts = ("" if row[name] is None else str(row[name]) for name in ("frames", "shots"))
        cells = (
            row["folder"],
            row["status"],
            *counts,
            " to ".join(ends) or "not known",
            f"{row['seconds']:.0f}",
        )
        table.add_row(*(escape(cell) for cell in (*cells, row["reason"])))
    console.print(table)
    console.print(escape(f"results: a folder for each clip in {path.parent}, all of them in {path}"))


def file_names(files: Sequence[str]) -> str:
    """'pairs.npz, panorama .tif .jpg': endings gathered, so that a narrow terminal breaks between them."""
    ends: dict[str, list[str]] = {}
    for name, note in listed_files(files):
        path = Path(name)
        ends.setdefault(path.stem, []).append(path.suffix or f"({note})")
    return ", ".join(
        f"{stem}{found[0]}" if len(found) == 1 and found[0].startswith(".") else " ".join([stem, *found])
        for stem, found in ends.items()
    )


def export_words(out: Path, record: RunRecord, name: str) -> str:
    """'usd' when every shot has it, 'usd (1 of 3 shots, see its notes)' when some have no camera."""
    form = format_named(name)
    if not form.per_shot or not record.shots:
        return name
    written = sum((out / f"shot-{shot.index:03d}" / form.file).exists() for shot in record.shots)
    return (
        name
        if written == len(record.shots)
        else f"{name} ({written} of {len(record.shots)} shots, see its notes)"
    )


def focal_range(camera: CameraTable, rows: np.ndarray) -> str:
    """'2000 ± 20 to 3000 ± 31', of the shortest and the longest; 'not known' where none is claimed."""
    known = np.flatnonzero(rows & np.isfinite(camera.f_px))
    if not len(known):
        return "not known"
    ends = [known[np.argmin(camera.f_px[known])], known[np.argmax(camera.f_px[known])]]
    shown = [f"{camera.f_px[i]:.0f} ± {camera.f_std_px[i]:.0f}" for i in ends]
    return shown[0] if camera.f_px[ends[1]] < 1.002 * camera.f_px[ends[0]] else f"{shown[0]} to {shown[1]}"


def zoom_range(camera: CameraTable, rows: np.ndarray) -> str:
    """Longest over shortest focal of the shot: known even where the focal is not."""
    zoom = camera.zoom_ratio[rows & np.isfinite(camera.zoom_ratio)]
    return f"x{zoom.max() / zoom.min():.3f}" if len(zoom) else "not known"
