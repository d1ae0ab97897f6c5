"""The camera table of the whole run as JSON, CSV or Parquet: camera.csv's columns, rows, units and empty cells.

JSON: {format, version, clip, columns: [{name, kind, unit}], rows: [{column: value}]}; null where a cell is empty. CSV
and Parquet are those of a run (archive.py).
"""

from __future__ import annotations

import json
from pathlib import Path

from pipelines.archive import (
    COLUMNS,
    FORMAT_VERSION,
    cells,
    to_json,
    whole_file,
    write_camera_csv,
    write_camera_parquet,
)
from pipelines.records import CameraTable, RunRecord


def write_table(name: str, path: Path, table: CameraTable, run: RunRecord) -> None:
    """Write it as 'json', 'csv' or 'parquet'. Raises MissingToolError: Parquet without pyarrow; ValueError: no such."""
    if name == "csv":
        write_camera_csv(path, table)
    elif name == "parquet":
        write_camera_parquet(path, table)
    elif name == "json":
        _write_json(path, table, run)
    else:
        raise ValueError(f"{name!r} is no table format")


def _write_json(path: Path, table: CameraTable, run: RunRecord) -> None:
    names = [name for name, _, _ in COLUMNS]
    head = {
        "format": "broadcast-mosaic camera",
        "version": FORMAT_VERSION,
        "clip": to_json(run.clip),
        "columns": [{"name": name, "kind": kind, "unit": unit} for name, kind, unit in COLUMNS],
    }
    # A row a line: two hours of rows are never one string in memory, and the file can be read by eye.
    with whole_file(path) as stream:
        opening = json.dumps(head, allow_nan=False, ensure_ascii=False, indent=1)
        stream.write(opening.removesuffix("\n}").encode("utf-8", "surrogateescape") + b',\n "rows": [')
        for i, row in enumerate(cells(table)):
            text = json.dumps(dict(zip(names, row, strict=True)), allow_nan=False, ensure_ascii=False)
            stream.write((",\n  " if i else "\n  ").encode() + text.encode())
        stream.write(b"\n ]\n}\n")
