"""Every export written, then read by its own consumer: 100 rays land where the truth says.

The tolerance is 0.01 px, or the format's own quantum where that is coarser; it stands beside each reader.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.archive import cells, read_camera_csv
from pipelines.exports.cameras import NOMINAL_SENSOR_MM
from pipelines.exports.colmap import quaternion
from pipelines.exports.exporter import Exported, export_run
from pipelines.exports.formats import FORMATS, ExportOptions
from pipelines.exports.freed import packet, wrapped
from tests.pipelines.export_truth import FIRST, LOST, Array, N, Truth, truth
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


def write(tmp_path: Path, name: str, known: Truth, **options: Any) -> list[Exported]:
    return export_run(known.run(), known.table(), [name], tmp_path, options=ExportOptions(**options))


def worst_px(known: Truth, project: Project) -> float:
    """Largest difference over 100 rays of every frame with a camera."""
    errors = [
        np.linalg.norm(project(i, known.rays(i)) - known.project(i, known.rays(i)), axis=-1).max()
        for i in ROWS
    ]
    return float(max(errors))


# ---- readers: the format's own consumer, or the format's text applied by hand where there is no package


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


# ---- the contract: 0.01 px, or the quantum of the format

PLAIN = {"distortion": False, "centred": True}  # what .chan and FreeD can say at all
# FreeD: 1/32768 degree is half of 5.3e-7 rad, at f = 3689 px 1e-3 px per angle; zoom in 1/16 px moves the corner by
# 1/32 px * (1101 px / 1500 px) = 0.023 px.
CASES: dict[str, tuple[Callable[[Path, Truth], Project], dict[str, Any], float]] = {
    "colmap": (read_colmap, {}, 0.01),
    "colmap-bin": (read_colmap, {}, 0.01),
    "opentrackio": (read_opentrackio, {}, 0.01),
    "freed": (read_freed, PLAIN, 0.03),
    "chan": (read_chan, PLAIN, 0.01),
    "usd": (read_usd, {}, 0.01),
    "soccernet": (read_soccernet, {}, 0.01),
    "opencv": (read_opencv, {}, 0.01),
}
NARROW = 45 / 64  # fx / fy of anamorphic SD


@pytest.mark.parametrize("aspect", [1.0, NARROW])
@pytest.mark.parametrize("name", CASES)
def test_rays_land_where_the_truth_says(tmp_path: Path, name: str, aspect: float) -> None:
    reader, made, tolerance_px = CASES[name]
    if name == "freed" and aspect != 1:
        pytest.skip("FreeD says nothing of the pixels' shape")
    known = truth(aspect=aspect, **made)
    shot, without = write(tmp_path, name, known)
    assert shot.path is not None and shot.n_frames == N - 1 and shot.n_left_out == 1
    error = worst_px(known, reader(shot.path, known))
    assert error < tolerance_px
    notes = json.loads(shot.notes.read_text())
    assert notes["n_left_out"] == 1 and notes["frames_in_no_shot"] == [[FIRST + N, FIRST + N + 1]]
    [left] = notes["left_out"]
    assert (left["first_frame"], left["last_frame"], left["status"]) == (FIRST + LOST, FIRST + LOST, "lost")
    assert left["reason"] == "low_overlap" and "too little of the picture" in left["why"]
    # A shot without a focal length is nobody's camera: no file, and the notes say so.
    assert without.path is None and "zooms" in without.why
    empty = json.loads(without.notes.read_text())
    assert empty["file"] is None and empty["n_frames"] == 0 and empty["left_out"][0]["reason"] == "zoom_only"


def test_every_format_is_in_the_contract() -> None:
    tables = {"json", "csv", "parquet"}
    assert {entry.name for entry in FORMATS} == {*CASES, *tables, "pto"}


# ---- OpenTrackIO's schema

RATE = {
    "type": "object", "additionalProperties": False, "required": ["num", "denom"],
    "properties": {"num": {"type": "integer", "minimum": 1, "maximum": 2147483647},
                   "denom": {"type": "integer", "minimum": 1, "maximum": 4294967295}},
}  # fmt: skip
URN = {
    "type": "string",
    "pattern": "^urn:uuid:[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$",
}
TEXT = {"type": "string", "minLength": 1, "maxLength": 1023}
NUMBER = {"type": "number"}


def block(required: list[str], **properties: Any) -> dict[str, Any]:
    return {
        "type": "object", "additionalProperties": False, "required": required, "properties": properties,
    }  # fmt: skip


# The parts of the OpenTrackIO 1.0.1 schema that our samples use, restated: the same keys, types, ranges, required
# members and the same refusal of unknown keys.
OPENTRACKIO_SCHEMA = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "type": "object",
    "properties": {
        "protocol": block(
            ["name", "version"],
            name=TEXT,
            version={
                "type": "array", "minItems": 3, "maxItems": 3,
                "items": {"type": "integer", "minimum": 0, "maximum": 9},
            },
        ),
        "sampleId": URN,
        "sourceId": URN,
        "sourceNumber": {"type": "integer", "minimum": 0, "maximum": 4294967295},
        "static": block(
            [],
            camera=block(
                [],
                captureFrameRate=RATE,
                activeSensorPhysicalDimensions=block(
                    ["height", "width"],
                    height={"type": "number", "minimum": 0},
                    width={"type": "number", "minimum": 0},
                ),
                activeSensorResolution=block(
                    ["height", "width"],
                    height={"type": "integer", "minimum": 0, "maximum": 2147483647},
                    width={"type": "integer", "minimum": 0, "maximum": 2147483647},
                ),
            ),
        ),
        "timing": block(
            [],
            mode={"type": "string", "enum": ["internal", "external"]},
            sampleRate=RATE,
            sequenceNumber={"type": "integer", "minimum": 0, "maximum": 4294967295},
            sampleTimestamp=block(
                ["seconds", "nanoseconds"],
                seconds={"type": "integer", "minimum": 0, "maximum": 281474976710655},
                nanoseconds={"type": "integer", "minimum": 0, "maximum": 4294967295},
            ),
            timecode=block(
                ["hours", "minutes", "seconds", "frames", "frameRate"],
                hours={"type": "integer", "minimum": 0, "maximum": 23},
                minutes={"type": "integer", "minimum": 0, "maximum": 59},
                seconds={"type": "integer", "minimum": 0, "maximum": 59},
                frames={"type": "integer", "minimum": 0, "maximum": 119},
                frameRate=RATE,
            ),
        ),
        "tracker": block([], notes=TEXT, recording={"type": "boolean"}, slate=TEXT, status=TEXT),
        "lens": block(
            [],
            pinholeFocalLength={"type": "number", "minimum": 0},
            projectionOffset=block(["x", "y"], x=NUMBER, y=NUMBER),
            distortion={
                "type": "array", "minItems": 1,
                "items": block(
                    ["radial"],
                    model=TEXT,
                    radial={"type": "array", "minItems": 1, "items": NUMBER},
                    tangential={"type": "array", "minItems": 1, "items": NUMBER},
                ),
            },
        ),
        "transforms": {
            "type": "array", "minItems": 1,
            "items": block(
                ["translation", "rotation"],
                translation=block([], x=NUMBER, y=NUMBER, z=NUMBER),
                rotation=block([], pan=NUMBER, tilt=NUMBER, roll=NUMBER),
                id=TEXT,
            ),
        },
    },
    "additionalProperties": False,
}  # fmt: skip


def test_opentrackio_samples_obey_the_schema(tmp_path: Path) -> None:
    known = truth()
    results = write(tmp_path, "opentrackio", known, sensor_width_mm=9.59)
    assert results[0].path is not None
    samples = [json.loads(line) for line in results[0].path.read_text(encoding="utf-8").splitlines()]
    validator = jsonschema.validators.validator_for(OPENTRACKIO_SCHEMA)(OPENTRACKIO_SCHEMA)
    assert [error.message for sample in samples for error in validator.iter_errors(sample)] == []
    lost = samples[LOST]
    assert "lens" not in lost and "transforms" not in lost and lost["tracker"]["status"] == "lost"
    assert "too little of the picture" in lost["tracker"]["notes"]
    assert samples[0]["timing"]["timecode"]["frameRate"] == {"num": 25, "denom": 1}
    assert samples[0]["timing"]["sampleRate"] == {"num": 50, "denom": 1}
    assert samples[1]["timing"]["sampleTimestamp"] == {"seconds": 0, "nanoseconds": (FIRST + 1) * 20_000_000}
    assert len({sample["sampleId"] for sample in samples}) == N
    # The check itself can fail: a wrong id, an unknown key.
    for spoiled in ({"sampleId": str(uuid.uuid4())}, {"lens": {"focal": 3}}):
        assert list(validator.iter_errors({**samples[0], **spoiled}))


# ---- FreeD's golden packets: from an independent decoder (formats.md A1)


@pytest.mark.parametrize(
    ("values", "golden"),
    [
        (
            {"camera_id": 1, "pan_deg": 0, "tilt_deg": 0, "roll_deg": 0},
            "d10100000000000000000000000000000000000000000000000000006e",
        ),
        (
            {
                "camera_id": 1, "pan_deg": 12.5, "tilt_deg": -3.25, "roll_deg": 0.5,
                "position_mm": (1000, -2000, 1500.5), "zoom": 4660, "focus": 2748, "user": 7,
            },
            "d101064000fe600000400000fa00fe0c00017720001234000abc0007db",
        ),
        (
            {
                "camera_id": 255, "pan_deg": -180, "tilt_deg": 90, "roll_deg": -1 / 32768,
                "position_mm": (-131071.984375, 131071.984375, 0), "zoom": 65535, "focus": 1, "user": 65535,
            },
            "d1ffa600002d0000ffffff8000017fffff00000000ffff000001ffffa5",
        ),
    ],
)  # fmt: skip
def test_freed_packets_are_the_golden_ones(values: dict[str, Any], golden: str) -> None:
    assert packet(**values).hex() == golden


def test_freed_refuses_what_its_fields_cannot_hold() -> None:
    good = {"pan_deg": 0.0, "tilt_deg": 0.0, "roll_deg": 0.0}
    for spoiled in (
        {"tilt_deg": 91.0},
        {"zoom": 1 << 24},
        {"user": 65536},
        {"position_mm": (0, 0, 200_000.0)},
    ):
        with pytest.raises(ValueError, match=r"tilt|field"):
            packet(1, **{**good, **spoiled})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("angle", "expected"), [(180, 180), (-180, -180), (190, -170), (-190, 170), (540, -180)]
)
def test_angles_are_wrapped(angle: float, expected: float) -> None:
    assert wrapped(angle) == expected


def test_freed_zoom_is_millimetres_only_with_a_sensor(tmp_path: Path) -> None:
    known = truth(**PLAIN)
    for width_mm, law in ((None, "f_px * 16"), (9.6, "9.6 mm wide")):
        [shot, _] = write(tmp_path, "freed", known, sensor_width_mm=width_mm)
        assert shot.path is not None and law in json.loads(shot.notes.read_text())["zoom_law"]
        zoom = decode_freed(shot.path.read_bytes()[:29])["zoom"]
        assert zoom == round(known.f_px[0] * (16 if width_mm is None else 9.6 / 1920 * 1000))


def test_nominal_millimetres_are_said_to_be(tmp_path: Path) -> None:
    known = truth()
    for name in ("usd", "opentrackio"):
        for width_mm, nominal in ((None, True), (12.0, False)):
            [shot, _] = write(tmp_path, name, known, sensor_width_mm=width_mm)
            notes = json.loads(shot.notes.read_text())
            assert notes["sensor_width_is_nominal"] is nominal
            assert notes["sensor_width_mm"] == (NOMINAL_SENSOR_MM if nominal else width_mm)
            assert shot.path is not None
            said = "nominal" in shot.path.read_text().replace("sensorWidthIsNominal = false", "").lower()
            assert said is nominal


def test_what_a_format_cannot_say_is_stated_in_px(tmp_path: Path) -> None:
    known = truth()
    [shot, _] = write(tmp_path, "chan", known)
    stated = json.loads(shot.notes.read_text())["not_in_this_format"]
    w, h = known.size_px
    corner = max(
        abs(known.k1[i]) * np.hypot(x, y) ** 3 / known.f_px[i] ** 2
        for i in ROWS
        for x in (-0.5 - known.cx_px, w - 0.5 - known.cx_px)
        for y in (-0.5 - known.cy_px, h - 0.5 - known.cy_px)
    )
    assert stated["distortion_px"] == pytest.approx(corner, abs=1e-3) and corner > 5
    assert stated["principal_point_offset_px"] == pytest.approx(np.hypot(6.75, -9.0), abs=1e-3)


def test_timelines_start_where_the_user_says(tmp_path: Path) -> None:
    known = truth()
    [chan, _] = write(tmp_path, "chan", known, first_frame=1001)
    [usd, _] = write(tmp_path, "usd", known, first_frame=1001)
    assert chan.path is not None and chan.path.read_text().split("\t")[0] == str(1001 + FIRST)
    assert usd.path is not None and f"startTimeCode = {1001 + FIRST}\n" in usd.path.read_text()


# ---- SoccerNet


def test_soccernet_keeps_its_readers_picture_size(tmp_path: Path) -> None:
    """The reader takes twice the principal point for the picture's size: the middle is (W/2, H/2) for it."""
    for centred, expected in ((True, [960.0, 540.0]), (False, [966.25, 530.5])):
        [shot, _] = write(tmp_path, "soccernet", truth(centred=centred))
        assert shot.path is not None
        data = json.loads((shot.path / f"camera_{FIRST:05d}.json").read_text())
        assert data["principal_point"] == expected


def test_soccernet_camera_looks_across_the_pitch(tmp_path: Path) -> None:
    """Golden by hand: at pan 0, tilt -10 the camera looks along -y and 10 degrees down, which is +z there."""
    known = truth()
    level = Truth(
        f_px=known.f_px, k1=np.zeros(N), pan_deg=np.zeros(N), tilt_deg=np.full(N, -10.0), roll_deg=np.zeros(N)
    )
    [shot, _] = write(tmp_path, "soccernet", level)
    assert shot.path is not None
    data = json.loads((shot.path / f"camera_{FIRST:05d}.json").read_text())
    assert (data["pan_degrees"], data["tilt_degrees"], data["roll_degrees"]) == (0.0, 80.0, 0.0)
    forward = (about(2, 0) @ about(0, 80) @ about(2, 0))[:, 2]
    np.testing.assert_allclose(forward, [0, -np.cos(np.radians(10)), np.sin(np.radians(10))], atol=1e-12)


# ---- Hugin


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("pano_trafo") is None, reason="hugin-tools is not installed")
def test_hugin_sends_panorama_points_to_our_pixels(tmp_path: Path) -> None:
    """pano_trafo is Hugin's own point transform; it prints 6 decimals, so the tolerance stays at 0.01 px."""
    known = truth()
    [shot, _] = write(tmp_path, "pto", known)
    assert shot.path is not None
    words = next(line for line in shot.path.read_text().splitlines() if line.startswith("p ")).split()
    width, height = (int(words[k][1:]) for k in (2, 3))
    errors = []
    for place, i in enumerate(ROWS):
        rays = known.rays(i)
        lon, lat = np.arctan2(rays[:, 0], rays[:, 2]), -np.arcsin(rays[:, 1])
        # Hugin counts a pixel's middle as .5 from the canvas's edge in pano_trafo's input.
        at = (
            np.stack([lon / (2 * np.pi) * width + width / 2, height / 2 - lat / np.pi * height], axis=-1)
            - 0.5
        )
        done = subprocess.run(
            ["pano_trafo", "-r", str(shot.path), str(place)],
            input="\n".join(f"{x!r} {y!r}" for x, y in at.tolist()),
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        got = np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])
        errors.append(np.linalg.norm(got - known.project(i, rays), axis=-1).max())
    assert max(errors) < 0.01


# ---- tables


def test_tables_hold_every_row_with_its_empty_cells(tmp_path: Path) -> None:
    import pandas
    import polars
    from pyarrow import parquet

    known = truth()
    table = known.table()
    results = export_run(known.run(), table, ["json", "csv", "parquet"], tmp_path)
    paths = {result.name: result.path for result in results}
    assert [result.n_frames for result in results] == [len(table)] * 3
    rows = [tuple(row) for row in cells(table)]
    document = json.loads(paths["json"].read_text(encoding="utf-8"))  # type: ignore[union-attr]
    assert [tuple(row.values()) for row in document["rows"]] == rows
    assert {c["name"]: c["unit"] for c in document["columns"]}["pan_deg"] == "deg"
    assert read_camera_csv(paths["csv"]).f_px.tobytes() == table.f_px.tobytes()  # type: ignore[arg-type]
    stored = parquet.read_table(paths["parquet"])
    assert [tuple(row.values()) for row in stored.to_pylist()] == rows
    assert stored.schema.field("f_px").metadata == {b"unit": b"px"}
    by_polars = polars.read_parquet(paths["parquet"])
    assert by_polars["f_px"].null_count() == int(np.isnan(table.f_px).sum()) > 0
    by_pandas = pandas.read_csv(paths["csv"])
    np.testing.assert_array_equal(by_pandas["f_px"].to_numpy(), table.f_px)


# ---- quaternions


def test_quaternions_are_exact_at_every_angle() -> None:
    rng = np.random.default_rng(5)
    axes = rng.standard_normal((200, 3))
    for axis, angle in zip(axes, np.linspace(0, np.pi, 200), strict=True):
        n = axis / np.linalg.norm(axis)
        cross: NDArray[np.float64] = np.cross(np.eye(3), n)
        R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        q = quaternion(R)
        expected = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * n)])
        assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 1e-12 and q[0] >= 0


def test_the_guide_speaks_of_every_format() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    for entry in FORMATS:
        assert f"`{entry.name}`" in guide and entry.file.removeprefix("camera") in guide, entry.name
