"""A small clip through `run` from end to end: files, columns, statuses, truth, consistency, the same bytes again."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from pipelines import cli
from pipelines.archive import COLUMNS, read_run
from pipelines.config import Config, load_config
from pipelines.exports.panorama_json import read_surface
from pipelines.records import FRAME_STATUSES
from tests.pipelines.conftest import CUT
from tests.pipelines.end_to_end import SIZE, Finished, corner_errors_px, run, true_homographies
from tests.synth.camera import rotation_cam_world

pytestmark = pytest.mark.slow  # whole runs

# "What a run writes", product contract.
OUTPUTS = {
    "run.json",
    "camera.csv",
    "camera.jsonl",
    "report.html",
    *(f"shot-000/panorama.{kind}" for kind in ("tif", "jpg", "json", "pto")),
    "shot-000/pairs.npz",
}
NOT_KNOWN_WHEN_LOST = [n for n, kind, _ in COLUMNS if kind == "float" and n != "pts_s"]


def csv_rows(out: Path) -> list[dict[str, str]]:
    with (out / "camera.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def rotations(rows: list[dict[str, str]]) -> NDArray[np.float64]:
    """(n, 3, 3) of the angles in the rows, by the generator's own code, which knows nothing of calib."""
    angles = np.radians([[float(r[n]) for n in ("pan_deg", "tilt_deg", "roll_deg")] for r in rows])
    return np.array([rotation_cam_world(*row) for row in angles])


def test_it_ends_well_with_one_document_on_stdout(pan_run: Finished) -> None:
    assert pan_run.code == 0
    assert pan_run.stderr == ""
    document = json.loads(pan_run.stdout)  # fails on a second one, or on any other word
    [clip] = document["clips"]
    assert document["exit_code"] == 0 and clip["error"] is None
    assert clip["run"]["shots"][0]["status"] == "ok"


def test_every_file_of_the_contract_and_no_other(pan_run: Finished) -> None:
    there = {p.relative_to(pan_run.out).as_posix() for p in pan_run.out.rglob("*") if p.is_file()}
    assert there == OUTPUTS
    assert set(pan_run.record["files"]) == OUTPUTS
    assert not [p for p in pan_run.out.iterdir() if p.name.startswith(".")]


def test_camera_csv_and_jsonl_say_the_same(pan_run: Finished) -> None:
    rows = csv_rows(pan_run.out)
    assert list(rows[0]) == [name for name, _, _ in COLUMNS]
    assert [int(r["frame"]) for r in rows] == list(range(50))
    np.testing.assert_allclose([float(r["pts_s"]) for r in rows], np.arange(50) / 25, atol=1e-6)
    lines = (pan_run.out / "camera.jsonl").read_text(encoding="utf-8").splitlines()
    for row, line in zip(rows, lines, strict=True):
        values = json.loads(line)
        assert list(values) == list(row)
        assert {k: "" if v is None else str(v) for k, v in values.items()} == row


def test_statuses_are_those_of_the_contract_and_reasons_are_given(pan_run: Finished) -> None:
    rows = csv_rows(pan_run.out)
    assert {r["status"] for r in rows} <= set(FRAME_STATUSES)
    assert all((r["reason"] == "") == (r["status"] == "ok") for r in rows)
    assert sum(r["status"] == "ok" for r in rows) >= 45
    [shot] = pan_run.record["shots"]
    assert shot["status_counts"] == {s: sum(r["status"] == s for r in rows) for s in shot["status_counts"]}


def test_run_json_is_whole(pan_run: Finished) -> None:
    record = pan_run.record
    for name in ("broadcast-mosaic", "python", "numpy", "torch", "av"):
        assert record["versions"][name]
    assert record["clip"]["size_px"] == list(SIZE) and record["clip"]["identity"]
    assert Config.model_validate(record["config"]).registration.n_fine == 3000
    for stage in ("decode", "register", "keyframes", "second pass", "composite", "write", "total"):
        assert record["timings_s"][stage] > 0
    stages = sum(v for k, v in record["timings_s"].items() if k not in ("total", "report"))
    assert stages <= record["timings_s"]["total"]
    [shot] = record["shots"]
    assert (shot["first_frame"], shot["last_frame"]) == (0, 49)
    assert set(shot["files"]) <= OUTPUTS
    assert shot["focal"]["min_px"] < shot["focal"]["max_px"]
    assert shot["calibration"]["sigma_relative"] <= 0.1
    pupil = shot["calibration"]["pupil"]  # this camera turns about its pupil
    assert not pupil["accepted"] and pupil["reason"] == "not_significant" and pupil["R_head_world"] is None
    assert record["complete"] is True
    assert read_run(pan_run.out).shots[0].reference_frame == shot["reference_frame"]


def test_report_is_one_file_that_needs_no_network(pan_run: Finished) -> None:
    html = (pan_run.out / "report.html").read_text(encoding="utf-8")
    assert html.lower().startswith("<!doctype html>") and html.rstrip().endswith("</html>")
    assert "pan.mp4" in html
    assert 'src="http' not in html and "@import" not in html


def test_panorama_files_agree(pan_run: Finished) -> None:
    folder = pan_run.out / "shot-000"
    surface = read_surface(folder / "panorama.json")
    with tifffile.TiffFile(folder / "panorama.tif") as tif:
        page = tif.pages[0]
        image = page.asarray()
        assert page.is_tiled and len(tif.series[0].levels) >= 2
    assert image.shape == (surface.height, surface.width, 4)
    seen = image[..., 3] > 0
    assert 0.3 < seen.mean() < 1
    assert image[seen][:, :3].std() > 10  # a picture, not a plain colour
    with Image.open(folder / "panorama.jpg") as jpeg:
        assert jpeg.size == (surface.width, surface.height)
        jpeg.load()
    cameras = [x for x in (folder / "panorama.pto").read_text().splitlines() if x.startswith("i ")]
    facts = json.loads((folder / "panorama.json").read_text())
    assert len(cameras) == len(facts["frames"]) >= 3
    # The pan of eighteen degrees is in it: half a picture and more.
    assert surface.width > 1.4 * SIZE[0]


def test_pairs_hold_every_pair_with_its_evidence(pan_run: Finished) -> None:
    with np.load(pan_run.out / "shot-000" / "pairs.npz", allow_pickle=False) as stored:
        pairs = {name: stored[name] for name in stored.files}
    n = len(pairs["src"])
    assert n >= 49
    evidence = "dst H_dst_src status reason route overlap rms_grey score gain offset anchors_px info"
    for name in evidence.split():
        assert len(pairs[name]) == n, name
    assert set(pairs["status"]) <= {"ok", "weak", "failed", "skipped"}
    assert set(pairs["src"]) | set(pairs["dst"]) == set(range(50))
    usable = np.isin(pairs["status"], ["ok", "weak"])
    np.testing.assert_allclose(np.linalg.det(pairs["H_dst_src"][usable]), 1, atol=1e-9)
    assert ((pairs["overlap"][usable] > 0) & (pairs["overlap"][usable] <= 1)).all()
    start, cells = pairs["flow_start"], len(pairs["flow_cell"])
    assert start[0] == 0 and start[-1] == cells and (np.diff(start) >= 0).all()
    assert len(pairs["flow_src_px"]) == len(pairs["flow_dst_px"]) == len(pairs["flow_info"]) == cells


def test_focal_is_right_within_its_error_bar(pan_run: Finished) -> None:
    table, truth = pan_run.table, pan_run.truth
    known = np.isfinite(table.f_px)
    assert known.sum() >= 45
    error = np.abs(table.f_px - truth["f_px"])[known]
    assert (error <= 3 * table.f_std_px[known]).all()
    assert (error <= 0.03 * truth["f_px"][known]).all()
    assert (table.f_std_px[known] <= 0.05 * table.f_px[known]).all()
    assert (table.f_stat_px[known] <= table.f_std_px[known]).all()
    np.testing.assert_allclose(
        table.hfov_deg[known], np.degrees(2 * np.arctan(SIZE[0] / 2 / table.f_px[known])), rtol=1e-12
    )


def test_zoom_and_homographies_match_the_truth(pan_run: Finished) -> None:
    table, truth = pan_run.table, pan_run.truth
    reference = pan_run.record["shots"][0]["reference_frame"]
    known = np.isfinite(table.zoom_ratio)
    zoom = truth["f_px"] / truth["f_px"][reference]
    np.testing.assert_allclose(table.zoom_ratio[known], zoom[known], rtol=0.002)
    # Corners that the reference frame never saw hang on the lens, which is known to a few parts in a thousand.
    errors = corner_errors_px(table.homography, true_homographies(truth, reference))[known]
    assert np.median(errors) < 0.5 and errors.max() < 1.0


def test_homographies_are_those_of_the_cameras_in_the_rows(pan_run: Finished) -> None:
    rows = csv_rows(pan_run.out)
    reference = pan_run.record["shots"][0]["reference_frame"]
    assert all(r["f_px"] for r in rows)
    f, aspect, cx, cy = (np.array([float(r[n]) for r in rows]) for n in ("f_px", "aspect", "cx_px", "cy_px"))
    K = np.tile(np.eye(3), (len(rows), 1, 1))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = f, f / aspect, cx, cy
    R = rotations(rows)
    H = K[reference] @ R[reference] @ np.swapaxes(R, 1, 2) @ np.linalg.inv(K)
    H /= np.cbrt(np.linalg.det(H))[:, None, None]
    table = pan_run.table
    np.testing.assert_allclose(np.linalg.det(table.homography), 1, atol=1e-9)
    assert corner_errors_px(table.homography, H).max() < 1e-6
    zoom = np.array([float(r["zoom_ratio"]) for r in rows])
    np.testing.assert_allclose(zoom, f / f[reference], rtol=1e-12)
    np.testing.assert_allclose(table.homography[reference], np.eye(3), atol=1e-12)
    assert zoom[reference] == 1.0


def test_its_own_run_json_gives_the_same_bytes(pan_run: Finished, tmp_path: Path) -> None:
    config = str(pan_run.out / "run.json")
    again = run(pan_run.clip, tmp_path / "out", "--config", config, "--run.threads", "1", "-q")
    assert (again.code, again.stdout, again.stderr) == (0, "", "")
    assert again.camera_bytes == pan_run.camera_bytes
    for name in ("shot-000/pairs.npz", "shot-000/panorama.tif", "shot-000/panorama.pto"):
        assert (again.out / name).read_bytes() == (pan_run.out / name).read_bytes(), name
    settings = load_config(again.out / "run.json")
    assert settings.registration.n_fine == 3000 and settings.run.threads == 1


def test_compare_reads_it(pan_run: Finished, capsys: pytest.CaptureFixture[str]) -> None:
    truth = pan_run.clip.with_name("pan-truth.csv")
    assert cli.main(["compare", str(pan_run.out), str(truth), "--json"]) == 0
    [shot] = json.loads(capsys.readouterr().out)["shots"]
    assert shot["compared"] == 50 and shot["with_focal"] >= 45
    assert shot["focal_median"] <= 0.03
    assert shot["transfer_px"] < 0.15  # of what the reference frame did see, at 640 wide


def _numbers_in(rows: list[dict[str, str]]) -> Iterator[tuple[str, str]]:
    for row in rows:
        yield from ((name, row[name]) for name in NOT_KNOWN_WHEN_LOST if row[name])


def test_frames_of_no_shot_are_lost_and_their_cells_empty(cut_clip: Path, tmp_path: Path) -> None:
    # Fourteen frames before the cut, six behind it: too few to be a shot.
    some = ("--run.start_frame", str(CUT - 14), "--run.max_frames", "20")
    done = run(cut_clip, tmp_path / "out", *some, "--panorama.enabled", "false", "-q")
    assert (done.code, done.stderr) == (0, "")
    rows = csv_rows(done.out)
    assert [int(r["frame"]) for r in rows] == list(range(CUT - 14, CUT + 6))
    tail = rows[14:]
    assert {(r["status"], r["reason"], r["shot"]) for r in tail} == {("lost", "between_shots", "")}
    assert list(_numbers_in(tail)) == []
    assert {r["shot"] for r in rows[:14]} == {"0"}
    assert list(_numbers_in(rows[:1])) != []
    assert not (done.out / "shot-000" / "panorama.tif").exists()
    [shot] = done.record["shots"]
    assert shot["panorama"] is None and "switched off" in shot["warnings"][0]
