"""A run that is killed between two shots, and goes on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.pipelines.end_to_end import Finished, digests, run

pytestmark = pytest.mark.slow  # whole runs

WAIT_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Killed:
    """OUT after SIGKILL: what lay in it before, and which file of the finished shot is where."""

    out: Path
    before: dict[str, str]
    exit_code: int
    after: dict[str, str]


@pytest.fixture(scope="module")
def killed(
    cut_clip: Path, cut_run: Finished, pan_run: Finished, tmp_path_factory: pytest.TempPathFactory
) -> Killed:
    """The clip of two shots into a folder that holds another run's results, killed when shot 0 is saved."""
    out = tmp_path_factory.mktemp("killed") / "out"
    shutil.copytree(pan_run.out, out)
    before = digests(out)
    command = [sys.executable, "-m", "pipelines.cli", "run", str(cut_clip), "-o", str(out), "-q"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    try:
        until = time.monotonic() + WAIT_S
        while not list(out.glob(".partial-*/shot-000/shot.json")):
            assert process.poll() is None, process.communicate()[1]
            assert time.monotonic() < until, "shot 0 was not saved in time"
            time.sleep(0.01)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    return Killed(out=out, before=before, exit_code=process.returncode, after=digests(out))


def test_what_lay_there_is_whole_after_a_kill(killed: Killed) -> None:
    assert killed.exit_code == -signal.SIGKILL  # it had not ended by itself
    visible = {k: v for k, v in killed.after.items() if not k.startswith(".")}
    assert visible == killed.before


def test_resume_ends_with_the_same_bytes_and_does_shot_0_once(
    killed: Killed, cut_clip: Path, cut_run: Finished, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="pipelines")
    [saved] = killed.out.glob(".partial-*/shot-000/panorama.tif")
    inode = saved.stat().st_ino
    resumed = run(cut_clip, killed.out, "--resume")
    assert (resumed.code, resumed.stderr) == (0, "")
    assert resumed.camera_bytes == cut_run.camera_bytes
    assert (killed.out / "shot-000" / "panorama.tif").stat().st_ino == inode
    expected, found = digests(cut_run.out), digests(killed.out)
    assert set(found) == set(expected)  # nothing of the earlier run or of the killed one is left
    different = {name for name in expected if expected[name] != found[name]}
    assert different <= {"run.json", "report.html"}
    ours, theirs = resumed.record, cut_run.record
    for record in (ours, theirs):
        record.pop("timings_s")
        for shot in record["shots"]:
            shot.pop("timings_s")
    assert ours == theirs
