"""SoccerNet camera-calibration JSON: a folder with camera_NNNNN.json per frame that has a camera.

World: x right, y towards the main camera, z down, so (x, y, z)_SN = (x, -z, y)_ours: pan = pan, tilt = 90 + tilt, roll
= roll. There is no pitch here to measure metres on: the position is 0 and the axes are the shot's own. The reader takes
the picture's size as twice the principal point and has no half-pixel shift: a principal point that was not estimated
(exactly the picture's middle) is written as (W/2, H/2) for it, an estimated one as it is. Source: SoccerNet's
camera-calibration challenge.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.exports.cameras import ShotCameras
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_folder


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the folder; returns what the position means."""
    with whole_folder(path) as folder:
        for i in cameras.rows.tolist():
            name = f"camera_{int(cameras.frame[i]):05d}.json"
            text = json.dumps(camera(cameras, i), allow_nan=False, indent=1)
            (folder / name).write_text(text + "\n", encoding="utf-8")
    return {
        "position": "0 0 0: no pitch was given, so there are no metres; angles are in the shot's own world"
    }


def camera(cameras: ShotCameras, i: int) -> dict[str, Any]:
    """The JSON of a row that is known."""
    w, h = cameras.size_px
    cx, cy = float(cameras.cx_px[i]), float(cameras.cy_px[i])
    if (cx, cy) == ((w - 1) / 2, (h - 1) / 2):
        cx, cy = w / 2, h / 2
    return {
        "pan_degrees": float(cameras.pan_deg[i]),
        "tilt_degrees": 90.0 + float(cameras.tilt_deg[i]),
        "roll_degrees": float(cameras.roll_deg[i]),
        "position_meters": [0.0, 0.0, 0.0],
        "x_focal_length": float(cameras.f_px[i]),
        "y_focal_length": float(cameras.fy_px[i]),
        "principal_point": [cx, cy],
        "radial_distortion": [float(cameras.k1[i]), 0.0, 0.0, 0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "thin_prism_distortion": [0.0, 0.0, 0.0, 0.0],
    }
