"""A camera move that nobody made: keyframed pan, tilt and zoom over a shot's panorama, rendered to a new video.

Only what the panorama holds can be shown: no players, and black where nobody ever looked.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.errors import InputError
from pipelines.progress import Progress, silent
from pipelines.render.encode import EncodeOptions, clock_of, shown_colour, video_writer
from pipelines.render.job import Rendered
from pipelines.render.opened import OpenedRun, one_shot, refuse_clip
from pipelines.render.paths import read_move
from pipelines.render.plate import read_plate
from pipelines.render.views import View, camera_view

MAX_SECONDS = 3600.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MoveOptions:
    """path: CSV or JSON of keyframes (paths.read_move), angles in the shot's world. size_px: None = the clip's, with
    square pixels. fps: None = the clip's. shot: None = the only one with a panorama."""

    path: str | Path
    size_px: tuple[int, int] | None = None
    fps: float | None = None
    shot: int | None = None


def move(
    run: OpenedRun,
    path: Path,
    options: MoveOptions,
    *,
    encode: EncodeOptions | None = None,
    progress: Progress = silent,
) -> Rendered:
    """Write the move. Raises InputError: no panorama, no calibrated camera, keyframes; OutputError: cannot be written.

    The clip itself is not needed.
    """
    refuse_clip(path, Path(str(run.record.clip.get("path") or "")))
    keys = read_move(Path(options.path))
    if not 0 < keys.duration_s <= MAX_SECONDS:
        cause = f"runs for {keys.duration_s:g} s, more than {MAX_SECONDS:g}"
        raise InputError(options.path, cause, "time_s is in seconds")
    candidates = [s.index for s in run.record.shots if s.panorama is not None and run.calibrated(s.index)]
    why = "no shot has a panorama and a calibrated camera"
    index = one_shot(run, candidates, options.shot, why)
    if not run.calibrated(index):
        raise run.why_no_camera(index)
    plate = read_plate(run.panorama_path(index))
    size = options.size_px or run.size_px
    if min(size) < 16 or max(size) > 8192:
        raise InputError(
            "--size", f"is {size[0]}x{size[1]} px, must be 16 to 8192 a side", "give another size"
        )
    fps = options.fps or run.picture_fps
    n = int(np.floor(keys.duration_s * fps + 1e-6)) + 1
    seconds = np.arange(n) / fps
    unseen = 0.0
    with video_writer(
        path,
        size_px=size,
        clock=clock_of(seconds, fps),
        colour=shown_colour(run.record.clip.get("colour") or {}),
        options=encode,
    ) as writer:
        progress("move", 0, n)
        for i, camera in enumerate(zip(*keys.at(seconds), strict=True)):
            picture, known = plate.seen_by(virtual_view(size, *map(float, camera)))
            unseen += float(1 - known.mean())
            writer.write(picture)
            progress("move", i + 1, n)
    return Rendered(
        path=path,
        what="move",
        size_px=size,
        n_frames=n,
        n_changed=n,
        facts={"shot": index, "black_share": unseen / n, "duration_s": float(n / fps)},
    )


def virtual_view(
    size_px: tuple[int, int], pan_rad: float, tilt_rad: float, roll_rad: float, hfov_rad: float
) -> View:
    """A camera without distortion whose picture is hfov_rad wide."""
    f_px = size_px[0] / (2 * np.tan(hfov_rad / 2))
    return camera_view(size_px, float(f_px), (pan_rad, tilt_rad, roll_rad))
