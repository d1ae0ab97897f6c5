"""summary.csv: a row a clip of a run over many. What became of each, in words and numbers; no computation."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pipelines.errors import UserError
from pipelines.many import Outcome, Task
from pipelines.records import RunRecord, ShotRecord

FOCAL = ("f_min_px", "f_min_std_px", "f_max_px", "f_max_std_px")
COLUMNS = (
    "clip",
    "folder",
    "status",
    "reason",
    "frames",
    "shots",
    "shots_ok",
    "shots_relative",
    "shots_failed",
    *FOCAL,
    "seconds",
)


def clip_status(outcome: Outcome) -> str:
    """What the clip as a whole came to.

    'ok': every shot has a focal length; 'relative': all registered, some without one; 'failed': a shot failed or none
    was found; 'unusable': the clip cannot be read, or its folder not be written; 'error': the program failed.
    """
    if outcome.error is not None:
        return "error" if outcome.error["kind"] in ("bug", "crash") else "unusable"
    assert outcome.record is not None
    found = {shot.status for shot in outcome.record.shots}
    if not found or "failed" in found:
        return "failed"
    return "ok" if found == {"ok"} else "relative"


def clip_reason(outcome: Outcome) -> str:
    """Why the status is not 'ok', in one line; '' when it is."""
    if outcome.error is not None:
        return _one_line(f"{outcome.error['cause']}; {outcome.error['cure']}")
    assert outcome.record is not None
    if not outcome.record.shots:
        return "no shot was found"
    return "; ".join(_shot_words(shot) for shot in outcome.record.shots if shot.status != "ok")


def row(task: Task, outcome: Outcome) -> dict[str, str | int | float | None]:
    """One row by column; None is an empty cell (not known). Focal lengths: the shortest and the longest of all shots.

    seconds: of the run that made the results, also where --resume has kept them.
    """
    record = outcome.record
    shots = record.shots if record is not None else ()
    focal = _focal_range(task.out) if record is not None else {}
    counts = {word: sum(shot.status == word for shot in shots) for word in ("ok", "relative", "failed")}
    seconds = record.timings_s.get("total", outcome.seconds) if record is not None else outcome.seconds
    return {
        "clip": str(task.clip),
        "folder": task.out.name,
        "status": clip_status(outcome),
        "reason": clip_reason(outcome),
        "frames": _frames(record),
        "shots": len(shots) if record is not None else None,
        **{f"shots_{word}": n if record is not None else None for word, n in counts.items()},
        **{name: focal.get(name) for name in FOCAL},
        "seconds": round(seconds, 2),
    }


def write_summary(path: Path, rows: Sequence[dict[str, str | int | float | None]]) -> None:
    """The rows under a header, written whole or not at all. Raises OSError: no room, or not writable."""
    from pipelines.archive import whole_file

    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for values in rows:
        writer.writerow({name: "" if value is None else value for name, value in values.items()})
    with whole_file(path) as stream:
        stream.write(text.getvalue().encode("utf-8", "surrogateescape"))


def _focal_range(out: Path) -> dict[str, float]:
    """px: shortest and longest focal length in OUT/camera.csv and their one-sigma errors; {} where none is claimed."""
    import numpy as np

    from pipelines.archive import read_camera_csv

    with suppress(UserError):
        camera = read_camera_csv(out / "camera.csv")
        known = np.flatnonzero(np.isfinite(camera.f_px))
        if len(known):
            ends = known[np.argmin(camera.f_px[known])], known[np.argmax(camera.f_px[known])]
            values = [float(column[i]) for i in ends for column in (camera.f_px, camera.f_std_px)]
            return {name: round(value, 2) for name, value in zip(FOCAL, values, strict=True)}
    return {}


def _frames(record: RunRecord | None) -> int | None:
    """Pictures handed out: fields of an interlaced clip count one each."""
    count = record.clip.get("n_frames_decoded") if record is not None else None
    return int(count) if count is not None else None


def _shot_words(shot: ShotRecord) -> str:
    return _one_line(f"shot {shot.index} {shot.status}: {shot.sentence or shot.reason}")


def _one_line(text: str) -> str:
    return " ".join(text.split())
