"""cameras.pto: every frame of the shot that has a camera, as a Hugin project onto the run's panorama surface.

Conventions: pto.py. Without a panorama.json beside it the canvas is a full equirectangular turn at the finest zoom, at
most 32768 px wide. Hugin's pixels are square: a shot with other ones is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mosaic.surface import Surface
from pipelines.errors import InputError
from pipelines.exports.cameras import ShotCameras
from pipelines.exports.formats import ExportOptions
from pipelines.exports.panorama_json import read_surface
from pipelines.exports.pto import PtoFrame, write_pto

MAX_WIDTH_PX = 32768


def write(
    path: Path, cameras: ShotCameras, options: ExportOptions, *, panorama_json: Path | None = None
) -> Mapping[str, Any]:
    """Write the project; returns the surface. panorama_json: of the shot, where it is. Raises InputError: pixels that
    are not square."""
    aspect = cameras.aspect[cameras.rows]
    if np.abs(aspect - 1).max() > 1e-6:
        cause = f"its pixels are not square (fx / fy = {aspect[0]:.4f}), and Hugin knows no others"
        raise InputError(cameras.clip, cause, "stretch the clip to square pixels first, or choose colmap")
    surface = (
        read_surface(panorama_json)
        if panorama_json is not None and panorama_json.is_file()
        else full_turn(float(cameras.f_px[cameras.rows].max()))
    )
    write_pto(path, surface, [pto_frame(cameras, i) for i in cameras.rows.tolist()])
    return {"surface": surface.kind, "canvas_px": [surface.width, surface.height]}


def pto_frame(cameras: ShotCameras, i: int) -> PtoFrame:
    """A row that is known as a Hugin picture."""
    pan, tilt, roll = np.radians([cameras.pan_deg[i], cameras.tilt_deg[i], cameras.roll_deg[i]])
    return PtoFrame(
        name=f"frame_{int(cameras.frame[i]):06d}.png",
        size_px=cameras.size_px,
        f_px=float(cameras.f_px[i]),
        pan_rad=float(pan),
        tilt_rad=float(tilt),
        roll_rad=float(roll),
        cx_px=float(cameras.cx_px[i]),
        cy_px=float(cameras.cy_px[i]),
        k1=float(cameras.k1[i]),
    )


def full_turn(f_px: float) -> Surface:
    """An equirectangular canvas of a full turn, an even number of pixels wide, with the forward axis in its middle."""
    half = min(MAX_WIDTH_PX // 2, int(np.floor(np.pi * f_px)))
    half -= half % 2
    return Surface(
        kind="equirectangular",
        scale_px=half / np.pi,
        cx=half - 0.5,
        cy=half / 2 - 0.5,
        width=2 * half,
        height=half,
    )
