"""Nuke's .chan: one line a frame with a camera, TAB separated: frame tx ty tz rx ry rz vfov.

y up, the camera looks along -z: rx = tilt, ry = -pan, rz = -roll, rotation order ZXY (a Nuke camera's own default).
vfov = 2 atan(H / 2 fy) of the undistorted pinhole, degrees. The format has neither principal point nor distortion;
the notes say how many px that leaves out. Pan stays continuous, so that a curve editor shows no jump. Source: Nuke's
manual, "import chan".
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.exports.cameras import ShotCameras, plain
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_file


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the file; returns what the format cannot say, in px, and the pixel aspect that the reader must be told."""
    first = 1 if options.first_frame is None else options.first_frame
    vfov = np.degrees(2 * np.arctan(cameras.size_px[1] / (2 * cameras.fy_px)))
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        for i in cameras.rows:
            values = (0.0, 0.0, 0.0, cameras.tilt_deg[i], -cameras.pan_deg[i], -cameras.roll_deg[i], vfov[i])
            frame = int(cameras.frame[i]) + first
            stream.write("\t".join([str(frame), *(plain(v) for v in values)]) + "\n")
    return {
        "first_frame": first,
        "pixel_aspect": float(1 / np.median(cameras.aspect[cameras.rows])),
        "not_in_this_format": {
            "distortion_px": round(cameras.largest_distortion_px(), 3),
            "principal_point_offset_px": round(cameras.largest_pp_offset_px(), 3),
        },
    }
