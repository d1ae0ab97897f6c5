"""The command line with a stand-in for the pipeline: exit codes, one-line errors, JSON, settings, many clips."""

from __future__ import annotations

import json
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines import cli
from pipelines.archive import write_camera_csv
from pipelines.config import Config
from pipelines.errors import InputError, UserError
from pipelines.output_folder import OutputFolder
from pipelines.progress import TerminalProgress, silent
from pipelines.records import RunRecord
from tests.pipelines.clips import write_clip
from tests.pipelines.tables import camera_table, run_record, shot_record

HEAVY = ("torch", "cv2", "kornia", "scipy", "numba", "av", "numpy")  # pydantic is typer's own need


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Puts a quick pipelines.run in place. A clip named bad* is unusable, weak* has a failed shot, bug* trips."""
    seen: list[dict[str, Any]] = []

    def process(
        clip: Path, out: Path, config: Config, progress: Callable[..., None], resume: bool
    ) -> RunRecord:
        seen.append({"clip": clip, "out": out, "config": config, "resume": resume})
        progress("register", 1, None)
        if clip.stem.startswith("bad"):
            raise InputError(clip, "is not a video but text", "give the video file itself")
        if clip.stem.startswith("bug"):
            raise RuntimeError("index out of range")
        if clip.stem.startswith("stop"):
            raise KeyboardInterrupt
        failed = clip.stem.startswith("weak")
        shot = (
            shot_record(status="failed", sentence="nothing could be registered") if failed else shot_record()
        )
        record = run_record((shot,))
        with OutputFolder(out, "digest") as folder:
            table = camera_table(10, f_px=np.linspace(2000, 2500, 10), f_std_px=np.full(10, 31.0))
            write_camera_csv(folder.stage("camera.csv"), table)
            folder.publish(record)
        return record

    module = types.ModuleType("pipelines.run")
    module.process = process  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pipelines.run", module)
    return seen


@pytest.fixture
def clip(tmp_path: Path) -> Callable[[str], str]:
    def make(name: str) -> str:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
        return str(tmp_path / name)

    return make


def one_line(text: str) -> str:
    [line] = text.splitlines()
    assert "Traceback" not in line
    return line


@pytest.mark.parametrize("args", [["--help"], ["run", "--help"], ["--version"]])
def test_help_loads_nothing_heavy(args: list[str]) -> None:
    code = (
        f"import sys; sys.argv = ['x', *{args!r}]; from pipelines.cli import main; code = main();"
        f"print([m for m in {HEAVY!r} if m in sys.modules], code, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[] 0\n" and done.stdout.strip()


def test_run_passes_settings_on_and_shows_the_shots(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text("[shots]\nmin_frames = 7\nbridge_frames = 3\n")
    args = [
        "run",
        "--shots.min_frames",
        "8",
        clip("a.mp4"),
        "-o",
        str(tmp_path / "out"),
        "--config",
        str(toml),
    ]
    assert cli.main([*args, "--panorama.enabled=off", "--resume"]) == 0
    [call] = calls
    assert call["clip"].name == "a.mp4" and call["out"] == tmp_path / "out" and call["resume"] is True
    assert call["config"].shots.min_frames == 8 and call["config"].shots.bridge_frames == 3
    assert call["config"].panorama.enabled is False
    shown = capsys.readouterr()
    assert "2000 ± 31 to 2500 ± 31" in shown.out and "report.html" in shown.out
    assert shown.err == ""


def test_run_json_is_one_document_on_stdout(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", clip("a.mp4"), "-o", str(tmp_path / "out"), "--json"]) == 0
    shown = capsys.readouterr()
    document = json.loads(shown.out)
    assert document["exit_code"] == 0 and shown.err == ""
    assert document["clips"][0]["run"]["shots"][0]["status"] == "ok"


def test_quiet_says_nothing(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", clip("a.mp4"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_failed_shot_is_named_and_exits_1(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", clip("weak.mp4"), "-o", str(tmp_path / "out"), "-q"]) == 1
    line = one_line(capsys.readouterr().err)
    assert "weak.mp4" in line and "shot 0" in line and "nothing could be registered" in line


@pytest.mark.parametrize("as_json", [False, True])
def test_a_users_mistake_is_one_line_and_exit_2(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
    as_json: bool,
) -> None:
    good, out = clip("a.mp4"), ["-o", str(tmp_path / "out")]
    mistakes = {
        "no such file": ["run", str(tmp_path / "none.mp4"), *out],
        "not a video": ["run", clip("bad.mp4"), *out],
        "did you mean --shots.min_frames": ["run", good, *out, "--shots.min_frame", "3"],
        "has no value": ["run", good, *out, "--shots.min_frames"],
        "Missing option": ["run", good],
        "No such option": ["run", good, *out, "--resum"],
        "No such command": ["rum", good],
        "name too long": ["run", str(tmp_path / ("a" * 300)), *out],
        "no such file; check": ["run", good, *out, "--config", str(tmp_path / "none.toml")],
        "finished run": ["compare", str(tmp_path / "nowhere"), good],
        "has no settings": ["compare", good, good, "--shots.min_frames", "3"],
    }
    for said, args in mistakes.items():
        assert cli.main([*args, "--json"] if as_json else args) == 2, said
        shown = capsys.readouterr()
        assert said in one_line(shown.err)
        if as_json:
            document = json.loads(shown.out)
            assert document["exit_code"] == 2 and said.split(";")[0] in " ".join(document["error"].values())
        else:
            assert shown.out == ""
    assert not (tmp_path / "out").exists()


def test_interrupt_exits_130(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", clip("stop.mp4"), "-o", str(tmp_path / "out")]) == 130
    assert "--resume" in one_line(capsys.readouterr().err)


def test_a_bug_keeps_its_traceback(
    tmp_path: Path, calls: list[dict[str, Any]], clip: Callable[[str], str]
) -> None:
    with pytest.raises(RuntimeError, match="index out of range"):
        cli.main(["run", clip("bug.mp4"), "-o", str(tmp_path / "out")])


def test_demo_puts_truth_beside_estimate(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    clip: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    header = "frame,f_px,pan_deg,tilt_deg,roll_deg,cx_px,cy_px,aspect,k1,shot"
    truth = tmp_path / "sample-truth.csv"
    truth.write_text("\n".join([header, *(f"{i},2000,{i},0,0,320,180,1,0,0" for i in range(10))]) + "\n")
    monkeypatch.setattr(cli, "sample_clip", lambda: (Path(clip("sample.mp4")), truth))
    assert cli.main(["demo", "-o", str(tmp_path / "out")]) == 0
    assert "f med %" in capsys.readouterr().out
    assert cli.main(["demo", "-o", str(tmp_path / "out"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["comparison"]["shots"][0]["with_focal"] == 10


def test_help_config_lists_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--help-config"]) == 0
    assert "--registration.n_fine 6000" in capsys.readouterr().out


def test_probe_states_the_facts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_clip(tmp_path / "a.mov", 12, codec="libx264", metadata={"timecode": "10:00:00:00"})
    assert cli.main(["probe", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["size_px"] == [64, 48] and facts["fps"] == 25 and facts["timecode"] == "10:00:00:00"
    # Ramps with no texture to register: no picture hangs together with the next, so there is no shot.
    assert facts["shots"]["estimated"] is True and facts["shots"]["list"] == []
    assert facts["shots"]["n_frames"] == facts["shots"]["n_frames_in_no_shot"] == 12
    assert facts["overlays"]["estimated"] is False and facts["overlays"]["reason"]
    assert cli.main(["probe", str(path)]) == 0
    text = capsys.readouterr().out
    assert "64x48 (4:3)" in text and "progressive" in text and "h264" in text


def test_probe_of_unusable_files_exits_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mp4").write_text("not a video\n" * 20)
    for path, said in (
        (tmp_path / "text.mp4", "text"),
        (write_clip(tmp_path / "one.mkv", 1), "only one picture"),
    ):
        assert cli.main(["probe", str(path)]) == 2
        assert said in one_line(capsys.readouterr().err)


def test_progress_is_silent_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with TerminalProgress() as progress:
        progress("register", 1, 10)
    silent("register", 1, 10)
    assert capsys.readouterr() == ("", "")


def test_progress_shows_stage_count_and_rate_on_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with TerminalProgress("a.mp4: ") as progress:
        progress("register", 3, 10)
        progress("register", 10, 10)
    shown = capsys.readouterr()
    assert shown.out == "" and "a.mp4: register" in shown.err and "10/10" in shown.err


def test_progress_keeps_a_line_a_stage_and_ends_finished(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forty shots, a header that promised too much, and a stage that counts nothing."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with TerminalProgress() as progress:
        for shot in range(40):
            progress("first pass", 20 * (shot + 1), 825)
            progress("calibration", 0, None)
            progress("calibration", 1, 1)
            for done in (1, 7):
                progress("second pass", done, 7)
    last = capsys.readouterr().err.rpartition("first pass")
    end = last[1] + last[2]
    assert end.count("second pass") == end.count("calibration") == 1
    assert "800/800" in end and "7/7" in end and "/825" not in end
    assert "1/1" not in end


def test_errors_stay_on_one_line_whatever_the_file_is_called() -> None:
    error = UserError("two\nlines\x1b[31m.mp4", "no such file", "check the path")
    assert str(error) == "two\\nlines\\x1b[31m.mp4: no such file; check the path"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["export", "out", "--to", "vrml"], "no export is called 'vrml'"),
        (["render", "out", "--what", "dance"], "Invalid value for '--what': 'dance' is not one of"),
        (["run", "a.mp4"], "Missing option '-o'"),
        (["rays", "out", "--frame", "5"], "--frame needs --pixel X,Y"),
    ],
)
def test_wrong_usage_is_one_clean_line_that_names_the_command(
    args: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(args) == 2
    line = one_line(capsys.readouterr().err)
    assert line.startswith(f"broadcast-mosaic: {said}")
    assert line.endswith(f"; see broadcast-mosaic {args[0]} --help") and "Value error" not in line


def test_the_final_table_cuts_no_word_off_in_a_narrow_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines import summary

    files = tuple(
        f"shot-000/{name}" for name in ("pairs.npz", "panorama.tif", "panorama.jpg", "panorama.json")
    )
    code = "perspective_signal_below_systematics"
    shot = shot_record(status="relative", reason=code, sentence="", files=files)
    with OutputFolder(tmp_path / "out", "digest") as folder:
        write_camera_csv(folder.stage("camera.csv"), camera_table(10, f_px=np.full(10, np.nan)))
        folder.publish(run_record((shot,)))
    monkeypatch.setattr(summary, "WIDTH", 80)
    summary.print_summary(tmp_path / "out", run_record((shot,)))
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.splitlines() if line[:1] in "┃│") == 80
    assert "…" not in shown and "relative" in shown
    assert "shot 0: perspective signal below systematics" in shown
    assert summary.file_names(files) == "pairs.npz, panorama .tif .jpg .json"
    tiles = [f"shot-000/panorama_files/9/{n}_0.jpg" for n in range(40)]
    assert summary.file_names((*files[:1], *tiles)) == "pairs.npz, panorama_files (40 files)"
