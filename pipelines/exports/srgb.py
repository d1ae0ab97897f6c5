"""The colour tag of our pictures: sRGB, as which video's BT.709 codes are shown on screens."""

from __future__ import annotations

import struct
from functools import lru_cache

from PIL import ImageCms

DATE = slice(24, 36)  # of an ICC header: year to second, as it was made


@lru_cache(maxsize=1)
def srgb_profile() -> bytes:
    """An ICC profile of sRGB, the same bytes at any time: equal runs give equal files."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    profile[DATE] = struct.pack(">6H", 2000, 1, 1, 0, 0, 0)
    return bytes(profile)
