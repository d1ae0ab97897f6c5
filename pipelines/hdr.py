"""HDR and wide-gamut pictures to BT.709, which screens and our files (tagged sRGB) show: one 3-D table per clip.

The colour science is FFmpeg's: its scaler maps a lattice of all codes once (perceptual intent: highlights are drawn in,
not cut off; some seconds), its lut3d filter then takes every picture through that table (some milliseconds).
"""

from __future__ import annotations

import tempfile
import threading
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.filter import Graph
from av.video.reformatter import Colorspace
from numpy.typing import NDArray

TRANSFERS = {16: "PQ (SMPTE ST 2084)", 18: "HLG (ARIB STD-B67)"}  # by FFmpeg's AVCOL_TRC
WIDE_PRIMARIES = {9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}  # by FFmpeg's AVCOL_PRI
UNSPECIFIED, BT709 = 2, 1
NODES = 33  # of the table along each axis, as colourists use it
MATRICES = {
    Colorspace.ITU709: "bt709", Colorspace.FCC: "fcc", Colorspace.ITU601: "smpte170m",
    Colorspace.SMPTE240M: "smpte240m", Colorspace.BT2020: "bt2020nc",
}  # fmt: skip

_LOCK = threading.Lock()  # a filter graph takes one picture at a time
_GRAPHS: dict[tuple[Any, ...], Graph] = {}
KEPT_GRAPHS = 4


def needs_mapping(video: av.VideoFrame) -> bool:
    """Whether a picture is tagged with a transfer or primaries that a BT.709 screen would show wrong."""
    return _tag(video, "color_trc") in TRANSFERS or _tag(video, "color_primaries") in WIDE_PRIMARIES


def to_bt709(video: av.VideoFrame, matrix: Colorspace, *, deep: bool = False) -> NDArray[Any]:
    """(h, w, 3) RGB, BT.709 primaries and transfer; uint8, or uint16 of 0..65535 where `deep`.

    matrix: of its YCbCr (unused for an RGB picture).
    """
    transfer = _tag(video, "color_trc")
    primaries = _tag(video, "color_primaries")
    # HDR without primaries is BT.2020 by its standard (BT.2100); wide primaries without a transfer are SDR.
    tags = (
        transfer if transfer in TRANSFERS else BT709,
        primaries if primaries in WIDE_PRIMARIES else (9 if transfer in TRANSFERS else BT709),
    )
    full = int(video.color_range) == 2 or video.format.is_rgb or video.format.name.startswith("yuvj")
    key = (video.width, video.height, video.format.name, matrix, full, tags, deep)
    with _LOCK:
        graph = _GRAPHS.pop(key, None) or _graph(video, matrix, full, *tags, deep)
        _GRAPHS[key] = graph
        if len(_GRAPHS) > KEPT_GRAPHS:
            _GRAPHS.pop(next(iter(_GRAPHS)))
        graph.push(video)
        return np.asarray(graph.pull().to_ndarray(), np.uint16 if deep else np.uint8)


def _tag(video: av.VideoFrame, name: str) -> int:
    return int(getattr(video, name, UNSPECIFIED))


def _graph(
    video: av.VideoFrame, matrix: Colorspace, full: bool, transfer: int, primaries: int, deep: bool
) -> Graph:
    graph = Graph()
    name = video.format.name
    source = graph.add(
        "buffer",
        args=f"video_size={video.width}x{video.height}:pix_fmt={name}:time_base=1/25:pixel_aspect=1/1"
        f":colorspace={int(video.colorspace)}:range={int(video.color_range)}",
    )
    values = f"in_range={'full' if full else 'limited'}"
    if not video.format.is_rgb:
        values += f":in_color_matrix={MATRICES[matrix]}"
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.cube"
        table.write_text(_cube(bt709_table(transfer, primaries)))
        steps = [
            graph.add("scale", args=values + ":flags=bicubic+accurate_rnd+full_chroma_int"),
            graph.add("format", "pix_fmts=gbrp12le"),
            # Of the tags only numbers are left: or the scaler would map the table's output a second time.
            graph.add("setparams", "color_primaries=bt709:color_trc=bt709"),
            graph.add("lut3d", args=f"file='{table}':interp=tetrahedral"),
            graph.add("format", "pix_fmts=rgb48le" if deep else "pix_fmts=rgb24"),
            graph.add("buffersink"),
        ]
        for a, b in pairwise([source, *steps]):
            a.link_to(b)
        graph.configure()
    return graph


@lru_cache(maxsize=4)
def bt709_table(transfer: int, primaries: int) -> NDArray[np.float32]:
    """(33, 33, 33, 3), 0..1: BT.709 codes of RGB codes [blue, green, red]; AVCOL numbers."""
    graph = Graph()
    size = (NODES * NODES, NODES)
    chain = [
        graph.add(
            "buffer",
            args=f"video_size={size[0]}x{size[1]}:pix_fmt=rgb48le:time_base=1/25:colorspace=gbr:range=pc",
        ),
        graph.add("scale", args="out_transfer=bt709:out_primaries=bt709:intent=perceptual"),
        graph.add("format", "pix_fmts=rgb48le"),
        graph.add("buffersink"),
    ]
    for a, b in pairwise(chain):
        a.link_to(b)
    graph.configure()
    codes = np.linspace(0, 65535, NODES).round().astype("<u2")
    blue, green, red = np.meshgrid(codes, codes, codes, indexing="ij")
    lattice = np.ascontiguousarray(np.stack([red, green, blue], axis=-1).reshape(size[1], size[0], 3))
    picture = av.VideoFrame.from_ndarray(lattice, format="rgb48le")
    picture.color_trc, picture.color_primaries = transfer, primaries
    picture.color_range, picture.colorspace = 2, 0
    graph.push(picture)
    mapped: Any = graph.pull()
    return np.asarray(mapped.to_ndarray().reshape(NODES, NODES, NODES, 3) / np.float32(65535), np.float32)


def _cube(table: NDArray[np.float32]) -> str:
    """An Iridas/Adobe .cube file: red runs fastest."""
    lines = [f"LUT_3D_SIZE {NODES}", *(f"{r:.6f} {g:.6f} {b:.6f}" for r, g, b in table.reshape(-1, 3))]
    return "\n".join(lines) + "\n"
