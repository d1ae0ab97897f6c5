"""A finished run opened for rendering: its cameras, its clip, which must still be there, and its panoramas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.archive import read_camera_csv, read_run
from pipelines.config import DecodeOptions
from pipelines.decode import Clip, open_clip
from pipelines.errors import InputError, OutputError, UserError
from pipelines.frame_geometry import FrameGeometry, frame_geometry
from pipelines.records import CameraTable, RunRecord, ShotRecord
from pipelines.render.views import View, frame_view, homography_view
from pipelines.report.words import reason_words


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenedRun:
    """A run in folder `out`. rows: frame number to row of `table`; geometry: what the table does not say of them."""

    out: Path
    record: RunRecord
    table: CameraTable
    rows: dict[int, int]
    geometry: FrameGeometry

    @property
    def size_px(self) -> tuple[int, int]:
        """(w, h) of the frames as decoded."""
        width, height = self.record.clip["size_px"]
        return int(width), int(height)

    @property
    def picture_fps(self) -> float:
        """Pictures per second; 25 where the clip has no rate, as everywhere else."""
        return float(self.record.clip.get("picture_fps") or self.record.clip.get("fps") or 25.0)

    def shot(self, index: int) -> ShotRecord:
        """Raises InputError: no such shot."""
        for record in self.record.shots:
            if record.index == index:
                return record
        known = ", ".join(str(record.index) for record in self.record.shots) or "none"
        raise InputError(f"shot {index}", "is not in this run", f"its shots: {known}")

    def rows_of_shot(self, index: int) -> list[int]:
        """Rows of a shot's frames, in order."""
        return [int(row) for row in np.flatnonzero(self.table.shot == index)]

    def view(self, row: int) -> View | None:
        """The camera of a row, None where it has none. Panorama and pitch are seen from the pan axis, frames from the
        pupil, and their rows one after the other where the shot has a rolling shutter."""
        return frame_view(self.table, row, self.size_px, self.geometry)

    def shot_views(self, index: int) -> dict[int, View]:
        """Row to view of every frame of a shot that has a camera.

        A shot without a focal length gives views by homography: its frames lie over each other, rays mean nothing.
        """
        rows = self.rows_of_shot(index)
        views = {row: view for row in rows if (view := self.view(row)) is not None}
        if views:
            return views
        return {
            row: view for row in rows if (view := homography_view(self.table, row, self.size_px)) is not None
        }

    def calibrated(self, index: int) -> bool:
        """Whether any frame of the shot has a whole camera."""
        return any(self.view(row) is not None for row in self.rows_of_shot(index))

    def panorama_path(self, index: int) -> Path:
        """shot-NNN/panorama.tif with its panorama.json. Raises InputError where there is none."""
        path = self.out / f"shot-{index:03d}" / "panorama.tif"
        for needed in (path, path.with_suffix(".json")):
            if not needed.is_file():
                why = f"shot {index} has no panorama here"
                raise InputError(needed, why, "run again with panorama.enabled, into this folder")
        return path

    def why_no_camera(self, index: int) -> UserError:
        """What to tell somebody who wants a focal length from a shot that has none."""
        record = self.shot(index)
        cause = record.sentence or (
            reason_words(record.reason)[0] if record.reason else "no frame has a camera"
        )
        text = cause[0].lower() + cause[1:].rstrip(".")
        return InputError(
            f"{self.out}, shot {index}",
            f"has no calibrated camera: {text}",
            "if you know a focal length, give it to the run with --calibration.focal_px",
        )


def open_run(out: str | Path) -> OpenedRun:
    """Raises InputError: no finished run there, damaged, or one that does not say how large its pictures are."""
    folder = Path(out)
    record, table = read_run(folder), read_camera_csv(folder / "camera.csv")
    if not record.clip.get("size_px"):
        raise InputError(folder / "run.json", "does not say how large the pictures are", "run again")
    return OpenedRun(
        out=folder, record=record, table=table, rows={int(f): i for i, f in enumerate(table.frame)},
        geometry=frame_geometry(record, table),
    )  # fmt: skip


def open_its_clip(run: OpenedRun, elsewhere: Path | None = None) -> Clip:
    """The clip that the run was made from; elsewhere: where it lies now.

    Raises InputError: it is not there, or it is another one (by size, first and last megabyte).
    """
    known = str(run.record.clip.get("path") or "")
    path = elsewhere or Path(known)
    pattern = any(sign in path.name for sign in "%*?[")
    if (not known and elsewhere is None) or not (path.exists() or pattern):
        raise InputError(path, "the run's clip is not there", "say where it is now with --clip FILE")
    options = DecodeOptions.model_validate(dict(run.record.config.get("decode", {})))
    clip = open_clip(path, options)
    identity = run.record.clip.get("identity")
    if identity and clip.facts.identity() != identity:
        clip.close()
        cure = "give the very file that was run with --clip FILE, or run again on this one"
        raise InputError(path, "is not the clip that the run was made from", cure)
    return clip


def refuse_clip(target: Path, clip: Path) -> None:
    """Raises OutputError: the video would be written over the clip that it is made from."""
    if target.exists() and clip.exists() and target.samefile(clip):
        raise OutputError(target, "is the run's clip", "give another name with -o")


def one_shot(run: OpenedRun, candidates: Sequence[int], shot: int | None, why: str) -> int:
    """The shot that is meant: the one asked for, or the only candidate. Raises InputError, which says `why`."""
    if shot is not None:
        return run.shot(shot).index
    if len(candidates) != 1:
        cause = why if not candidates else f"{len(candidates)} shots could be meant ({_listed(candidates)})"
        cure = "see report.html for the reasons" if not candidates else "choose one with --shot"
        raise InputError(run.out, cause, cure)
    return candidates[0]


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:8])) + (", ..." if len(numbers) > 8 else "")
