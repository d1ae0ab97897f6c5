"""COLMAP's sparse model, binary: the same values as colmap.py, little-endian. Source: COLMAP's format documentation."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.exports.cameras import ShotCameras
from pipelines.exports.colmap import entries
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_folder

MODEL_ID = {"SIMPLE_RADIAL": 2, "OPENCV": 4}


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write cameras.bin, images.bin, points3D.bin; returns {}: nothing of our camera is lost in this format."""
    width, height = cameras.size_px
    n = len(cameras.rows)
    with whole_folder(path) as folder:
        with (folder / "cameras.bin").open("wb") as lens, (folder / "images.bin").open("wb") as images:
            lens.write(struct.pack("<Q", n))
            images.write(struct.pack("<Q", n))
            for entry in entries(cameras):
                params = entry["params"]
                lens.write(struct.pack("<IiQQ", entry["id"], MODEL_ID[entry["model"]], width, height))
                lens.write(struct.pack(f"<{len(params)}d", *params))
                images.write(struct.pack("<I7dI", entry["id"], *entry["q"], 0.0, 0.0, 0.0, entry["id"]))
                images.write(entry["name"].encode() + b"\0" + struct.pack("<Q", 0))
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    return {}
