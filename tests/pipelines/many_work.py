"""A quick stand-in for the pipeline that worker processes import: what a clip does is in its name."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import numpy as np

from pipelines.archive import write_camera_csv
from pipelines.errors import InputError
from pipelines.many import Task
from pipelines.output_folder import OutputFolder
from pipelines.records import RunRecord
from tests.pipelines.tables import camera_table, run_record, shot_record


def work(task: Task, progress: Callable[[str, int, int | None], None]) -> RunRecord:
    """bad*: unusable; bug*: trips; dies*: its process is killed; weak*: a failed shot; slow*: waits; else fine."""
    name = task.clip.stem
    progress("register", 1, None)
    if name.startswith("bad"):
        raise InputError(task.clip, "is not a video but text", "give the video file itself")
    if name.startswith("bug"):
        raise RuntimeError("index out of range")
    if name.startswith("dies"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("slow"):
        time.sleep(0.5)
    if name.startswith("for-ever"):
        task.out.mkdir(parents=True)
        time.sleep(300)
    failed = name.startswith("weak")
    shot = shot_record(status="failed", sentence="nothing could be registered") if failed else shot_record()
    record = run_record((shot,), clip={"path": str(task.clip), "n_frames_decoded": 10})
    f_px = np.full(10, np.nan) if failed else np.linspace(2000, 2500, 10)
    with OutputFolder(task.out, "digest") as folder:
        write_camera_csv(folder.stage("camera.csv"), camera_table(10, f_px=f_px, f_std_px=f_px / 100))
        folder.publish(record)
    return record
