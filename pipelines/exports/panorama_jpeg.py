"""panorama.jpg: for people. At most 16384 px wide, tagged sRGB; an equirectangular one carries GPano metadata.

GPano (Google's Photo Sphere XMP) knows the equirectangular projection only: for a cylinder or a plane it would lie,
so they get none.
"""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mosaic.composite import Panorama
from mosaic.surface import Surface
from pipelines.exports.srgb import srgb_profile
from pipelines.exports.whole_file import whole_file

MAX_WIDTH_PX = 16384
LIMIT_PX = 65500  # libjpeg's, not 65535


def write_panorama_jpeg(
    panorama: Panorama, path: str | os.PathLike[str], *, max_width_px: int = MAX_WIDTH_PX, quality: int = 92
) -> tuple[int, int]:
    """Write the picture, reduced to max_width_px where it is wider. Returns its size in px. Unseen pixels are black.

    Raises OSError when the folder cannot be written.
    """
    surface = panorama.surface
    factor = min(1.0, max_width_px / surface.width, LIMIT_PX / surface.height)
    size = (max(1, round(surface.width * factor)), max(1, round(surface.height * factor)))
    picture = Image.fromarray(panorama.image)
    if size != picture.size:
        picture = Image.fromarray(_reduce(panorama.image, size))
    scaled = scaled_surface(surface, size)
    options = {"xmp": gpano_xmp(scaled)} if scaled.kind == "equirectangular" else {}
    with whole_file(path) as temporary:
        picture.save(
            temporary, format="JPEG", quality=quality, subsampling=0 if quality >= 90 else 2,
            icc_profile=srgb_profile(), **options,
        )  # fmt: skip
    panorama.release()
    return size


def _reduce(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Area average to size (w, h), in strips so that no second full picture is in memory."""
    height = image.shape[0]
    edges = np.linspace(0, size[1], max(2, height // 1024 + 1)).astype(int)
    out = np.empty((size[1], size[0], 3), np.uint8)
    for top, bottom in pairwise(edges):
        box = (0, top * height / size[1], image.shape[1], bottom * height / size[1])
        first, last = int(box[1]), int(np.ceil(box[3]))
        strip = Image.fromarray(image[first:last])
        inner = (0, box[1] - first, image.shape[1], box[3] - first)
        out[top:bottom] = np.asarray(
            strip.resize((size[0], int(bottom - top)), Image.Resampling.BOX, box=inner)
        )
    return out


def scaled_surface(surface: Surface, size: tuple[int, int]) -> Surface:
    """The surface of a picture resized to size (w, h) px, outer edges kept."""
    factor = size[0] / surface.width
    return replace(
        surface,
        scale_px=surface.scale_px * factor,
        cx=(surface.cx + 0.5) * factor - 0.5,
        cy=(surface.cy + 0.5) * size[1] / surface.height - 0.5,
        width=size[0],
        height=size[1],
    )


def gpano_fields(surface: Surface) -> dict[str, str]:
    """GPano's names and values for an equirectangular crop. All counts are whole pixels: exact for a surface of
    choose_surface at its own size, rounded (at most a pixel) where the picture was reduced.

    Raises ValueError for another surface.
    """
    if surface.kind != "equirectangular":
        raise ValueError(f"GPano metadata is for equirectangular pictures, not {surface.kind}")
    full = 2 * round(np.pi * surface.scale_px)
    return {
        "ProjectionType": "equirectangular",
        "UsePanoramaViewer": "True",
        "FullPanoWidthPixels": str(full),
        "FullPanoHeightPixels": str(full // 2),
        "CroppedAreaImageWidthPixels": str(surface.width),
        "CroppedAreaImageHeightPixels": str(surface.height),
        # The forward axis is the middle of the full picture: half of it, minus where it falls in the crop.
        "CroppedAreaLeftPixels": str(round(full / 2 - surface.cx - 0.5)),
        "CroppedAreaTopPixels": str(round(full / 4 - surface.cy - 0.5)),
    }


def gpano_xmp(surface: Surface) -> bytes:
    """The XMP packet with gpano_fields."""
    fields = "\n".join(f'   GPano:{name}="{value}"' for name, value in gpano_fields(surface).items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"\n'
        f"{fields}/>\n"
        " </rdf:RDF>\n</x:xmpmeta>\n"
        '<?xpacket end="w"?>'
    ).encode()
