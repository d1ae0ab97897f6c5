"""A clip from standard input: spooled into the folder of results, because a run reads its clip twice."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from pipelines.errors import InputError, OutputError
from pipelines.output_folder import NO_ROOM, lock_now

STDIN = Path("-")
SPOOL = ".stdin-"
BLOCK = 1 << 20  # bytes


def shown_path(path: Path) -> str:
    """The path as users know it: '-' for what came from standard input."""
    return str(STDIN if path.name.startswith(SPOOL) else path)


@contextmanager
def spooled(stream: IO[bytes], folder: Path, limit_bytes: int) -> Iterator[Path]:
    """A file in `folder` (made if need be) with all that `stream` gives; it goes when the block ends.

    Raises InputError: nothing came, or more than the limit; OutputError: the folder cannot be written, no room.
    An InputError of the block that names the file names standard input instead.
    """
    if stream.isatty():
        raise InputError(STDIN, "standard input is a terminal", "pipe a clip in, or name a file")
    made = False
    path: Path | None = None
    try:
        try:
            made = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            _remove_stale(folder)
            handle, name = tempfile.mkstemp(prefix=SPOOL, dir=folder)
            path = Path(name)
            with open(handle, "wb") as spool:
                lock_now(spool)  # tells the next run that this one is no leftover of a killed one
                _copy(stream, spool, limit_bytes)
                yield path
        except InputError as error:
            if path is not None and error.what == str(path):
                raise InputError("standard input", error.cause, error.cure) from None
            raise
        except (FileExistsError, NotADirectoryError):
            raise OutputError(folder, "is a file, not a folder", "choose another folder with -o") from None
        except OSError as error:
            if error.errno not in (*NO_ROOM, errno.EACCES, errno.ENAMETOOLONG):
                raise
            cause = f"standard input could not be stored there ({error.strerror})"
            raise OutputError(folder, cause, "make room, or choose another folder with -o") from None
    finally:
        if path is not None:
            path.unlink(missing_ok=True)
        if made:
            with suppress(OSError):  # it is not empty: results
                folder.rmdir()


def _copy(stream: IO[bytes], spool: IO[bytes], limit_bytes: int) -> None:
    n_bytes = 0
    while block := stream.read(BLOCK):
        n_bytes += len(block)
        if n_bytes > limit_bytes:
            cause = f"gives more than {limit_bytes / 1e9:g} GB"
            raise InputError("standard input", cause, "raise decode.stdin_max_gb, or name a file")
        spool.write(block)
    if n_bytes == 0:
        raise InputError("standard input", "gives nothing", "see that what comes before the pipe works")
    spool.flush()


def _remove_stale(folder: Path) -> None:
    """Files of runs that were killed: nobody holds their lock."""
    for old in folder.glob(f"{SPOOL}*"):
        with suppress(OSError), old.open("ab") as held:
            lock_now(held)
            os.unlink(old)
