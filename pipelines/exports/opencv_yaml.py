"""OpenCV FileStorage YAML: picture size, camera_matrix and distortion_coefficients of the reference frame under the
names that calibration tools look for, and `frames`, a list with each frame's own (it zooms) and its rvec and tvec.

OpenCV's conventions are ours: pixel (0, 0) is the centre of the top-left pixel, k1 multiplies focal-normalised radii.
Frames without a camera are left out; without a camera for the reference frame the top keys are those of the first frame
that has one, and `camera_matrix_of_frame` says which. Source: OpenCV's documentation of FileStorage and of calib.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import rotation
from pipelines.exports.cameras import ShotCameras
from pipelines.exports.formats import ExportOptions
from pipelines.exports.whole_file import whole_file


def write(path: Path, cameras: ShotCameras, options: ExportOptions) -> Mapping[str, Any]:
    """Write the file; returns which frame the top keys belong to. Raises OSError when OpenCV cannot write it."""
    rows = cameras.rows.tolist()
    top = next((i for i in rows if int(cameras.frame[i]) == cameras.reference_frame), rows[0])
    rvecs = rotation.log(cameras.R_cam_world[rows])
    with whole_file(path) as temporary:
        store = cv2.FileStorage(str(temporary), cv2.FileStorage_WRITE)
        if not store.isOpened():
            raise OSError(f"{path} cannot be written by OpenCV")
        store.write("image_width", cameras.size_px[0])
        store.write("image_height", cameras.size_px[1])
        store.write("camera_matrix_of_frame", int(cameras.frame[top]))
        store.write("camera_matrix", camera_matrix(cameras, top))
        store.write("distortion_coefficients", coefficients(cameras, top))
        store.startWriteStruct("frames", cv2.FileNode_SEQ)
        for i, rvec in zip(rows, rvecs, strict=True):
            store.startWriteStruct("", cv2.FileNode_MAP)
            store.write("frame", int(cameras.frame[i]))
            store.write("camera_matrix", camera_matrix(cameras, i))
            store.write("distortion_coefficients", coefficients(cameras, i))
            store.write("rvec", np.ascontiguousarray(rvec.reshape(3, 1)))
            store.write("tvec", np.zeros((3, 1)))
            store.endWriteStruct()
        store.endWriteStruct()
        store.release()
    return {"camera_matrix_of_frame": int(cameras.frame[top])}


def camera_matrix(cameras: ShotCameras, i: int) -> NDArray[np.float64]:
    """K (3, 3) of a row, px."""
    return np.array(
        [
            [cameras.f_px[i], 0.0, cameras.cx_px[i]],
            [0.0, cameras.fy_px[i], cameras.cy_px[i]],
            [0.0, 0.0, 1.0],
        ]
    )


def coefficients(cameras: ShotCameras, i: int) -> NDArray[np.float64]:
    """OpenCV's k1, k2, p1, p2, k3 (1, 5) of a row."""
    return np.array([[cameras.k1[i], 0.0, 0.0, 0.0, 0.0]])
