"""What the name of a clip stands for: a file, a folder or a pattern of images, in which order. Nothing is opened."""

from __future__ import annotations

import fnmatch
import re
from pathlib import Path
from typing import Any

from pipelines.errors import InputError

IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".tif",
    ".tiff",
    ".bmp",
    ".webp",
    ".exr",
    ".dpx",
    ".jp2",
    ".ppm",
    ".pgm",
)
_COUNTER = re.compile(r"%0?\d*d")


def is_there(path: Path) -> bool:
    """Whether a file or a folder has that name.

    Raises InputError: the system does not take the name or let us look; a pipe or a device, which cannot be read twice.
    """
    try:
        there = path.exists()
    except OSError as error:
        raise InputError(path, f"cannot be looked at ({error.strerror})", "check the path") from None
    if "\0" in str(path):
        raise InputError(path, "no file has such a name (it holds a zero byte)", "check the path")
    if there and not (path.is_file() or path.is_dir()):
        cause = "is a pipe or a device, and a clip is read more than once"
        raise InputError(path, cause, "give it on standard input and - as the clip")
    return there


def is_pattern(path: Path) -> bool:
    """Whether a path stands for many images: frames/%06d.png or frames/*.png. A file of just that name is that file."""
    return bool(_COUNTER.search(path.name) or any(sign in path.name for sign in "*?[")) and not is_there(path)


def list_images(path: Path) -> list[Path]:
    """The images of a folder, or those that match the pattern, in the order of the numbers in their names.

    A counter (%d, %06d) matches any number; * ? [a-z] match as in a shell, images only.
    """
    parent = path if path.is_dir() else path.parent
    if not parent.is_dir():
        return []
    names = [p for p in parent.iterdir() if not p.name.startswith(".")]
    # Files only: opening a pipe of that name would wait for ever.
    images = [p for p in names if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
    if path.is_dir():
        found = images
    elif _COUNTER.search(path.name):
        exact = "".join(r"\d+" if i % 2 else re.escape(part) for i, part in enumerate(_split(path.name)))
        found = [p for p in names if re.fullmatch(exact, p.name) and p.is_file()]
    else:
        found = [p for p in images if fnmatch.fnmatchcase(p.name, path.name)]

    def numbers(p: Path) -> list[Any]:
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", p.name)]

    return sorted(found, key=numbers)


def _split(name: str) -> list[str]:
    """Text, counter, text, counter, ... text."""
    parts, end = [], 0
    for match in _COUNTER.finditer(name):
        parts += [name[end : match.start()], match[0]]
        end = match.end()
    return [*parts, name[end:]]
