"""panorama.dzi and panorama_files/: Deep Zoom tiles, for OpenSeadragon and its like, on demand.

Level n is the whole picture at 2^-(N - n) of its size, N = ceil(log2(longer side)); tiles of 254 px with one px of the
neighbours on each inner side, column_row.jpg; unseen is black. Source: Deep Zoom file format, Microsoft, 2008.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mosaic.composite import Canvas, Panorama
from pipelines.exports.panorama_tiff import halve
from pipelines.exports.whole_file import whole_file, whole_folder

TILE_PX = 254
OVERLAP_PX = 1


def write_panorama_deepzoom(
    panorama: Panorama,
    path: str | os.PathLike[str],
    *,
    quality: int = 88,
    memory_bytes: int = 200_000_000,
    scratch: str | os.PathLike[str] | None = None,
) -> list[Path]:
    """Write NAME.dzi at `path` and NAME_files beside it; returns all files. Raises OSError when the folder cannot be
    written."""
    final = Path(path)
    height, width = panorama.alpha.shape
    canvas = Canvas(scratch or tempfile.gettempdir(), memory_bytes)
    image, alpha = panorama.image, panorama.alpha
    tiles: list[Path] = []
    folder = final.with_name(f"{final.stem}_files")
    with whole_folder(folder) as temporary:
        for level in range(n_levels(width, height) - 1, -1, -1):
            place = temporary / str(level)
            place.mkdir()
            for name in _write_level(image, place, quality):
                tiles.append(folder / str(level) / name)
            if level:
                image, alpha = halve(image, alpha, canvas)
            panorama.release()
            canvas.release()
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{OVERLAP_PX}" '
        f'TileSize="{TILE_PX}"><Size Width="{width}" Height="{height}"/></Image>\n'
    )
    with whole_file(final) as written:
        written.write_text(text, encoding="utf-8")
    return [final, *tiles]


def n_levels(width: int, height: int) -> int:
    """Levels of a picture, the one of 1 x 1 px and the full one included."""
    return (max(width, height) - 1).bit_length() + 1


def _write_level(image: NDArray[np.uint8], folder: Path, quality: int) -> list[str]:
    height, width = image.shape[:2]
    names = []
    for row in range(-(-height // TILE_PX)):
        for column in range(-(-width // TILE_PX)):
            top, left = max(row * TILE_PX - OVERLAP_PX, 0), max(column * TILE_PX - OVERLAP_PX, 0)
            part = image[top : (row + 1) * TILE_PX + OVERLAP_PX, left : (column + 1) * TILE_PX + OVERLAP_PX]
            names.append(f"{column}_{row}.jpg")
            Image.fromarray(np.ascontiguousarray(part)).save(folder / names[-1], quality=quality)
    return names
