"""`export` and `run --export`: where files go, exit codes, one-line errors, sending FreeD at frame rate, Blender."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines import cli
from pipelines.archive import read_camera_csv, read_run
from pipelines.config import Config, load_config
from pipelines.errors import MissingToolError
from pipelines.exports.exporter import export_for_run
from pipelines.exports.formats import FORMATS, NAMES, parse_names
from pipelines.exports.whole_file import whole_folder
from pipelines.output_folder import OutputFolder, run_digest
from pipelines.records import CameraTable
from pipelines.summary import print_summary
from tests.pipelines.end_to_end import digests, one_line, run
from tests.pipelines.export_readers import decode_freed
from tests.pipelines.export_truth import FIRST, LOST, N, Truth, truth


def finished(out: Path, known: Truth | None = None, table: CameraTable | None = None) -> Path:
    """A folder of a finished run with the cameras of export_truth."""
    known = known or truth()
    with OutputFolder(out, "digest") as folder:
        folder.write_camera(table or known.table())
        folder.publish(known.run())
    return out


def no_camera() -> CameraTable:
    """The same rows without any focal length."""
    known = truth().table()
    return dataclasses.replace(known, f_px=np.full(len(known), np.nan))


def test_exports_go_beside_the_panorama_and_into_the_list_of_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = finished(tmp_path / "out")
    assert cli.main(["export", str(out), "--to", "chan,colmap,json", "--shot", "0"]) == 0
    shown = capsys.readouterr().out
    assert "camera.chan: 7 frames, 1 left out" in shown
    made = {
        "camera.json",
        "shot-000/camera.chan",
        "shot-000/camera.chan.notes.json",
        "shot-000/colmap/images.txt",
    }
    files = set(json.loads((out / "run.json").read_text())["files"])
    assert made <= files and all((out / name).is_file() for name in files)
    # The next run into the folder clears them away: they would belong to cameras that are gone.
    finished(out)
    assert not any((out / name).exists() for name in made) and not (out / "shot-000").exists()


def test_one_export_of_one_shot_takes_the_path_as_its_name(tmp_path: Path) -> None:
    out = finished(tmp_path / "out")
    before = (out / "run.json").read_bytes()
    target = tmp_path / "for nuke.chan"
    assert cli.main(["export", str(out), "--to", "chan", "--shot", "0", "-o", str(target)]) == 0
    assert target.is_file() and (tmp_path / "for nuke.chan.notes.json").is_file()
    assert cli.main(["export", str(out), "--to", "csv", "-o", str(tmp_path / "a.csv")]) == 0
    assert (tmp_path / "a.csv").read_bytes() == (out / "camera.csv").read_bytes()
    assert cli.main(["export", str(out), "--to", "chan,usd", "--shot", "0", "-o", str(tmp_path / "all")]) == 0
    assert (tmp_path / "all" / "shot-000" / "camera.usda").is_file()
    assert (out / "run.json").read_bytes() == before, "what lies elsewhere is not the run's"


def test_a_hugin_project_elsewhere_keeps_the_runs_canvas(tmp_path: Path) -> None:
    out = finished(tmp_path / "out")
    (out / "shot-000").mkdir()
    facts = {
        "format": "broadcast-mosaic panorama 1", "projection": "cylindrical", "size_px": [900, 400],
        "centre_px": [449.5, 199.5], "scale_px_per_rad": 800.0,
    }  # fmt: skip
    (out / "shot-000" / "panorama.json").write_text(json.dumps(facts))
    for path in (tmp_path / "a.pto", tmp_path / "folder" / "b.pto", None):
        place = [] if path is None else ["-o", str(path)]
        assert cli.main(["export", str(out), "--to", "pto", "--shot", "0", *place]) == 0
        text = (path or out / "shot-000" / "cameras.pto").read_text()
        assert "\np f1 w900 h400 " in text
    several = ["-o", str(tmp_path / "several")]
    assert cli.main(["export", str(out), "--to", "pto,usd", "--shot", "0", *several]) == 0
    assert "\np f1 w900 h400 " in (tmp_path / "several" / "shot-000" / "cameras.pto").read_text()
    (out / "shot-000" / "panorama.json").unlink()
    assert cli.main(["export", str(out), "--to", "pto", "--shot", "0"]) == 0
    turn = (out / "shot-000" / "cameras.pto").read_text().split("\np ")[1].split()
    assert turn[0] == "f2" and int(turn[1][1:]) == 2 * int(turn[2][1:]) and turn[3] == "v360.0"


def test_a_shot_without_a_focal_length_exits_1_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = finished(tmp_path / "out")
    assert cli.main(["export", str(out), "--to", "usd", "--json"]) == 1
    shown = capsys.readouterr()
    assert "no frame of shot 1 has a calibrated camera: the camera zooms" in one_line(shown.err)
    first, second = json.loads(shown.out)["exports"]
    assert (first["n_frames"], first["n_left_out"]) == (N - 1, 1) and first["path"].endswith("camera.usda")
    assert second["path"] is None and Path(second["notes"]).is_file()


def test_mistakes_are_one_line_and_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(finished(tmp_path / "out"))
    mistakes = {
        "did you mean colmap": ["export", out, "--to", "colmpa"],
        "finished run": ["export", str(tmp_path / "nowhere"), "--to", "usd"],
        "its shots: 0, 1": ["export", out, "--to", "usd", "--shot", "7"],
        "goes with --to freed": ["export", out, "--to", "usd", "--udp", "127.0.0.1:6301"],
        "is HOST:PORT": ["export", out, "--to", "freed", "--udp", "6301x"],
        "has no settings": ["export", out, "--to", "usd", "--shots.min_frames", "3"],
        "another place": ["export", out, "--to", "usd", "--shot", "0", "-o", "/dev/null/usd"],
        "--sensor-width-mm": ["export", out, "--to", "freed", "--shot", "0", "--sensor-width-mm", "-3"],
    }
    for said, args in mistakes.items():
        assert cli.main(args) == 2, said
        shown = capsys.readouterr()
        assert said in one_line(shown.err) and shown.out == ""


def test_a_record_without_a_picture_size_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = truth()
    with OutputFolder(tmp_path / "out", "digest") as folder:
        folder.write_camera(known.table())
        folder.publish(dataclasses.replace(known.run(), clip={"path": "a.mp4"}))
    assert cli.main(["export", str(tmp_path / "out"), "--to", "usd"]) == 2
    assert "how large the pictures are" in one_line(capsys.readouterr().err)


def test_a_missing_extra_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = finished(tmp_path / "out")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert cli.main(["export", str(out), "--to", "csv,parquet", "-o", str(tmp_path / "to")]) == 2
    assert "broadcast-mosaic[parquet]" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "to").exists()
    # A run says it before its first picture, not after its last.
    args = ["run", str(tmp_path / "no.mp4"), "-o", str(tmp_path / "run"), "--export", "parquet"]
    assert cli.main(args) == 2
    assert "broadcast-mosaic[parquet]" in one_line(capsys.readouterr().err)


def test_sensor_width_comes_from_the_run_unless_it_is_given(tmp_path: Path) -> None:
    known = truth()
    record = dataclasses.replace(known.run(), config={"calibration": {"sensor_width_mm": 8.8}})
    with OutputFolder(tmp_path / "out", "digest") as folder:
        folder.write_camera(known.table())
        folder.publish(record)
    for options, expected in (([], 8.8), (["--sensor-width-mm", "23.5"], 23.5)):
        assert cli.main(["export", str(tmp_path / "out"), "--to", "usd", "--shot", "0", *options]) == 0
        notes = json.loads((tmp_path / "out/shot-000/camera.usda.notes.json").read_text())
        assert (notes["sensor_width_mm"], notes["sensor_width_is_nominal"]) == (expected, False)


# ---- FreeD over UDP


def test_freed_is_sent_at_frame_rate_in_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = truth()
    out = finished(tmp_path / "out", known)
    received: list[tuple[float, bytes]] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(10)
        port = listener.getsockname()[1]

        def listen() -> None:
            for _ in range(N - 1):
                data = listener.recv(100)
                received.append((time.monotonic(), data))

        thread = threading.Thread(target=listen)
        thread.start()
        args = ["export", str(out), "--to", "freed", "--shot", "0", "--udp", f"127.0.0.1:{port}", "--json"]
        assert cli.main(args) == 0
        thread.join()
    assert json.loads(capsys.readouterr().out)["sent"] == N - 1
    packets = [decode_freed(data) for _, data in received]
    assert [p["user"] for p in packets] == [FIRST + i for i in range(N) if i != LOST]
    np.testing.assert_allclose(
        [p["tilt"] for p in packets], np.delete(known.tilt_deg, LOST), atol=0.5 / 32768
    )
    # 50 pictures a second: none leaves before its time; how late one arrives is up to the machine.
    due = np.delete(np.arange(N), LOST) / 50
    arrived = np.array([when for when, _ in received]) - received[0][0]
    assert (arrived > due - 0.015).all()


def test_a_stream_of_two_worlds_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second shot has a camera too: a jump from one world into another would be a lie."""
    known = truth()
    table = known.table()
    columns = {
        name: np.where(table.shot == 1, getattr(table, name)[0], getattr(table, name))
        for name in ("f_px", "aspect", "cx_px", "cy_px", "k1", "pan_deg", "tilt_deg", "roll_deg")
    }
    out = finished(tmp_path / "both", known, dataclasses.replace(table, **columns))
    assert cli.main(["export", str(out), "--to", "freed", "--udp", "127.0.0.1:6301"]) == 2
    assert "2 shots have a camera; choose one with --shot" in one_line(capsys.readouterr().err)
    none = finished(tmp_path / "none", known, no_camera())
    assert cli.main(["export", str(none), "--to", "freed", "--udp", "127.0.0.1:6301"]) == 2
    assert "no frame has a calibrated camera" in one_line(capsys.readouterr().err)


# ---- run --export


def test_names_of_a_run_are_settings(tmp_path: Path) -> None:
    config = load_config(None, {"output.exports": "usd,chan,usd"})
    assert config.output.exports == ("usd", "chan")
    assert Config.model_validate(config.as_dict()) == config
    (tmp_path / "a.toml").write_text(config.as_toml())
    assert load_config(tmp_path / "a.toml") == config
    assert run_digest(config, "clip") == run_digest(Config(), "clip"), "what is exported changes no result"
    assert parse_names(",".join(NAMES)) == NAMES == tuple(entry.name for entry in FORMATS)


def test_a_run_without_a_camera_keeps_its_results(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    known = truth()
    # A command before this one may have asked for quiet.
    caplog.set_level(logging.WARNING, logger="pipelines")
    export_for_run(known.run(), no_camera(), ("usd", "json", "chan"), tmp_path)
    assert (tmp_path / "camera.json").is_file()
    assert [r.levelname for r in caplog.records] == ["WARNING"] * 2
    assert "not exported to usd, chan: no frame of shot 0 has a calibrated camera" in caplog.text
    narrow = truth(aspect=45 / 64)
    export_for_run(narrow.run(), narrow.table(), ("pto",), tmp_path)
    assert "not square" in caplog.text and "choose colmap" in caplog.text


def test_the_final_table_says_how_many_shots_an_export_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = truth()
    record = dataclasses.replace(known.run(), config={"output": {"exports": ["usd", "json"]}})
    with OutputFolder(tmp_path / "out", "digest") as folder:
        folder.write_camera(known.table())
        export_for_run(record, known.table(), ("usd", "json"), folder.staging)
        folder.publish(record)
    print_summary(tmp_path / "out", record)
    assert "exports: usd (1 of 2 shots, see its notes), json\n" in capsys.readouterr().out


@pytest.mark.slow
def test_run_writes_the_exports_it_is_asked_for(pan_clip: Path, tmp_path: Path) -> None:
    done = run(pan_clip, tmp_path / "out", "--export", "chan,pto,colmap-bin", "--panorama.enabled", "false")
    assert done.code == 0, done.stderr
    table, files = read_camera_csv(done.out / "camera.csv"), done.record["files"]
    assert {f"shot-000/{n}" for n in ("camera.chan", "cameras.pto", "colmap-bin/images.bin")} <= set(files)
    assert read_run(done.out).config["output"]["exports"] == ["chan", "pto", "colmap-bin"]
    lines = (done.out / "shot-000/camera.chan").read_text().splitlines()
    assert len(lines) == np.isfinite(table.f_px).sum() > 40
    # Afterwards, from the folder alone, the same bytes.
    before = digests(done.out / "shot-000")
    assert cli.main(["export", str(done.out), "--to", "chan,pto,colmap-bin"]) == 0
    assert digests(done.out / "shot-000") == before


# ---- folders that are whole


def test_a_folder_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "colmap"
    for name in ("a", "b"):
        with whole_folder(target) as folder:
            (folder / name).write_text(name)
    assert [p.name for p in target.iterdir()] == ["b"]
    with pytest.raises(RuntimeError, match="stop"), whole_folder(target) as folder:
        (folder / "c").write_text("half")
        raise RuntimeError("stop")
    assert [p.name for p in target.iterdir()] == ["b"] and [p.name for p in tmp_path.iterdir()] == ["colmap"]
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError), whole_folder(tmp_path / "file"):
        pass


def test_missing_extra_error_names_the_format() -> None:
    entry = dataclasses.replace(FORMATS[-1], needs="no_such_package")
    with pytest.raises(MissingToolError, match="export parquet: no_such_package is not installed"):
        entry.check()


# ---- Blender reads the .chan

BLENDER = """
import sys, json
sys.path[:0] = {paths!r}
import bpy, mathutils
from bpy_extras.object_utils import world_to_camera_view
import addon_utils
addon_utils.enable("io_anim_nuke_chan")
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y = {size!r}
scene.frame_start, scene.frame_end = {first}, {last}
camera = bpy.data.objects.new("C", bpy.data.cameras.new("C"))
scene.collection.objects.link(camera)
bpy.context.view_layer.objects.active = camera
camera.select_set(True)
scene.camera = camera
bpy.ops.import_scene.import_chan(filepath={chan!r}, z_up=True, rotation_order="ZXY", sensor_width={sensor[0]!r},
                                 sensor_height={sensor[1]!r})
found = []
for frame, points in json.load(open({rays!r})):
    scene.frame_set(frame)
    # z_up turns the file's y-up world: (x, y, z) of Blender is (x, z, -y) of ours.
    found.append([list(world_to_camera_view(scene, camera, mathutils.Vector((x, z, -y))))[:2] for x, y, z in points])
json.dump(found, open({result!r}, "w"))
"""


@pytest.mark.oracle
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("blender") is None, reason="blender is not installed")
def test_blender_sees_the_rays_where_we_do(tmp_path: Path) -> None:
    """Blender works in float32 and 1 px of a picture is 5e-4 of it: 0.01 px is above its rounding."""
    known = truth(distortion=False, centred=True)
    out = finished(tmp_path / "out", known)
    chan = tmp_path / "camera.chan"
    assert cli.main(["export", str(out), "--to", "chan", "--shot", "0", "-o", str(chan)]) == 0
    rows = [i for i in range(N) if i != LOST]
    frames = [(FIRST + i + 1, (10 * known.rays(i)).tolist()) for i in rows]
    (tmp_path / "rays.json").write_text(json.dumps(frames))
    w, h = known.size_px
    values: dict[str, Any] = {
        "paths": [str(Path(np.__file__).parent.parent)], "size": known.size_px, "first": frames[0][0],
        "last": frames[-1][0], "chan": str(chan), "sensor": (9.6, 9.6 * h / w), "rays": str(tmp_path / "rays.json"),
        "result": str(tmp_path / "found.json"),
    }  # fmt: skip
    (tmp_path / "t.py").write_text(BLENDER.format(**values))
    command = [
        "blender",
        "-b",
        "--factory-startup",
        "--python-exit-code",
        "3",
        "--python",
        str(tmp_path / "t.py"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    found = np.array(json.loads((tmp_path / "found.json").read_text()))
    pixels = np.stack([found[..., 0] * w - 0.5, (1 - found[..., 1]) * h - 0.5], axis=-1)
    errors = [np.abs(pixels[k] - known.project(i, known.rays(i))).max() for k, i in enumerate(rows)]
    assert max(errors) < 0.01
