"""A USD camera with time samples, as text (.usda): read by Blender, Houdini, Unreal, Nuke and usdview.

y up, the camera looks along -z: with F = diag(1, -1, -1) the camera-to-world matrix is F R^T F, and USD holds its
transpose (row vectors). horizontalAperture = sensor width, focalLength = fx in the same mm; the aperture offsets move
the window, so the principal point's x enters with a minus. k1 has no standard attribute: it is the custom attribute
broadcastMosaic:k1, and the plate has to be undistorted. Over frames without a camera the attributes are blocked, which
is USD's 'no value': without a block readers would interpolate. Source: UsdGeomCamera's documentation.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.exports.cameras import ShotCameras, plain
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_file

PRIM = "Camera"
FLIP = np.diag([1.0, -1.0, -1.0])
PIXEL_CENTRE = 0.5


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the stage; returns the sensor width used, whether it is nominal, and the largest distortion in px."""
    first = options.first_frame or 0
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        for line in lines(cameras, first):
            stream.write(line + "\n")
    return {
        "first_frame": first,
        "sensor_width_mm": cameras.sensor_mm,
        "sensor_width_is_nominal": cameras.sensor_width_mm is None,
        "not_in_this_format": {"distortion_px": round(cameras.largest_distortion_px(), 3)},
    }


def lines(cameras: ShotCameras, first: int) -> Iterator[str]:
    """The file, line by line."""
    (w, h), mm = cameras.size_px, cameras.sensor_mm
    per_px = mm / w
    frames = cameras.frame + first
    height_mm = mm * h / w * cameras.aspect  # of a frame: fx / fy scales the vertical pixel
    focal_mm = cameras.f_px * per_px
    shift_x = -(cameras.cx_px + PIXEL_CENTRE - w / 2) * per_px
    shift_y = (cameras.cy_px + PIXEL_CENTRE - h / 2) * per_px * cameras.aspect
    to_world = FLIP @ np.swapaxes(cameras.R_cam_world, -1, -2) @ FLIP

    yield "#usda 1.0"
    yield "("
    yield f'    defaultPrim = "{PRIM}"'
    yield f"    endTimeCode = {int(frames[-1])}"
    yield f"    framesPerSecond = {plain(cameras.picture_fps)}"
    yield "    metersPerUnit = 1"
    yield f"    startTimeCode = {int(frames[0])}"
    yield f"    timeCodesPerSecond = {plain(cameras.picture_fps)}"
    yield '    upAxis = "Y"'
    yield ")"
    yield ""
    yield f'def Camera "{PRIM}" ('
    yield "    customData = {"
    yield "        dictionary broadcastMosaic = {"
    yield f"            string clip = {json.dumps(cameras.clip, ensure_ascii=False)}"
    yield f"            int shot = {cameras.shot}"
    yield f"            string world = {json.dumps(cameras.world)}"
    yield f"            bool sensorWidthIsNominal = {str(cameras.sensor_width_mm is None).lower()}"
    yield "        }"
    yield "    }"
    yield ")"
    yield "{"
    yield "    float2 clippingRange = (0.1, 100000)"
    yield f"    float horizontalAperture = {plain(mm)}"
    yield from _samples("float verticalAperture", cameras, frames, lambda i: plain(height_mm[i]), block=False)
    yield from _samples(
        "float horizontalApertureOffset", cameras, frames, lambda i: plain(shift_x[i]), block=False
    )
    yield from _samples(
        "float verticalApertureOffset", cameras, frames, lambda i: plain(shift_y[i]), block=False
    )
    yield from _samples("float focalLength", cameras, frames, lambda i: plain(focal_mm[i]))
    yield '    token projection = "perspective"'
    yield from _samples("custom double broadcastMosaic:k1", cameras, frames, lambda i: plain(cameras.k1[i]))
    yield from _samples("matrix4d xformOp:transform", cameras, frames, lambda i: _matrix(to_world[i].T))
    yield '    uniform token[] xformOpOrder = ["xformOp:transform"]'
    yield "}"


def _samples(
    name: str,
    cameras: ShotCameras,
    frames: np.ndarray,
    text: Callable[[int], str],
    *,
    block: bool = True,
) -> Iterator[str]:
    """One value where it never changes and need not be blocked, else a sample a frame and a block per gap."""
    texts = {int(i): text(int(i)) for i in cameras.rows}
    if not block and len(set(texts.values())) == 1:
        yield f"    {name} = {next(iter(texts.values()))}"
        return
    yield f"    {name}.timeSamples = {{"
    before = True
    for i, known in enumerate(cameras.known.tolist()):
        if known:
            yield f"        {int(frames[i])}: {texts[i]},"
        elif before and block:
            yield f"        {int(frames[i])}: None,"
        before = known
    yield "    }"


def _matrix(rows: np.ndarray) -> str:
    """Rotation rows as USD's 4 x 4 matrix text, no translation."""
    four = np.eye(4)
    four[:3, :3] = rows
    return "( " + ", ".join("(" + ", ".join(plain(v) for v in row) + ")" for row in four) + " )"
