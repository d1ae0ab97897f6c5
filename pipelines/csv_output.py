"""CSV that a command hands out: to a file, whole or not at all, or to standard output."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from pipelines.errors import OutputError


def write_csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], path: Path | None) -> None:
    """A header and a row each. path None: standard output. Raises OutputError: cannot be written."""

    def write(stream: TextIO) -> None:
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

    if path is None:
        write(sys.stdout)
        return
    from pipelines.exports.whole_file import whole_file

    try:
        with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
            write(stream)
    except OSError as error:
        cause = f"cannot be written ({error.strerror})"
        raise OutputError(path, cause, "choose another place with -o") from None
