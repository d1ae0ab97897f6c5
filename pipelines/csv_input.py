"""CSV files that a user hands in: read whole, with one clear line when that fails."""

from __future__ import annotations

import csv
from pathlib import Path

from pipelines.errors import InputError


def read_csv_rows(
    path: Path, cure: str, *, encoding: str = "utf-8"
) -> tuple[list[str], list[dict[str, str]]]:
    """(column names, rows by column name). Raises InputError: no file, or unreadable, for which `cure` is given."""
    try:
        with path.open(newline="", encoding=encoding) as stream:
            reader = csv.DictReader(stream)
            rows = list(reader)
            return list(reader.fieldnames or []), rows
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", cure) from None
