"""A panorama.tif in JPEG tiles: those of its own pyramid, decoded one by one and kept while there is room."""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from mosaic.framestore import eight_bits
from pipelines.errors import InputError

QUALITY = 88
KEPT = 400  # tiles of about 40 KB
UNSEEN = 24  # grey of what was never seen: not taken for a dark stand


class Tiles:
    """Tiles of one panorama.tif. levels: (w, h) px, the finest first; tile_px: side of a tile. Safe from threads."""

    def __init__(self, path: Path) -> None:
        """Raises InputError: not a tiled RGBA TIFF as `run` writes it."""
        try:
            self._tiff = tifffile.TiffFile(path)
            pages: list[Any] = [level.pages[0] for level in self._tiff.series[0].levels]
        except (OSError, ValueError, IndexError, tifffile.TiffFileError) as error:
            raise InputError(path, f"cannot be read ({error})", "run again, into this folder") from None
        if any(
            not page.is_tiled or page.samplesperpixel != 4 or page.tilelength != page.tilewidth
            for page in pages
        ):
            self._tiff.close()
            raise InputError(path, "is not a panorama of broadcast-mosaic", "run again, into this folder")
        self._pages = pages
        self._lock = threading.Lock()
        self.tile_px = int(pages[0].tilewidth)
        self.levels = [(int(page.imagewidth), int(page.imagelength)) for page in pages]
        self.jpeg = lru_cache(maxsize=KEPT)(self._jpeg)

    def close(self) -> None:
        """Let go of the file."""
        self._tiff.close()

    def _jpeg(self, level: int, column: int, row: int) -> bytes | None:
        """A tile as a JPEG, cut at the picture's border; None where there is none."""
        if not 0 <= level < len(self.levels):
            return None
        width, height = self.levels[level]
        across, down = -(-width // self.tile_px), -(-height // self.tile_px)
        if not (0 <= column < across and 0 <= row < down):
            return None
        rgba = self._decoded(level, row * across + column)
        rgba = rgba[: height - row * self.tile_px, : width - column * self.tile_px]
        bgr = np.where(rgba[..., 3:] > 127, rgba[..., 2::-1], UNSEEN).astype(np.uint8)
        good, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        return data.tobytes() if good else None

    def _decoded(self, level: int, index: int) -> NDArray[np.uint8]:
        page = self._pages[level]
        with self._lock:
            self._tiff.filehandle.seek(page.dataoffsets[index])
            data = self._tiff.filehandle.read(page.databytecounts[index])
        tile = page.decode(data, index)[0]
        if tile is None:  # nothing was stored: an empty tile
            return np.zeros((self.tile_px, self.tile_px, 4), np.uint8)
        tile = eight_bits(np.asarray(tile))
        return tile.reshape(-1, self.tile_px, 4) if tile.ndim != 3 else tile
