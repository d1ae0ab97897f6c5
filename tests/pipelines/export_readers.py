"""Readers of exports for the tests: the format's own package, or, where there is none, the format's text by hand.

Each takes the file and the truth and gives back a function from a row and rays to pixels.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tests.pipelines.export_truth import FIRST, LOST, Array, N, Truth
from tests.synth.camera import rotation_cam_world

ROWS = [i for i in range(N) if i != LOST]
Project = Callable[[int, Array], Array]  # row of the truth, rays (n, 3) in the shot world -> pixels (n, 2)


def about(axis: int, degrees: float) -> Array:
    """Right-handed rotation (3, 3) about a coordinate axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.eye(3)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    R[a, a], R[a, b], R[b, a], R[b, b] = c, -s, s, c
    return R


def pinhole(points: Array, fx: float, fy: float, c: tuple[float, float], k1: float) -> Array:
    """Pixels of points (n, 3) in camera axes x right, y down, z forward."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    g = 1 + k1 * (x * x + y * y)
    return np.stack([fx * x * g + c[0], fy * y * g + c[1]], axis=-1)


def read_colmap(path: Path, known: Truth) -> Project:
    import pycolmap

    model = pycolmap.Reconstruction(str(path))
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == [f"frame_{FIRST + i:06d}.png" for i in ROWS]

    def project(i: int, rays: Array) -> Array:
        image = images[f"frame_{FIRST + i:06d}.png"]
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == known.size_px
        pixels: Array = camera.img_from_cam(image.cam_from_world() * rays)
        return pixels - 0.5  # COLMAP's origin is the corner of the top-left pixel

    return project


def read_usd(path: Path, known: Truth) -> Project:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetTimeCodesPerSecond() == 50
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (FIRST, FIRST + N - 1)
    camera = UsdGeom.Camera(stage.GetDefaultPrim())
    k1 = stage.GetDefaultPrim().GetAttribute("broadcastMosaic:k1")
    focal = camera.GetFocalLengthAttr()
    assert focal.Get(FIRST + LOST) is None and k1.Get(FIRST + LOST) is None, "a gap has no value"
    # Read now: prims die with their stage.
    frustums = {i: camera.GetCamera(FIRST + i).frustum for i in ROWS}
    bend = {i: k1.Get(FIRST + i) for i in ROWS}
    w, h = known.size_px

    def project(i: int, rays: Array) -> Array:
        frustum = frustums[i]
        both = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
        points = np.c_[rays * [1, -1, -1] * 10, np.ones(len(rays))] @ both
        ndc = points[:, :2] / points[:, 3:]
        ideal = np.stack([(ndc[:, 0] + 1) / 2 * w - 0.5, (1 - ndc[:, 1]) / 2 * h - 0.5], axis=-1)
        # The lens is no part of USD's camera: undistorted pixels, bent by the attribute that says so.
        centre, scale = np.array([known.cx_px, known.cy_px]), known.f_px[i] * np.array([1, 1 / known.aspect])
        r2 = np.sum(((ideal - centre) / scale) ** 2, axis=-1, keepdims=True)
        bent: Array = centre + (ideal - centre) * (1 + bend[i] * r2)
        return bent

    return project


def read_opentrackio(path: Path, known: Truth) -> Project:
    samples = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert len(samples) == N
    w, h = known.size_px

    def project(i: int, rays: Array) -> Array:
        sample = samples[i]
        sensor = sample["static"]["camera"]["activeSensorPhysicalDimensions"]
        turn, lens = sample["transforms"][0]["rotation"], sample["lens"]
        # Z up, Y forward, X right; intrinsic rotations about Z, X, Y turn the camera out of its rest.
        R = about(2, turn["pan"]) @ about(0, turn["tilt"]) @ about(1, turn["roll"])
        local = (np.stack([rays[:, 0], rays[:, 2], -rays[:, 1]], axis=-1)) @ R
        x, y = local[:, 0] / local[:, 1], -local[:, 2] / local[:, 1]
        F = lens["pinholeFocalLength"]
        [model] = lens["distortion"]
        assert model["model"] == "Brown-Conrady U-D"
        g = 1 + model["radial"][0] * ((F * x) ** 2 + (F * y) ** 2)
        mm = np.stack(
            [F * x * g + lens["projectionOffset"]["x"], F * y * g + lens["projectionOffset"]["y"]], -1
        )
        return mm / [sensor["width"], sensor["height"]] * [w, h] + np.array([w, h]) / 2 - 0.5

    return project


def read_opencv(path: Path, known: Truth) -> Project:
    store = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    assert (store.getNode("image_width").real(), store.getNode("image_height").real()) == known.size_px
    assert store.getNode("camera_matrix_of_frame").real() == FIRST + 2
    assert store.getNode("camera_matrix").mat()[0, 0] == known.f_px[2]
    nodes = store.getNode("frames")
    names = ("rvec", "tvec", "camera_matrix", "distortion_coefficients")
    cameras = {
        int(node.getNode("frame").real()): [node.getNode(name).mat() for name in names]
        for node in (nodes.at(j) for j in range(nodes.size()))
    }
    assert sorted(cameras) == [FIRST + i for i in ROWS]

    def project(i: int, rays: Array) -> Array:
        pixels: Array = cv2.projectPoints(rays, *cameras[FIRST + i])[0][:, 0]
        return pixels

    return project


def read_soccernet(path: Path, known: Truth) -> Project:
    assert sorted(p.name for p in path.iterdir()) == [f"camera_{FIRST + i:05d}.json" for i in ROWS]

    def project(i: int, rays: Array) -> Array:
        data = json.loads((path / f"camera_{FIRST + i:05d}.json").read_text())
        # The challenge's definition: orientation = Rz(pan) Rx(tilt) Rz(roll), its transpose maps world to camera.
        turn = about(2, data["pan_degrees"]) @ about(0, data["tilt_degrees"]) @ about(2, data["roll_degrees"])
        world = np.stack([rays[:, 0], -rays[:, 2], rays[:, 1]], axis=-1) - data["position_meters"]
        k1 = data["radial_distortion"][0]
        assert not any([*data["radial_distortion"][1:], *data["tangential_distortion"]])
        c = data["principal_point"]
        return pinhole(world @ turn, data["x_focal_length"], data["y_focal_length"], (c[0], c[1]), k1)

    return project


def read_chan(path: Path, known: Truth) -> Project:
    lines = [line.split("\t") for line in path.read_text().splitlines()]
    cameras = {int(line[0]): [float(v) for v in line[1:]] for line in lines}
    assert sorted(cameras) == [FIRST + i + 1 for i in ROWS]
    w, h = known.size_px

    def project(i: int, rays: Array) -> Array:
        *position, rx, ry, rz, vfov = cameras[FIRST + i + 1]
        assert position == [0, 0, 0]
        # Nuke's order ZXY applied to points: first Z, then X, then Y.
        turn = about(1, ry) @ about(0, rx) @ about(2, rz)
        local = (rays * [1, -1, -1]) @ turn
        fy = h / 2 / np.tan(np.radians(vfov) / 2)
        centre = ((w - 1) / 2, (h - 1) / 2)
        return pinhole(local * [1, -1, -1], fy * known.aspect, fy, centre, 0.0)

    return project


def decode_freed(data: bytes) -> dict[str, float]:
    """A D1 packet by the standard's table of bytes."""
    assert len(data) == 29 and data[0] == 0xD1 and sum(data) % 256 == 0x40

    def signed(at: int) -> int:
        value = (data[at] << 16) | (data[at + 1] << 8) | data[at + 2]
        return value - (1 << 24) if value & 0x800000 else value

    names = ("pan", "tilt", "roll", "x", "y", "z")
    values = {name: signed(2 + 3 * k) / (32768 if k < 3 else 64) for k, name in enumerate(names)}
    whole = {"id": data[1], "zoom": signed(20) & 0xFFFFFF, "focus": signed(23) & 0xFFFFFF}
    return {**values, **whole, "user": data[26] << 8 | data[27]}


def read_freed(path: Path, known: Truth) -> Project:
    data = path.read_bytes()
    packets = [decode_freed(data[k : k + 29]) for k in range(0, len(data), 29)]
    cameras = {int(p["user"]): p for p in packets}
    assert sorted(cameras) == [FIRST + i for i in ROWS]
    w, h = known.size_px

    def project(i: int, rays: Array) -> Array:
        p = cameras[FIRST + i]
        assert -180 <= p["pan"] <= 180 and (p["x"], p["y"], p["z"]) == (0, 0, 0)
        R = rotation_cam_world(*np.radians([p["pan"], p["tilt"], p["roll"]]))
        return pinhole(rays @ R.T, p["zoom"] / 16, p["zoom"] / 16, ((w - 1) / 2, (h - 1) / 2), 0.0)

    return project
