"""panorama.png: full resolution, RGBA, tagged sRGB, on demand. Written row by row: no second picture in memory.

Rows are stored as differences to the one above (PNG's filter 2), which halves the file against none.
"""

from __future__ import annotations

import os
import struct
import zlib
from typing import BinaryIO

import numpy as np

from mosaic.composite import Panorama
from pipelines.exports.whole_file import whole_file

STRIP_ROWS = 128
UP = 2  # PNG filter type
PERCEPTUAL = b"\0"  # rendering intent of the sRGB chunk


def write_panorama_png(
    panorama: Panorama, path: str | os.PathLike[str], *, compression_level: int = 4
) -> None:
    """Write the picture with its alpha. Raises OSError when the folder cannot be written."""
    height, width = panorama.alpha.shape
    with whole_file(path) as temporary, temporary.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        _chunk(file, b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))
        _chunk(file, b"sRGB", PERCEPTUAL)
        packer = zlib.compressobj(compression_level)
        above = np.zeros((1, width, 4), np.uint8)
        for top in range(0, height, STRIP_ROWS):
            rows = np.s_[top : top + STRIP_ROWS]
            strip = np.concatenate([panorama.image[rows], panorama.alpha[rows][..., None]], axis=-1)
            step = strip - np.concatenate([above, strip[:-1]])  # modulo 256, as PNG wants it
            coded = np.full((len(strip), 1 + 4 * width), UP, np.uint8)
            coded[:, 1:] = step.reshape(len(strip), -1)
            above = strip[-1:]
            _chunk(file, b"IDAT", packer.compress(coded.tobytes()))
        _chunk(file, b"IDAT", packer.flush())
        _chunk(file, b"IEND", b"")
    panorama.release()


def _chunk(file: BinaryIO, kind: bytes, data: bytes) -> None:
    if data or kind == b"IEND":
        file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))
