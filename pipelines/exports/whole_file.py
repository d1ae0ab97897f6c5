"""Write-then-rename: what has its final name is whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the same folder, renamed to `path` when the block ends well, removed when it does not.

    The temporary name keeps the suffix, because some writers choose the format by it. Raises OSError when the
    folder is missing or cannot be written; a file of the final name is then untouched.
    """
    final = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{final.stem}-", suffix=final.suffix, dir=final.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        mask = os.umask(0)  # mkstemp makes private files; outputs are as public as the user's other files
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, final)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its name when the block ends well, and goes away when it does not.

    An earlier folder of that name is replaced as a whole, files of it that are not written again included. Raises
    OSError when the parent is missing or cannot be written, or when `path` is a file.
    """
    final = Path(path)
    if final.exists() and not final.is_dir():
        raise NotADirectoryError(f"{final} is a file")
    temporary = Path(tempfile.mkdtemp(prefix=f".{final.name}-", dir=final.parent))
    old = temporary.with_name(f"{temporary.name}-old")
    try:
        yield temporary
        mask = os.umask(0)  # mkdtemp makes private folders
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)
        if final.is_dir():
            # No system call swaps two folders everywhere: for an instant there is none of this name.
            os.replace(final, old)
        os.replace(temporary, final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if old.is_dir() and not final.exists():
            os.replace(old, final)
        shutil.rmtree(old, ignore_errors=True)
