"""What the render jobs share: which frames they take, how these come from the clip, and what is told at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.decode import Clip, Frame
from pipelines.errors import InputError
from pipelines.progress import Progress
from pipelines.render.encode import DEEP, EncodeOptions, VideoWriter, clock_of, shown_colour, video_writer
from pipelines.render.opened import OpenedRun, refuse_clip


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Frames (inclusive) that went through as they are, with the status and reason code of camera.csv."""

    first_frame: int
    last_frame: int
    status: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendered:
    """What a job made. n_changed of n_frames pictures are new; `passed` went through unchanged. facts: of the job."""

    path: Path
    what: str
    size_px: tuple[int, int]
    n_frames: int
    n_changed: int
    sound: str = "none"
    passed: tuple[Stretch, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "what": self.what,
            "path": str(self.path),
            "size_px": list(self.size_px),
            "n_frames": self.n_frames,
            "n_changed": self.n_changed,
            "sound": self.sound,
            "passed_through": [
                {
                    "first_frame": s.first_frame,
                    "last_frame": s.last_frame,
                    "status": s.status,
                    "reason": s.reason,
                }
                for s in self.passed
            ],
            **self.facts,
        }


def chosen_rows(run: OpenedRun, shot: int | None) -> list[int]:
    """Rows that are rendered: those of one shot, or all. Raises InputError: no such shot, or a run without frames."""
    rows = list(range(len(run.table))) if shot is None else run.rows_of_shot(run.shot(shot).index)
    if not rows:
        raise InputError(run.out, "has no frames to render", "run again on a clip with frames")
    return rows


def pictures(
    run: OpenedRun,
    clip: Clip,
    rows: Sequence[int],
    progress: Progress,
    stage: str,
    encode: EncodeOptions | None = None,
    *,
    mixed: bool,
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Row and RGB picture (h, w, 3) of the frames of `rows`, in the clip's order; one is held at a time.

    uint8, or uint16 of 0..65535 for a codec of more bits. mixed: with pictures of BT.709 (panorama, inlay), so that HDR
    is mapped to it; else a codec of more bits gets the clip's own colours.
    Raises InputError: the clip ends before the frames do, or its pictures have another size.
    """
    wanted = {int(run.table.frame[row]): row for row in rows}
    first, last = min(wanted), max(wanted)
    w, h = run.size_px
    done = 0
    progress(stage, 0, len(rows))
    frame: Frame
    for frame in clip.frames(first, last - first + 1):
        row = wanted.get(frame.index)
        if row is None:
            continue
        deep = encode is not None and encode.deep
        picture: NDArray[Any] = frame.deep_picture(mixed) if deep else frame.picture()
        if picture.shape != (h, w, 3):
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            raise InputError(
                clip.facts.path, f"has pictures of {size} px, the run {w}x{h}", "run again on it"
            )
        yield row, picture
        done += 1
        progress(stage, done, len(rows))
    if done < len(rows):
        cause = f"gives {done} of the run's {len(rows)} frames"
        raise InputError(clip.facts.path, cause, "it changed, or decodes differently here: run again")


def writer_like(
    run: OpenedRun,
    clip: Clip,
    rows: Sequence[int],
    path: Path,
    *,
    sound: bool,
    encode: EncodeOptions | None,
    mixed: bool,
) -> AbstractContextManager[VideoWriter]:
    """video_writer() for pictures of these rows as the clip has them: size, times, colour tags, its sound if wanted.

    mixed: as for `pictures`; the tags say what its colours are.
    """
    refuse_clip(path, clip.facts.path)
    own = encode is not None and encode.deep and not mixed
    return video_writer(
        path,
        size_px=run.size_px,
        clock=clock_of(run.table.pts_s[list(rows)], run.picture_fps),
        colour=clip.facts.colour if own else shown_colour(clip.facts.colour),
        pixel_aspect=clip.facts.pixel_aspect,
        sound_of=clip.facts.path if sound else None,
        sound_from_s=float(run.table.pts_s[rows[0]]),
        options=encode,
    )


def to_8_bits(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """A picture of uint8 as it is; of uint16, 0..65535, rounded."""
    if picture.dtype == np.uint8:
        return picture
    return ((picture.astype(np.uint32) + DEEP // 2) // DEEP).astype(np.uint8)


def full_scale(picture: NDArray[Any]) -> float:
    """White of a picture: 255, or 65535 of a deep one."""
    return float(np.iinfo(picture.dtype).max)


def stretches(run: OpenedRun, rows: Sequence[int]) -> tuple[Stretch, ...]:
    """Rows that went through as they are, as stretches of one status and reason."""
    found = []
    labelled = ((row, run.table.status[row], run.table.reason[row]) for row in sorted(rows))
    for _, group in groupby(enumerate(labelled), lambda e: (e[1][0] - e[0], *e[1][1:])):
        members = [entry for _, entry in group]
        first, last = (int(run.table.frame[members[i][0]]) for i in (0, -1))
        found.append(Stretch(first_frame=first, last_frame=last, status=members[0][1], reason=members[0][2]))
    return tuple(found)
