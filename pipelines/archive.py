"""Files of a run and back: camera.csv, .jsonl, .parquet, run.json, pairs.npz. The folder they go to: output_folder.py.

An empty cell (null in JSON and Parquet) is a value that is not known. Numbers are written by repr(float), so what is
read back is the same to the last bit. Every file is written under another name and renamed when it is whole.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import InputError, MissingToolError
from pipelines.records import CameraTable, RunRecord, ShotRecord

FORMAT_VERSION = 1  # of camera.* and run.json; goes up when a column changes its meaning or goes away

# Column, kind, unit. 'count' is an integer with -1 for empty.
COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("frame", "count", ""),
    ("pts_s", "float", "s"),
    ("timecode", "text", "hh:mm:ss:ff"),
    ("source_frame", "count", ""),
    ("field", "count", ""),
    ("shot", "count", ""),
    ("status", "text", ""),
    ("reason", "text", ""),
    ("f_px", "float", "px"),
    ("f_std_px", "float", "px"),
    ("f_stat_px", "float", "px"),
    ("zoom_ratio", "float", ""),
    ("zoom_ratio_std", "float", ""),
    ("hfov_deg", "float", "deg"),
    ("pan_deg", "float", "deg"),
    ("tilt_deg", "float", "deg"),
    ("roll_deg", "float", "deg"),
    ("cx_px", "float", "px"),
    ("cy_px", "float", "px"),
    ("aspect", "float", ""),
    ("k1", "float", ""),
    ("residual_px", "float", "px"),
    ("overlap", "float", ""),
    *((f"h{row}{column}", "float", "") for row in (1, 2, 3) for column in (1, 2, 3)),
)


def program_version() -> str:
    """Version of the installed distribution; 'unknown' where the packages are used without being installed."""
    try:
        return metadata.version("broadcast-mosaic")
    except metadata.PackageNotFoundError:
        return "unknown"


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A binary file that gets its name only when the block ends without an exception; else nothing is left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


# ---- the camera table


def cells(table: CameraTable) -> Iterator[tuple[int | float | str | None, ...]]:
    """Row by row in the order of COLUMNS; None is empty. Raises ValueError on an infinite value."""
    return zip(*(_column_cells(table, name, kind) for name, kind, _ in COLUMNS), strict=True)


def _column_cells(table: CameraTable, name: str, kind: str) -> list[Any]:
    if kind == "text":
        return [text or None for text in getattr(table, name)]
    values = _numbers(table, name)
    if kind == "count":
        return [value if value >= 0 else None for value in values.tolist()]
    if np.isinf(values).any():
        raise ValueError(
            f"column {name} holds an infinite value at row {int(np.flatnonzero(np.isinf(values))[0])}"
        )
    return [None if math.isnan(value) else value for value in values.tolist()]


def _numbers(table: CameraTable, name: str) -> NDArray[Any]:
    if name[0] == "h" and name[1:].isdigit():
        return table.homography[:, int(name[1]) - 1, int(name[2]) - 1]
    return np.asarray(getattr(table, name))


def write_camera_csv(path: Path, table: CameraTable) -> None:
    """One row per output picture, columns of COLUMNS, comma separated, UTF-8, '\\n'."""
    with whole_file(path) as stream:
        stream.write((",".join(name for name, _, _ in COLUMNS) + "\n").encode())
        for row in cells(table):
            stream.write((",".join(_csv_cell(value) for value in row) + "\n").encode())


def _csv_cell(value: int | float | str | None) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return '"' + value.replace('"', '""') + '"' if any(c in value for c in ',"\r\n') else value
    return repr(value)


def write_camera_jsonl(path: Path, table: CameraTable) -> None:
    """The same rows as JSON objects, one a line; null where a cell of the CSV is empty."""
    names = [name for name, _, _ in COLUMNS]
    with whole_file(path) as stream:
        for row in cells(table):
            line = json.dumps(dict(zip(names, row, strict=True)), allow_nan=False, ensure_ascii=False)
            stream.write(line.encode() + b"\n")


def write_camera_parquet(path: Path, table: CameraTable) -> None:
    """The same columns with units in the field metadata. Raises MissingToolError without pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        cure = "pip install 'broadcast-mosaic[parquet]', or leave output.parquet off"
        raise MissingToolError(path.name, "pyarrow is not installed", cure) from None
    types = {"count": pa.int64(), "float": pa.float64(), "text": pa.string()}
    schema_fields, arrays = [], []
    for name, kind, unit in COLUMNS:
        array = pa.array(_column_cells(table, name, kind), types[kind])
        if name == "status":
            array = array.dictionary_encode().cast(pa.dictionary(pa.int8(), pa.string()))
        arrays.append(array)
        schema_fields.append(pa.field(name, array.type, metadata={"unit": unit} if unit else None))
    schema = pa.schema(
        schema_fields, metadata={"format": "broadcast-mosaic camera", "version": str(FORMAT_VERSION)}
    )
    with whole_file(path) as stream:
        parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), stream, compression="zstd")


def read_camera_csv(path: str | Path) -> CameraTable:
    """camera.csv as a table. Raises InputError: no such file, a column missing, a cell that is no number."""
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = list(csv.reader(stream)) or [[]]
    except FileNotFoundError:
        raise InputError(path, "no such file", "give the folder of a finished run") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", "give the camera.csv of a finished run") from None
    missing = [name for name, _, _ in COLUMNS if name not in header]
    if missing:
        raise InputError(path, f"has no column {missing[0]}", "give a camera.csv of this version")
    columns: dict[str, Any] = {}
    for name, kind, _ in COLUMNS:
        position = header.index(name)
        try:
            columns[name] = _parse([row[position] for row in rows], kind)
        except (IndexError, ValueError) as error:
            raise InputError(path, f"column {name} is damaged ({error})", "run again") from None
    return _table(columns)


def _parse(texts: Sequence[str], kind: str) -> Any:
    if kind == "text":
        return tuple(texts)
    if kind == "count":
        return np.array([int(text) if text else -1 for text in texts], np.int64)
    return np.array([float(text) if text else math.nan for text in texts], np.float64)


def _table(columns: Mapping[str, Any]) -> CameraTable:
    h = [columns[name] for name, _, _ in COLUMNS if name[0] == "h" and name[1:].isdigit()]
    plain = {f.name: columns[f.name] for f in fields(CameraTable) if f.name != "homography"}
    return CameraTable(**plain, homography=np.stack(h, axis=-1).reshape(-1, 3, 3))


def join_tables(tables: Sequence[CameraTable]) -> CameraTable:
    """The rows of all tables, one after the other, sorted by frame. Raises ValueError: none, or a frame twice."""
    if not tables:
        raise ValueError("no tables to join")
    order = np.argsort(np.concatenate([t.frame for t in tables]), kind="stable")
    columns: dict[str, Any] = {}
    for column in fields(CameraTable):
        parts = [getattr(t, column.name) for t in tables]
        if isinstance(parts[0], tuple):
            flat = [text for part in parts for text in part]
            columns[column.name] = tuple(flat[i] for i in order)
        else:
            columns[column.name] = np.concatenate(parts)[order]
    joined = columns["frame"]
    if len(np.unique(joined)) != len(joined):
        raise ValueError(f"{len(joined) - len(np.unique(joined))} frames are in more than one table")
    return CameraTable(**columns)


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """A compressed .npz (pairs.npz and the like); the same arrays give the same bytes. No object arrays."""
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"array {name} holds objects")
    with whole_file(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **dict(arrays))


def write_table_arrays(path: Path, table: CameraTable) -> None:
    """A table as .npz, bit for bit; for the finished shots of an interrupted run."""
    arrays = {}
    for column in fields(CameraTable):
        value = getattr(table, column.name)
        arrays[column.name] = np.array(value, dtype=np.str_) if isinstance(value, tuple) else value
    write_arrays(path, arrays)


def read_table_arrays(path: Path) -> CameraTable:
    """Inverse of `write_table_arrays`."""
    with np.load(path, allow_pickle=False) as stored:
        columns: dict[str, Any] = {f.name: stored[f.name] for f in fields(CameraTable)}
    for name, values in columns.items():
        if values.dtype.kind == "U":
            columns[name] = tuple(values.tolist())
    return CameraTable(**columns)


# ---- run.json


def to_json(value: Any) -> Any:
    """Plain JSON values: numpy to Python, NaN and infinity to None, paths to text, tuples and arrays to lists."""
    if isinstance(value, Mapping):
        return {str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json(v) for v in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no place in run.json")


def write_json(path: Path, value: Any) -> None:
    """Indented JSON of anything that `to_json` takes."""
    text = json.dumps(to_json(value), indent=2, ensure_ascii=False, allow_nan=False)
    with whole_file(path) as stream:
        stream.write(text.encode("utf-8", "surrogateescape") + b"\n")


def run_as_dict(record: RunRecord) -> dict[str, Any]:
    """What run.json holds: the fields of the record, and those of `extra` beside them."""
    data = asdict(record)
    extra = data.pop("extra")
    return {
        "format": "broadcast-mosaic run",
        "format_version": FORMAT_VERSION,
        **to_json(data),
        **to_json(extra),
    }


def write_run(path: Path, record: RunRecord) -> None:
    """run.json."""
    write_json(path, run_as_dict(record))


def read_run(path: str | Path) -> RunRecord:
    """run.json, or the folder that holds it, as a record. Raises InputError: none there, damaged, another format."""
    path = Path(path)
    path = path if path.suffix == ".json" and not path.is_dir() else path / "run.json"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(path, "no such file", "give the folder of a finished run") from None
    except (OSError, ValueError) as error:
        raise InputError(path, f"cannot be read ({error})", "run again") from None
    if not isinstance(data, dict) or not str(data.get("format", "")).startswith("broadcast-mosaic run"):
        raise InputError(path, "is not a run.json of broadcast-mosaic", "give the folder of a finished run")
    if data["format_version"] > FORMAT_VERSION:
        raise InputError(
            path,
            f"has format {data['format_version']}, newer than {FORMAT_VERSION}",
            "update broadcast-mosaic",
        )
    known = {f.name for f in fields(RunRecord)} - {"extra"}
    extra = {k: v for k, v in data.items() if k not in known and k not in ("format", "format_version")}
    try:
        values = {k: data[k] for k in known}
        values["shots"] = tuple(shot_from_dict(shot) for shot in data["shots"])
        values["warnings"] = tuple(data["warnings"])
    except (KeyError, TypeError) as error:
        raise InputError(path, f"is damaged ({type(error).__name__} at {error})", "run again") from None
    return RunRecord(**values, extra=extra)


def shot_from_dict(data: Mapping[str, Any]) -> ShotRecord:
    """A ShotRecord from its JSON form. Raises KeyError, TypeError when it is not one."""
    # merged_into came later: a run.json without it knows of no merging.
    values = {f.name: data[f.name] for f in fields(ShotRecord) if f.name != "merged_into" or f.name in data}
    values["files"] = tuple(values["files"])
    values["warnings"] = tuple(values["warnings"])
    return ShotRecord(**values)
