"""Many clips: names, lists, processes, what becomes of a clip that fails, summary.csv. Real runs are at the end."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipelines import cli, cli_many
from pipelines.config import Config
from pipelines.errors import ConfigError
from pipelines.many import Outcome, Task, folder_names, read_list, run_many
from pipelines.output_folder import OutputFolder, held_folder
from tests.pipelines.clips import write_clip
from tests.pipelines.end_to_end import digests
from tests.pipelines.many_work import work


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers take the quick stand-in for the pipeline."""
    monkeypatch.setattr(cli_many, "work_on", work)


def tasks(folder: Path, *names: str) -> list[Task]:
    return [Task(clip=folder / name, out=folder / "out" / name, config=Config()) for name in names]


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "summary.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_folder_names_are_unique_whatever_the_clips_are_called() -> None:
    clips = [
        "x/a.mp4",
        "y/A.mov",
        "a-2.mp4",
        "y/a.mkv",
        "summary.csv.mp4",
        "take1/%06d.png",
        "take1/*.png",
        "x.y.mp4",
        "take2/sub/..",
        ".lock.mp4",
    ]
    names = folder_names([Path(clip) for clip in clips])
    assert names == [
        "a",
        "A-2",
        "a-2-2",
        "a-3",
        "summary.csv-2",
        "take1",
        "take1-2",
        "x.y",
        "take2",
        ".lock-2",
    ]
    assert len({name.casefold() for name in names}) == len(clips)


def test_a_list_names_clips_one_a_line(tmp_path: Path) -> None:
    path = tmp_path / "clips.txt"
    path.write_bytes("\ufeff# the season\r\n\r\n a b.mp4 \r\nc/Über.mov\r\n".encode())
    assert read_list(path) == [Path("a b.mp4"), Path("c/Über.mov")]


@pytest.mark.parametrize(
    ("content", "cause"),
    [(None, "no such file"), (b"# none\n", "names no clip"), (b"\xff\xfe\x00", "not a text")],
)
def test_an_unusable_list_is_named(tmp_path: Path, content: bytes | None, cause: str) -> None:
    path = tmp_path / "clips.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=cause):
        read_list(path)


def test_outcomes_are_those_of_the_tasks_in_their_order_for_any_number_of_processes(tmp_path: Path) -> None:
    names = ("slow.mp4", "dies.mp4", "bad.mp4", "bug.mp4", "weak.mp4", "fine.mp4")
    expected = [None, "crash", "input", "bug", None, None]
    for jobs in (1, 3):
        told: list[int] = []

        def note(number: int, outcome: Outcome, told: list[int] = told) -> None:
            told.append(number)

        found = run_many(tasks(tmp_path / str(jobs), *names), jobs, work=work, on_done=note)
        assert [o.error["kind"] if o.error is not None else None for o in found] == expected
        assert sorted(told) == list(range(len(names)))
        assert found[1].error is not None and "signal 9" in found[1].error["cause"]
        assert [o.record.shots[0].status for o in found if o.record is not None] == ["ok", "failed", "ok"]


def test_one_failing_clip_never_stops_the_others_and_each_has_its_row(
    tmp_path: Path, stand_in: None, capfd: pytest.CaptureFixture[str]
) -> None:
    listed = tmp_path / "clips.txt"
    listed.write_text("b/a.mov\nweak.mp4\ndies.mp4\n")
    out = tmp_path / "out"
    args = ["run", "bad.mp4", "a.mp4", "--list", str(listed), "-o", str(out), "--jobs", "2", "--json"]
    assert cli.main(args) == 2
    shown = capfd.readouterr()
    document = json.loads(shown.out)
    assert [Path(c["out"]).name for c in document["clips"]] == ["bad", "a", "a-2", "weak", "dies"]
    assert [c["error"] is None for c in document["clips"]] == [False, True, True, True, False]
    assert "Traceback" not in shown.err and len(shown.err.splitlines()) == 3
    table = rows(out)
    assert [r["status"] for r in table] == ["unusable", "ok", "ok", "failed", "error"]
    assert [r["folder"] for r in table] == ["bad", "a", "a-2", "weak", "dies"]
    assert "is not a video but text" in table[0]["reason"] and table[1]["reason"] == ""
    assert (
        table[3]["reason"] == "shot 0 failed: nothing could be registered"
        and "signal 9" in table[4]["reason"]
    )
    assert [table[1][c] for c in ("frames", "shots", "shots_ok", "f_min_px", "f_max_std_px")] == [
        "10", "1", "1", "2000.0", "25.0"
    ]  # fmt: skip
    assert table[0]["frames"] == table[0]["shots"] == table[3]["f_min_px"] == ""
    assert not (out / "bad").exists() and not (out / ".lock").exists()


def test_exit_code_is_the_worst_of_the_clips(tmp_path: Path, stand_in: None) -> None:
    for clips, code in ((["a", "b"], 0), (["a", "weak"], 1), (["a", "bug"], 1), (["weak", "bad", "bug"], 2)):
        assert cli.main(["run", *clips, "-o", str(tmp_path / clips[-1]), "-q"]) == code


def test_a_list_of_one_clip_gets_a_folder_too(
    tmp_path: Path, stand_in: None, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "one.txt").write_text("a.mp4\n")
    assert cli.main(["run", "--list", str(tmp_path / "one.txt"), "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "a" / "run.json").is_file()
    assert "2000 ± 20 to 2500 ± 25" in capsys.readouterr().out


def test_neither_clip_nor_list_is_a_usage_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "-o", str(tmp_path / "out")]) == 2
    assert "--list" in capsys.readouterr().err


def test_two_runs_of_many_do_not_share_a_folder(
    tmp_path: Path, stand_in: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with held_folder(tmp_path / "out"):
        assert cli.main(["run", "a.mp4", "b.mp4", "-o", str(tmp_path / "out")]) == 2
    assert "another run" in capsys.readouterr().err
    with OutputFolder(
        tmp_path / "out" / "a", "digest"
    ):  # a run of one clip is writing there: that clip fails alone
        assert cli.main(["run", "a.mp4", "b.mp4", "-o", str(tmp_path / "out"), "-q"]) == 2
    assert [r["status"] for r in rows(tmp_path / "out")] == ["unusable", "ok"]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().split(")")[1][:3]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the workers in /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_program(tmp_path: Path, how: signal.Signals) -> None:
    code = (
        "import sys; from pipelines import cli, cli_many; from tests.pipelines.many_work import work\n"
        "cli_many.work_on = work\n"
        "if __name__ == '__main__': sys.exit(cli.main(sys.argv[1:]))\n"
    )
    (tmp_path / "start.py").write_text(code)
    out = tmp_path / "out"
    command = [sys.executable, str(tmp_path / "start.py"), "run", "for-ever-1", "for-ever-2", "-o", str(out)]
    root = str(Path(cli.__file__).parent.parent)
    # A shell has what it puts in the background (make test &) ignore interrupts, and children inherit that.
    running = subprocess.Popen(
        [*command, "--jobs", "2"], stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": root},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        until = time.monotonic() + 60
        while len(list(out.glob("for-ever-*"))) < 2:
            assert running.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
        assert len(children) >= 2
        running.send_signal(how)
        stderr = running.communicate(timeout=30)[1]
    finally:
        running.kill()
        running.wait()
    assert running.returncode == (130 if how == signal.SIGINT else -9)
    if how == signal.SIGINT:
        assert "--resume" in stderr and "Traceback" not in stderr
    until = time.monotonic() + 10
    while any(alive(int(child)) for child in children):
        assert time.monotonic() < until, "a worker lives on"
        time.sleep(0.05)


@pytest.mark.slow
def test_real_clips_give_the_same_for_any_number_of_processes_and_resume_keeps_them(
    tmp_path: Path, pan_clip: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.mp4").write_text("not a video\n" * 50)
    clips = [str(pan_clip), str(tmp_path / "text.mp4"), str(write_clip(tmp_path / "ramp.mkv", 12))]
    few = ["--run.max_frames", "14", "--panorama.enabled", "false", "-q"]
    for jobs in ("1", "3"):
        assert cli.main(["run", *clips, "-o", str(tmp_path / jobs), "--jobs", jobs, *few]) == 2
    shown = capfd.readouterr()
    assert "Traceback" not in shown.err and "not a video but text" in shown.err
    one, three = digests(tmp_path / "1"), digests(tmp_path / "3")
    assert set(one) == set(three) >= {"summary.csv", "pan/run.json", "ramp/camera.csv"}
    with_times = {"summary.csv", "run.json", "report.html"}
    assert {name for name in one if one[name] != three[name] and Path(name).name not in with_times} == set()
    first, other = rows(tmp_path / "1"), rows(tmp_path / "3")
    for row in (*first, *other):
        row.pop("seconds")
    assert first == other and [r["frames"] for r in first] == ["14", "", "12"]

    inode = (tmp_path / "1" / "pan" / "run.json").stat().st_ino
    (tmp_path / "1" / "ramp" / "camera.csv").unlink()
    assert cli.main(["run", *clips, "-o", str(tmp_path / "1"), "--resume", *few]) == 2
    assert (tmp_path / "1" / "pan" / "run.json").stat().st_ino == inode  # kept
    assert digests(tmp_path / "1")["ramp/camera.csv"] == three["ramp/camera.csv"]  # made anew
