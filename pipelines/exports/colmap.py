"""COLMAP's sparse model as text: cameras.txt, images.txt, points3D.txt.

Pixel origin is COLMAP's: the centre of the top-left pixel is (0.5, 0.5), so the principal point moves by half a pixel.
q and t are world to camera, t = 0 because the camera only turns. SIMPLE_RADIAL where fx = fy, else OPENCV; both have
our k1. One camera a frame, for each has its own zoom. Frames without a camera are left out. Source: COLMAP's format
documentation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.cameras import ShotCameras, plain
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_folder

HALF_PX = 0.5


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the folder; returns {}: nothing of our camera is lost in this format."""
    width, height = cameras.size_px
    with whole_folder(path) as folder:
        with (
            (folder / "cameras.txt").open("w", encoding="utf-8") as lens,
            (folder / "images.txt").open("w", encoding="utf-8") as images,
        ):
            lens.write(
                "# Camera list with one line of data per camera:\n#   ID MODEL WIDTH HEIGHT PARAMS[]\n"
            )
            images.write(
                "# Two lines per image: ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its 2-D points\n"
            )
            for entry in entries(cameras):
                numbers = " ".join(plain(v) for v in entry["params"])
                lens.write(f"{entry['id']} {entry['model']} {width} {height} {numbers}\n")
                pose = " ".join(plain(v) for v in (*entry["q"], 0.0, 0.0, 0.0))
                images.write(f"{entry['id']} {pose} {entry['id']} {entry['name']}\n\n")
        (folder / "points3D.txt").write_text("# no points: the camera only turns\n", encoding="utf-8")
    return {}


def entries(cameras: ShotCameras) -> Iterator[dict[str, Any]]:
    """Per frame with a camera: id, image name, model, params as COLMAP wants them, unit quaternion (w, x, y, z)."""
    for i in cameras.rows:
        fx, fy, k1 = (float(v[i]) for v in (cameras.f_px, cameras.fy_px, cameras.k1))
        cx, cy = float(cameras.cx_px[i]) + HALF_PX, float(cameras.cy_px[i]) + HALF_PX
        square = abs(fx / fy - 1) < 1e-12
        frame = int(cameras.frame[i])
        yield {
            "id": frame + 1,
            "name": f"frame_{frame:06d}.png",
            "model": "SIMPLE_RADIAL" if square else "OPENCV",
            "params": (fx, cx, cy, k1) if square else (fx, fy, cx, cy, k1, 0.0, 0.0, 0.0),
            "q": quaternion(cameras.R_cam_world[i]),
        }


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation (3, 3). Largest component first: exact at any angle."""
    trace = float(np.trace(R))
    squares = np.array([trace, *(2 * np.diag(R) - trace)])  # 4 w^2 - 1, 4 x^2 - 1, ...
    largest = int(np.argmax(squares))
    q = np.empty(4)
    off = ((R[2, 1] - R[1, 2]), (R[0, 2] - R[2, 0]), (R[1, 0] - R[0, 1]))  # 4 w x, 4 w y, 4 w z
    if largest == 0:
        q[:] = (1 + trace, *off)
    else:
        a = largest - 1
        q[0] = off[a]
        q[1:] = R[a] + R[:, a]
        q[largest] = 1 + 2 * R[a, a] - trace
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q
