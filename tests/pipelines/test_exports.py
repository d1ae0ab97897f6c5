"""Every export written, then read by its own consumer: 100 rays land where the truth says.

The tolerance is 0.01 px, or the format's own quantum where that is coarser; it stands beside each reader.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.archive import cells, read_camera_csv
from pipelines.exports.cameras import NOMINAL_SENSOR_MM
from pipelines.exports.colmap import quaternion
from pipelines.exports.exporter import Exported, export_run
from pipelines.exports.formats import FORMATS, ExportOptions
from tests.pipelines.export_readers import (
    ROWS,
    Project,
    read_chan,
    read_colmap,
    read_freed,
    read_opencv,
    read_opentrackio,
    read_soccernet,
    read_usd,
)
from tests.pipelines.export_truth import FIRST, LOST, N, Truth, truth
from tests.pipelines.opentrackio_schema import OPENTRACKIO_SCHEMA


def write(tmp_path: Path, name: str, known: Truth, **options: Any) -> list[Exported]:
    return export_run(known.run(), known.table(), [name], tmp_path, options=ExportOptions(**options))


def worst_px(known: Truth, project: Project) -> float:
    """Largest difference over 100 rays of every frame with a camera."""
    errors = [
        np.linalg.norm(project(i, known.rays(i)) - known.project(i, known.rays(i)), axis=-1).max()
        for i in ROWS
    ]
    return float(max(errors))


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


# ---- OpenTrackIO


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


@pytest.mark.oracle
@pytest.mark.skipif(
    "OPENTRACKIO_SCHEMA" not in os.environ, reason="no OPENTRACKIO_SCHEMA: the published file"
)
def test_opentrackio_samples_obey_the_published_schema(tmp_path: Path) -> None:
    schema = json.loads(Path(os.environ["OPENTRACKIO_SCHEMA"]).read_text(encoding="utf-8"))
    [shot, *_] = write(tmp_path, "opentrackio", truth(), sensor_width_mm=9.59)
    assert shot.path is not None
    validator = jsonschema.validators.validator_for(schema)(schema)
    for line in shot.path.read_text(encoding="utf-8").splitlines():
        assert [error.message for error in validator.iter_errors(json.loads(line))] == []


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
