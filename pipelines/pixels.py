"""A decoded picture to arrays: its gray plane, its colours, upright. No file, no time."""

from __future__ import annotations

from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import Colorspace
from numpy.typing import NDArray

from pipelines.hdr import needs_mapping, to_bt709

# Shares of red and of blue in luma: ITU-R BT.709, BT.601, BT.2020; SMPTE 240M; FCC 73.682.
LUMA_WEIGHTS = {
    "ITU709": (0.2126, 0.0722),
    "ITU601": (0.299, 0.114),
    "BT2020": (0.2627, 0.0593),
    "SMPTE240M": (0.212, 0.087),
    "FCC": (0.30, 0.11),
}
FULL_RANGE = 2  # AVCOL_RANGE_JPEG


def gray_plane(video: av.VideoFrame, turns: int) -> NDArray[Any]:
    """(h, w) luma of a picture, turned upright, owned and read-only: uint8, or float32 0..255 above 8 bits."""
    name = video.format.name
    bits = video.format.components[0].bits
    if not name.startswith(("yuv4", "yuvj4", "yuva4", "gray", "nv12", "nv21", "nv16")) or name.startswith(
        "grayf"
    ):
        # RGB, packed and shifted layouts: one conversion to a plain plane; of 16 bits, because 10-bit to 8 dithers.
        packed_yuv = (
            not video.format.is_rgb and not video.format.has_palette and len(video.format.components) > 2
        )
        plain = (
            ("yuv422p" if packed_yuv else "gray")
            if bits <= 8
            else ("yuv444p16le" if packed_yuv else "gray16le")
        )
        video = video.reformat(format=plain)
        name, bits = plain, (8 if bits <= 8 else 16)
    plane: Any = video.planes[0]  # has the buffer protocol
    sample: np.dtype[Any] = (
        np.dtype(np.uint8) if bits <= 8 else np.dtype(">u2" if name.endswith("be") else "<u2")
    )
    padded = np.frombuffer(plane, sample).reshape(plane.height, plane.line_size // sample.itemsize)
    view = np.rot90(padded[:, : video.width], turns)
    # The copy detaches the picture from the decoder's pool, so that keeping a frame costs 2 MB, not a pool.
    gray = (
        np.array(view, np.uint8, order="C")
        if bits <= 8
        else view.astype(np.float32) / np.float32(1 << (bits - 8))
    )
    gray = np.ascontiguousarray(gray)
    gray.setflags(write=False)
    return gray


def rgb_picture(video: av.VideoFrame, turns: int) -> NDArray[np.uint8]:
    """(h, w, 3) RGB of a picture, turned upright; HDR and wide gamuts as BT.709 shows them (hdr.py)."""
    if needs_mapping(video):
        return np.ascontiguousarray(np.rot90(to_bt709(video, yuv_matrix(video)), turns))
    if video.format.is_rgb or video.format.has_palette:
        rgb = video.to_ndarray(format="rgb24")
    else:
        rgb = video.reformat(format="rgb24", src_colorspace=yuv_matrix(video)).to_ndarray()
    return np.ascontiguousarray(np.rot90(rgb, turns))


def deep_rgb_picture(video: av.VideoFrame, turns: int, mapped: bool = True) -> NDArray[np.uint16]:
    """(h, w, 3) RGB of 0..65535 of a picture, turned upright, with all the bits that it has.

    mapped: HDR and wide gamuts as BT.709 shows them (hdr.py), else in the clip's own primaries and transfer.
    """
    if mapped and needs_mapping(video):
        rgb: NDArray[np.uint16] = to_bt709(video, yuv_matrix(video), deep=True)
    elif video.format.has_palette or (video.format.is_rgb and video.format.components[0].bits <= 8):
        rgb = video.to_ndarray(format="rgb24").astype(np.uint16) * np.uint16(257)
    elif video.format.is_rgb:
        rgb = video.to_ndarray(format="rgb48le").astype(np.uint16, copy=False)
    else:
        # Not FFmpeg's RGB: its white is 65283. This layout holds the codes as they are, shifted up to 16 bits.
        planes = video.reformat(format="yuv444p16le").to_ndarray()
        if planes.shape[-1] != 3:
            planes = np.moveaxis(planes, 0, -1)
        full = int(video.color_range) == FULL_RANGE or video.format.name.startswith("yuvj")
        red, blue = LUMA_WEIGHTS[yuv_matrix(video).name]
        rgb = _decoded(np.ascontiguousarray(planes), red, blue, full, video.format.components[0].bits)
    return np.ascontiguousarray(np.rot90(rgb, turns))


def _decoded(yuv: NDArray[np.uint16], red: float, blue: float, full: bool, bits: int) -> NDArray[np.uint16]:
    """RGB of 0..65535 of YCbCr codes (h, w, 3) that were shifted up to 16 bits; red, blue: their shares in luma."""
    step = float(1 << (16 - bits))
    top = float((1 << bits) - 1) * step
    black, luma, chroma = (0.0, top, top) if full else (16.0 * 256, 219.0 * 256, 224.0 * 256)
    green = 1 - red - blue
    y, cb, cr = 65535 / luma, 65535 * 2 * (1 - blue) / chroma, 65535 * 2 * (1 - red) / chroma
    M = np.array([[y, 0, cr], [y, -cb * blue / green, -cr * red / green], [y, cb, 0]])
    offset = -M @ np.array([black, 32768.0, 32768.0])
    rgb = cv2.transform(yuv.astype(np.float32), np.column_stack([M, offset]).astype(np.float32))
    return np.clip(rgb + 0.5, 0, 65535).astype(np.uint16)


def yuv_matrix(video: av.VideoFrame) -> Colorspace:
    """The YCbCr matrix: as tagged; untagged, BT.709 from 720 lines up (FFmpeg would take BT.601: red turns orange)."""
    tagged = int(video.colorspace)
    known = {
        1: Colorspace.ITU709,
        4: Colorspace.FCC,
        5: Colorspace.ITU601,
        6: Colorspace.ITU601,
        7: Colorspace.SMPTE240M,
        9: Colorspace.BT2020,
        10: Colorspace.BT2020,
    }
    return known.get(tagged, Colorspace.ITU709 if video.height >= 720 else Colorspace.ITU601)


def quarter_turns(video: av.VideoFrame) -> int:
    """Quarter turns counter-clockwise that put the picture upright."""
    return round(int(getattr(video, "rotation", 0) or 0) / 90) % 4
