"""What cannot be used, through the whole command: exit 2, one line, and earlier outputs as they were."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines import cli
from tests.pipelines.clips import write_audio, write_clip
from tests.pipelines.end_to_end import Finished, digests, one_line
from tests.pipelines.zoo import luma

pytestmark = pytest.mark.slow  # whole runs


def _text(folder: Path, clip: Path) -> Path:
    (folder / "text.mp4").write_text("not a video\n" * 50)
    return folder / "text.mp4"


def _truncated(folder: Path, clip: Path) -> Path:
    data = clip.read_bytes()
    (folder / "truncated.mp4").write_bytes(data[: len(data) * 2 // 3])
    return folder / "truncated.mp4"


def _empty(folder: Path, clip: Path) -> Path:
    (folder / "empty.mp4").touch()
    return folder / "empty.mp4"


BAD: dict[str, tuple[Callable[[Path, Path], Path], str]] = {
    "missing": (lambda folder, clip: folder / "none.mp4", "no such file"),
    "text": (_text, "not a video but text"),
    "empty": (_empty, "empty"),
    "truncated": (_truncated, "truncated"),
    "audio only": (lambda folder, clip: write_audio(folder / "audio.m4a"), "only audio"),
    "one picture": (lambda folder, clip: write_clip(folder / "one.mkv", 1), "only one picture"),
    "a folder without pictures": (lambda folder, clip: folder, ""),
}


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("as_json", [False, True])
def test_unusable_input_is_one_line_and_touches_nothing(
    pan_run: Finished, tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str, as_json: bool
) -> None:
    make, said = BAD[kind]
    (tmp_path / "in").mkdir()
    bad = make(tmp_path / "in", pan_run.clip)
    before = digests(pan_run.out)
    fresh = tmp_path / "fresh" / "out"
    for out in (pan_run.out, fresh):
        assert cli.main(["run", str(bad), "-o", str(out), *(["--json"] if as_json else [])]) == 2
        shown = capfd.readouterr()  # of the file descriptors: FFmpeg's own words would be in it
        line = one_line(shown.err)
        assert bad.name in line and said in line
        assert (shown.out == "") is not as_json
    assert digests(pan_run.out) == before
    assert not fresh.exists()


@pytest.mark.parametrize("size", [(2, 2), (320, 6)])
def test_pictures_too_small_for_any_camera_are_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], size: tuple[int, int]
) -> None:
    clip = write_clip(tmp_path / "tiny.mkv", size=size, pix_fmt="gray")
    for args in (["run", str(clip), "-o", str(tmp_path / "out")], ["probe", str(clip)]):
        assert cli.main(args) == 2
        assert f"{size[0]}x{size[1]} px" in one_line(capfd.readouterr().err)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["camera.csv", "shot-000"])
def test_what_is_in_the_way_of_results_is_named_before_anything_changes(
    pan_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    if name == "camera.csv":
        (out / name).mkdir()  # a folder where a file goes
    else:
        (out / name).write_text("mine")  # a file where a folder goes
    few = ["--run.max_frames", "12", "--panorama.enabled", "false", "-q"]
    assert cli.main(["run", str(pan_clip), "-o", str(out), *few]) == 2
    assert "in the way" in one_line(capfd.readouterr().err)
    assert {path.name for path in out.iterdir() if not path.name.startswith(".partial-")} == {name}


def test_a_name_that_is_no_text_does_not_lose_the_run(pan_clip: Path, tmp_path: Path) -> None:
    clip = tmp_path / os.fsdecode(b"n\xff.mp4")
    try:
        shutil.copy(pan_clip, clip)
    except OSError:
        pytest.skip("this file system takes only text for names")
    few = ["--run.max_frames", "12", "--panorama.enabled", "false", "-q"]
    assert cli.main(["run", str(clip), "-o", str(tmp_path / "out"), *few]) == 0
    assert "n?.mp4" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("deep_first", [False, True])
def test_images_of_unlike_depth_are_one_clip(tmp_path: Path, deep_first: bool) -> None:
    (tmp_path / "in").mkdir()
    for k in range(14):
        grey = luma(k).astype(np.uint8)
        picture = np.dstack([grey] * 3).astype(np.uint16) * 257 if (k % 2 == 0) is deep_first else grey
        cv2.imwrite(str(tmp_path / "in" / f"{k}.png"), picture)
    assert cli.main(["run", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "-q"]) == 0
    assert (tmp_path / "out" / "shot-000" / "panorama.jpg").is_file()


def test_a_mistake_leaves_no_traceback_in_a_real_process(tmp_path: Path, pan_run: Finished) -> None:
    command = [sys.executable, "-m", "pipelines.cli", "run", str(_truncated(tmp_path, pan_run.clip))]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "out")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "truncated" in one_line(done.stderr)


def test_a_range_without_pictures_is_the_users_mistake(
    pan_run: Finished, capfd: pytest.CaptureFixture[str]
) -> None:
    before = digests(pan_run.out)
    args = ["run", str(pan_run.clip), "-o", str(pan_run.out), "--run.start_frame", "500"]
    assert cli.main(args) == 2
    assert "no picture in the chosen range" in one_line(capfd.readouterr().err)
    assert digests(pan_run.out) == before


def _below_a_file(folder: Path) -> Path:
    (folder / "file").write_text("mine")
    return folder / "file" / "out"


def _a_file(folder: Path) -> Path:
    (folder / "file").write_text("mine")
    return folder / "file"


def _read_only(folder: Path) -> Path:
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    (folder / "locked").mkdir(mode=0o555)
    return folder / "locked" / "out"


def _long(folder: Path) -> Path:
    return folder / ("a" * 300)


@pytest.mark.parametrize("make", [_below_a_file, _a_file, _read_only, _long])
def test_unwritable_output_is_one_line_before_any_work(
    pan_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], make: Callable[[Path], Path]
) -> None:
    out = make(tmp_path)
    assert cli.main(["run", str(pan_clip), "-o", str(out)]) == 2
    line = one_line(capfd.readouterr().err)
    assert str(out) in line and "-o" in line
    assert not (tmp_path / "file").exists() or (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a device that is always full")
def test_a_full_disk_is_one_line_and_keeps_earlier_outputs(
    pan_run: Finished, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import pipelines.run

    def full(*args: object) -> None:
        with open("/dev/full", "wb", buffering=0) as device:
            device.write(b"x")

    monkeypatch.setattr(pipelines.run, "write_report", full)
    out = tmp_path / "out"
    shutil.copytree(pan_run.out, out)
    before = digests(out)
    few = ["--run.max_frames", "12", "--panorama.enabled", "false", "-q"]
    assert cli.main(["run", str(pan_run.clip), "-o", str(out), *few]) == 2
    assert "no space left" in one_line(capfd.readouterr().err).lower()
    assert {k: v for k, v in digests(out).items() if not k.startswith(".partial-")} == before
