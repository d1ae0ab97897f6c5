"""panorama.tif: full resolution, tiled, deflate, levels of half size in SubIFDs, RGBA tagged sRGB, BigTIFF when
large; 16 bits a channel, with the horizontal predictor, where the clip has more than 8.

tifffile takes one tile at a time; each level is the mean over 2 x 2 px of the one above, weighted by alpha, so that
unseen black does not darken the border of what was seen.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from mosaic.composite import Canvas, Panorama
from pipelines.exports.panorama_jpeg import gpano_xmp
from pipelines.exports.srgb import srgb_profile
from pipelines.exports.whole_file import whole_file

TILE_PX = 512
BIG_BYTES = 2 << 30  # uncompressed; well below the 4 GiB that a classic TIFF can address


def write_panorama_tiff(
    panorama: Panorama,
    path: str | os.PathLike[str],
    *,
    compression_level: int = 3,
    threads: int = 2,
    memory_bytes: int = 200_000_000,
    scratch: str | os.PathLike[str] | None = None,
) -> int:
    """Write the picture with its pyramid; returns the number of levels, the full one included.

    Levels are added until both sides fit one tile. Reduced levels beyond memory_bytes live in a scratch file.
    Raises OSError when the folder cannot be written.
    """
    height, width = panorama.alpha.shape
    n_levels = 1
    while max(height, width) >> (n_levels - 1) > TILE_PX:
        n_levels += 1
    canvas = Canvas(scratch or tempfile.gettempdir(), memory_bytes)

    def release() -> None:
        panorama.release()
        canvas.release()

    packet = gpano_xmp(panorama.surface) if panorama.surface.kind == "equirectangular" else None
    extra = [] if packet is None else [(700, "B", len(packet), packet, True)]
    picture: NDArray[Any] = panorama.image if panorama.deep is None else panorama.deep
    depth = picture.itemsize
    with (
        whole_file(path) as temporary,
        tifffile.TiffWriter(temporary, bigtiff=width * height * 16 // 3 * depth > BIG_BYTES) as writer,
    ):
        image, alpha = picture, panorama.alpha
        for level in range(n_levels):
            if level:
                image, alpha = halve(image, alpha, canvas, release)
            writer.write(
                _tiles(image, alpha, release),
                shape=(*alpha.shape, 4), dtype=picture.dtype, photometric="rgb", extrasamples=["unassalpha"],
                predictor=depth > 1,
                tile=(TILE_PX, TILE_PX), compression="zlib", compressionargs={"level": compression_level},
                maxworkers=threads, subifds=n_levels - 1 if level == 0 else None, subfiletype=1 if level else 0,
                extratags=extra if level == 0 else [], software="broadcast-mosaic", metadata=None,
                iccprofile=srgb_profile() if level == 0 else None,
            )  # fmt: skip
            release()
    return n_levels


def _tiles(
    image: NDArray[Any], alpha: NDArray[np.uint8], release: Callable[[], None]
) -> Iterator[NDArray[Any]]:
    """RGBA tiles row by row, those at the border padded with transparent black; alpha full where the colour is.
    release: called after each row of tiles, which is not needed again soon."""
    full = np.iinfo(image.dtype).max // 255
    height, width = alpha.shape
    for y in range(0, height, TILE_PX):
        for x in range(0, width, TILE_PX):
            tile = np.zeros((TILE_PX, TILE_PX, 4), image.dtype)
            part = alpha[y : y + TILE_PX, x : x + TILE_PX]
            tile[: part.shape[0], : part.shape[1], :3] = image[y : y + TILE_PX, x : x + TILE_PX]
            tile[: part.shape[0], : part.shape[1], 3] = part.astype(image.dtype) * full
            yield tile
        release()


def halve(
    image: NDArray[Any], alpha: NDArray[np.uint8], canvas: Canvas, release: Callable[[], None] | None = None
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Means over 2 x 2 px, colours weighted by alpha; an odd last row or column stands for two. release: called now
    and then."""
    height, width = alpha.shape
    small = ((height + 1) // 2, (width + 1) // 2)
    half_image, half_alpha = canvas.zeros((*small, 3), image.dtype.type), canvas.zeros(small)
    step = 256
    for row in range(0, small[0], step):
        source = np.s_[2 * row : 2 * (row + step)]
        part, share = image[source], alpha[source]
        pad = ((0, part.shape[0] % 2), (0, width % 2))
        part = np.pad(part, (*pad, (0, 0)), mode="edge")
        share = np.pad(share, pad, mode="edge").astype(np.uint32)
        colour = sum(part[i::2, j::2] * share[i::2, j::2, None] for i in (0, 1) for j in (0, 1))
        total = sum(share[i::2, j::2] for i in (0, 1) for j in (0, 1))
        target = np.s_[row : row + step]
        divisor = np.maximum(total, 1)[..., None]
        half_image[target] = (colour + divisor // 2) // divisor
        half_alpha[target] = (total + 2) // 4
        if release is not None and row % (4 * step) == 0:
            release()
    return half_image, half_alpha
