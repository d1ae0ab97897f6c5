"""The main job: `process` takes a clip to a folder of results, shot by shot, in bounded memory.

Two decoders run through the clip, the second one shot behind the first; what a shot needs in between is its
keyframes' pixels (0.4 MB each), its pair fits, and scratch files that go with the shot.
"""

from __future__ import annotations

import itertools
import logging
import platform
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from mosaic.estimator import RegisterOptions
from pipelines.archive import program_version
from pipelines.config import Config
from pipelines.decode import Clip, Frame, open_clip
from pipelines.errors import InputError
from pipelines.exports.exporter import export_for_run
from pipelines.kept_shots import ShotShelf
from pipelines.keyframe_graph import KeyframeImages
from pipelines.merged_shots import merge_shots
from pipelines.output_folder import OutputFolder, run_digest
from pipelines.overlays import OverlayFinder, both_masks
from pipelines.people import People, open_people
from pipelines.preparation import PreparedFrame, prepare_frame, refuse_tiny
from pipelines.records import CameraTable, RunRecord, ShotRecord
from pipelines.report.build import write_report
from pipelines.shot import Timings, lost_rows, priors_of, solve_shot
from pipelines.shot_files import thumbnails, write_shot
from pipelines.shots import ShotSplitter, TrackedShot
from pipelines.table import FrameFacts, blank_rows, concatenate
from pipelines.tracking import ShotTracker, selection_of
from pipelines.watching import OverlayWatch

log = logging.getLogger(__name__)

DIVIDED = "the view goes on in the next shot: it has more pictures than shots.max_frames"
Progress = Callable[[str, int, int | None], None]
PACKAGES = ("av", "kornia", "numba", "numpy", "opencv-contrib-python-headless", "scipy", "tifffile", "torch")


def _silent(stage: str, done: int, total: int | None) -> None:
    """No progress."""


@dataclass(slots=True, eq=False)
class _Job:
    """What the two passes share (internal to this module)."""

    clip: Clip
    folder: OutputFolder
    config: Config
    progress: Progress
    scratch: Path
    finished: dict[int, tuple[ShotRecord, CameraTable]]
    timings: Timings = field(default_factory=Timings)
    facts: dict[int, FrameFacts] = field(default_factory=dict)
    records: list[ShotRecord] = field(default_factory=list)
    tables: list[CameraTable] = field(default_factory=list)
    thumbnails: dict[int, bytes] = field(default_factory=dict)
    images: dict[int, KeyframeImages] = field(default_factory=dict)
    overlays: OverlayFinder | None = None
    people: People | None = None
    mask: NDArray[np.bool_] | None = None
    n_levels: int = 4
    second: Iterator[Frame] | None = None
    graphics: dict[int, str] = field(default_factory=dict)  # frames of gradual edits: what they are
    shelf: ShotShelf | None = None  # of solved shots, where they may be merged
    merging: dict[str, Any] = field(default_factory=dict)

    def second_frames(self) -> Iterator[Frame]:
        """The second decoding, going on where the shot before ended."""
        if self.second is None:
            self.second = _selected(self.clip, self.config)
        return self.second


def process(
    clip: Path,
    out: Path,
    config: Config | None = None,
    progress: Progress | None = None,
    resume: bool = False,
) -> RunRecord:
    """Run everything on one clip and write OUT (README: what a run writes).

    Returns the record that run.json holds. Raises InputError, ConfigError, OutputError for a user's mistakes; earlier
    outputs in OUT stay whole until the new ones are.
    """
    config = config or Config()
    started = time.perf_counter()
    # Its calls are short: a pool of its own spends a tenth of a run's processor time on waiting for the next one.
    cv2.setNumThreads(1)
    with (
        threadpool_limits(1, user_api="blas"),  # its matrices are small, and our own threads use the cores
        open_clip(clip, config.decode) as opened,
        OutputFolder(out, run_digest(config, opened.facts.identity()), resume=resume) as folder,
        tempfile.TemporaryDirectory(prefix=".scratch-", dir=folder.staging) as scratch,
    ):
        refuse_tiny(opened.facts.path, opened.facts.size_px)
        finished = {record.index: (record, rows) for record, rows in folder.finished_shots()}
        if finished and config.shots.merge:
            # Files of an interrupted run do not hold what merging needs: keyframes, pairs, pictures.
            log.warning("--resume: shots are solved again, because merging needs more of them than was kept")
            finished = {}
        job = _Job(
            clip=opened,
            folder=folder,
            config=config,
            progress=progress or _silent,
            scratch=Path(scratch),
            finished=finished,
            n_levels=config.registration.levels + (1 if opened.facts.size_px[0] > 1600 else 0),
        )
        if config.overlays.enabled:
            job.overlays = OverlayFinder(opened.facts.size_px, config.overlays)
        job.people = open_people(config.people, opened.facts.size_px, config.run.threads or 2)
        if config.shots.merge:
            job.shelf = ShotShelf(job.scratch)
        try:
            _first_pass(job)
            if job.shelf is not None:
                with job.timings.measure("merge"):
                    job.merging = merge_shots(
                        job.shelf, job.records, job.tables, config=config, folder=folder, scratch=job.scratch,
                        progress=job.progress,
                    )  # fmt: skip
        finally:
            _close(job)
        table = _whole_table(job)
        folder.write_camera(table, parquet=config.output.parquet)
        job.timings.seconds["total"] = time.perf_counter() - started
        record = _record(job, opened)
        export_for_run(record, table, config.output.exports, folder.staging)
        with job.timings.measure("report"):
            write_report(folder.staging, record, table, job.thumbnails)
        folder.publish(record)
    return record


def _selected(clip: Clip, config: Config) -> Iterator[Frame]:
    """The configured range of pictures."""
    stop = None if config.run.max_frames is None else config.run.start_frame + config.run.max_frames
    return itertools.islice(iter(clip), config.run.start_frame, stop)


def _first_pass(job: _Job) -> None:
    """Decode, register, split into shots; each finished shot is solved and written at once."""
    config, size_px = job.config, job.clip.facts.size_px
    register = RegisterOptions(kernel=config.registration.kernel)

    def new_tracker() -> ShotTracker:
        priors = priors_of(config, job.clip.facts.pixel_aspect)
        tracker = ShotTracker(size_px, config.registration, priors, register_options=register)
        tracker.images = KeyframeImages(job.scratch, glances=config.panorama.enabled)
        job.images[id(tracker)] = tracker.images
        return tracker

    splitter = ShotSplitter(
        new_tracker, config.shots.bridge_frames, max_frames=config.shots.max_frames, graphics=job.graphics
    )
    frames = _selected(job.clip, config)
    expected = job.clip.facts.n_frames_header if config.run.max_frames is None else config.run.max_frames
    count = 0

    def follow(frame: Frame, look: Future[PreparedFrame]) -> None:
        with job.timings.measure("register"):
            done = list(splitter.push(look.result()))
        if watch is not None:
            with job.timings.measure("overlays"):
                job.mask = watch.push(count, frame.gray, splitter.last_motion_px, job.mask)
                if done:
                    watch.settle()
        for shot in done:
            _finish(job, shot)
        job.progress("first pass", count, expected)

    with ThreadPoolExecutor(1) as preparing, ThreadPoolExecutor(1) as watching:
        watch = OverlayWatch(job.overlays, watching) if job.overlays is not None else None
        ahead: tuple[Frame, Future[PreparedFrame]] | None = None
        while True:
            with job.timings.measure("decode"):
                frame = next(frames, None)
            # Just one frame ahead: which mask a frame is prepared with must not depend on how fast threads are.
            prepared = None
            if frame is not None:
                _note(job, frame)
                own = splitter.screen_mask(frame.index - 2) if job.overlays is not None else None
                prepared = frame, preparing.submit(_prepared, job, frame, both_masks(job.mask, own))
            if ahead is not None:
                count += 1
                follow(*ahead)
            if prepared is None:
                break
            ahead = prepared
        if watch is not None:
            watch.settle()
    if count == 0:
        raise InputError(job.clip.facts.path, "no picture in the chosen range", "lower run.start_frame")
    for shot in splitter.finish():
        _finish(job, shot)


def _prepared(job: _Job, frame: Frame, mask: NDArray[np.bool_] | None) -> PreparedFrame:
    """A frame as registration wants it. mask (h, w): True = usable, as far as the screen is concerned."""
    return prepare_frame(
        frame.index, frame.pts_s, frame.gray, selection=selection_of(job.config.registration), n_levels=job.n_levels,
        mask=mask, scene=None if job.people is None else job.people.scene(frame),
    )  # fmt: skip


def _note(job: _Job, frame: Frame) -> None:
    job.facts[frame.index] = FrameFacts(
        frame=frame.index,
        pts_s=frame.pts_s,
        timecode=frame.timecode,
        source_frame=frame.source_frame,
        field=frame.field,
        status="ok",
        reason="",
    )


def _finish(job: _Job, tracked: TrackedShot) -> None:
    """Solve and write one shot, or say that it is too short to be one."""
    tracker = tracked.tracker
    images = tracker.images
    assert images is not None
    if len(tracker.observations) < job.config.shots.min_frames:
        images.close()
        job.images.pop(id(tracker), None)
        return  # its frames belong to no shot; _whole_table says so
    index = len(job.records)
    facts = {
        o.frame: FrameFacts(
            frame=o.frame,
            pts_s=o.pts_s,
            timecode=job.facts[o.frame].timecode,
            source_frame=job.facts[o.frame].source_frame,
            field=job.facts[o.frame].field,
            status=o.status,
            reason=o.reason,
        )
        for o in tracker.observations
    }
    first, last = tracker.observations[0].frame, tracker.observations[-1].frame
    known = job.finished.get(index)
    if known is not None and (known[0].first_frame, known[0].last_frame) == (first, last):
        record, rows = known
        log.info("shot %d kept from the interrupted run", index)
    else:
        mask = job.overlays.mask() if job.overlays is not None else None
        solved = solve_shot(
            tracker, facts, index, job.second_frames, images=images, mask=mask, n_levels=job.n_levels,
            config=job.config, scratch=job.scratch, progress=job.progress, keep_frames=job.shelf is not None,
            people=job.people,
        )  # fmt: skip
        with solved.timings.measure("write"):
            record = write_shot(job.folder, index, tracker, solved, job.config)
            if tracked.end == "length":
                record = replace(record, warnings=(*record.warnings, DIVIDED))
        rows = solved.rows
        for stage, seconds in solved.timings.seconds.items():
            job.timings.seconds[stage] = job.timings.seconds.get(stage, 0.0) + seconds
        job.folder.save_shot(record, rows)
        if job.shelf is not None and not solved.refused:
            own = [facts[o.frame] for o in tracker.observations]
            job.shelf.put(index, tracker, solved, own, images, mask, job.n_levels)
    if job.people is not None:
        job.people.forget(last)
    job.thumbnails |= thumbnails(tracker)
    if job.shelf is None or index not in job.shelf.indices:
        images.close()
    job.images.pop(id(tracker), None)
    job.records.append(record)
    job.tables.append(rows)


def _whole_table(job: _Job) -> CameraTable:
    """All pictures of the clip, those outside every shot as 'graphic' or 'lost' with a reason."""
    seen = {int(f) for table in job.tables for f in table.frame}
    left = [job.facts[f] for f in sorted(job.facts) if f not in seen]
    tables = list(job.tables)
    for reason in sorted(set(job.graphics.values())):
        mixed = [facts for facts in left if job.graphics.get(facts.frame) == reason]
        tables.append(blank_rows(mixed, -1, "graphic", reason))
    left = [facts for facts in left if facts.frame not in job.graphics]
    if left:
        tables.append(lost_rows(left, "between_shots"))
    return concatenate(tables)


def _record(job: _Job, clip: Clip) -> RunRecord:
    levelled = [r for r in job.records if r.calibration.get("level", {}).get("observable")]
    if not job.records:
        world = "none"
    elif len(levelled) == len(job.records):
        world = "levelled head frame of each shot"
    elif levelled:
        world = "levelled head frame where calibration.level says observable, else the reference camera"
    else:
        world = "reference camera of each shot"
    if any(r.merged_into is not None for r in job.records):
        world += "; a merged shot's is that of the shot it is merged into"
    versions = {"broadcast-mosaic": program_version(), "python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    extra: dict[str, Any] = {"overlays": job.overlays.facts()} if job.overlays is not None else {}
    if job.people is not None:
        extra["people"] = job.people.facts()
    if job.merging:
        extra["merging"] = job.merging
    return RunRecord(
        versions=versions,
        config=job.config.as_dict(),
        clip={**clip.facts.as_dict(), "identity": clip.facts.identity(), "n_frames_decoded": len(job.facts)},
        shots=tuple(job.records),
        timings_s=dict(job.timings.seconds),
        world=world,
        warnings=tuple(clip.facts.warnings),
        complete=all(r.status != "failed" for r in job.records) and bool(job.records),
        extra=extra,
    )


def _close(job: _Job) -> None:
    """Let go of what trackers left open that nobody solved."""
    for images in job.images.values():
        images.close()
    job.images.clear()
    if job.shelf is not None:
        job.shelf.close()
