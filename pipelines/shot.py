"""One shot from its first pass to its rows: keyframes refined, frames registered again, poses, verdict, panorama.

The order of the second half of the main job. What each step computes lives in its own module.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.gates import GateOptions, judge
from calib.level import level
from calib.records import Level, Priors, Solution, Verdict
from mosaic.composite import Panorama
from mosaic.framestore import FrameStore
from mosaic.records import MotionGraph, PairFit
from pipelines.bridge import CameraPlacement, rolling_of
from pipelines.camera_track import frame_poses, frame_steps, placements_of, repeated_from
from pipelines.config import Config
from pipelines.decode import Frame
from pipelines.film import chosen, filmed
from pipelines.keyframe_graph import KeyframeImages, KeyframeResult
from pipelines.links import contradicted_frames, without_doubtful
from pipelines.moments import Trail
from pipelines.moving import MovingFinder
from pipelines.overlays import both_masks
from pipelines.panorama import PanoramaPlan, compose, glances_of, moments_of, plan_panorama
from pipelines.people import People
from pipelines.records import CameraTable
from pipelines.retracking import Retracker
from pipelines.rotation_fit import LEAST_PIECE, RotationFit, largest_piece, refuse, rotation_fit
from pipelines.second_pass import second_pass
from pipelines.shot_keyframes import solve_keyframes
from pipelines.stopwatch import Timings
from pipelines.table import FrameFacts, blank_rows, shot_rows
from pipelines.tracking import ShotTracker

LEVEL_SIGMA = 0.3  # relative focal error above which the pan axis is not believed
LEVEL_NEEDS_FOCAL = "The pan axis needs a focal length, and that is not known well enough."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibratedShot:
    """A shot with its cameras: everything that rows, panorama, files and the shot's record are made from."""

    solution: Solution
    verdict: Verdict
    level: Level
    keyframes: KeyframeResult
    graph: MotionGraph
    rows: CameraTable
    panorama: Panorama | None
    no_panorama: str
    timings: Timings
    fits: tuple[PairFit, ...] = ()  # that the poses were solved from, with
    steps: tuple[PairFit, ...] = ()  # frame-to-frame pairs that are not among them
    store: FrameStore | None = None  # the panorama's frames, open, where they were asked for
    trail: Trail | None = None  # the panorama with players, where asked for
    explained: RotationFit | None = None  # by a camera that turns and zooms; None: of shots merged into one
    film: Mapping[int, bytes] = field(default_factory=dict)  # small colour JPEGs of some frames

    @property
    def refused(self) -> bool:
        """Whether no camera is claimed for any frame, because none explains the pictures."""
        return self.explained is not None and self.explained.refused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """A shot as the first pass hands it over, and what the run gives to it (internal to this module).

    facts: of its observations, in their order. See solve_shot for the rest."""

    tracker: ShotTracker
    facts: Sequence[FrameFacts]
    shot: int
    mask: NDArray[np.bool_] | None
    n_levels: int
    config: Config
    scratch: Path
    progress: Callable[[str, int, int | None], None]
    people: People | None


def solve_shot(
    tracker: ShotTracker,
    facts: Mapping[int, FrameFacts],
    shot: int,
    frames: Callable[[], Iterator[Frame]],
    *,
    images: KeyframeImages,
    mask: NDArray[np.bool_] | None,
    n_levels: int,
    config: Config,
    scratch: Path,
    progress: Callable[[str, int, int | None], None],
    keep_frames: bool = False,
    people: People | None = None,
) -> CalibratedShot:
    """Second half of the job for one shot. keep_frames: leave the panorama's frames open; the caller closes them.

    facts: per frame number. frames: starts (or goes on with) a second decoding of the clip that will reach the shot's
    frames. mask: usable pixels, as known at the shot's end. people: where somebody knows them. Raises only on mistakes;
    bad footage is a verdict.
    """
    timings = Timings()
    job = _Job(
        tracker=tracker, facts=[facts[o.frame] for o in tracker.observations], shot=shot, mask=mask,
        n_levels=n_levels, config=config, scratch=scratch, progress=progress, people=people,
    )  # fmt: skip
    # A quarter of a run in which no frame goes by: without a line of its own the program would seem to hang.
    progress("calibration", 0, None)
    with timings.measure("keyframes"):
        keyframes, start = solve_keyframes(tracker, images, mask=mask, n_levels=n_levels, config=config)
        pupil_shift = keyframes.pupil.shift_log_f if keyframes.pupil is not None else 0.0
        verdict = judge(
            keyframes.solution, keyframes.graph, GateOptions(refine=keyframes.options),
            pupil_shift_log_f=pupil_shift,
        )  # fmt: skip
        head = believed_level(level(keyframes.solution), verdict)
    with timings.measure("poses"):
        track = frame_poses(
            tracker, keyframes, tracker.fits, start=start, error_bars=not config.panorama.enabled
        )
        explained = rotation_fit(keyframes, track, frame_steps(tracker))
    progress("calibration", 1, 1)
    first = CalibratedShot(
        solution=track, verdict=verdict, level=head, keyframes=keyframes, graph=_graph(tracker, tracker.fits),
        rows=blank_rows(job.facts, shot, "lost", ""), panorama=None, no_panorama="", timings=timings,
        fits=tuple(tracker.fits), explained=explained,
    )  # fmt: skip
    if first.refused:
        return _without_cameras(job, first)
    if not config.panorama.enabled:
        return _without_panorama(job, first, "switched off")
    # Where frames lie relative to each other: the axes of the reference will do.
    placed = placements_of(track, np.eye(3), tracker.observations, tracker.size_px, keyframes)
    piece = largest_piece(placed)
    if not piece or len(piece) < LEAST_PIECE * np.isfinite(track.log_f).sum():
        why = "the pictures do not hang together" if piece else "no frame has a camera"
        full = frame_poses(tracker, keyframes, tracker.fits, start=track)
        return _without_panorama(job, replace(first, solution=full), why)
    return _with_panorama(job, first, placed, piece, frames, keep_frames)


def _without_cameras(job: _Job, shot: CalibratedShot) -> CalibratedShot:
    """A shot that no turning, zooming camera explains: its pairs are kept, no camera is claimed."""
    verdict = refuse(shot.verdict)
    return replace(
        shot, verdict=verdict, level=_unknown_level(shot.level),
        rows=blank_rows(job.facts, job.shot, "lost", verdict.reason),
        no_panorama="no camera that turns and zooms explains the pictures",
    )  # fmt: skip


def _without_panorama(job: _Job, shot: CalibratedShot, why: str) -> CalibratedShot:
    """A shot's cameras by the first pass' pairs."""
    tracker = job.tracker
    keyed = [f for f in tracker.fits if f.src in tracker.keyframes]
    solution, doubtful = without_doubtful(
        shot.solution, [*shot.keyframes.fits, *keyed], repeated_from(tracker.observations)
    )
    rows = shot_rows(
        shot=job.shot, facts=job.facts, solution=solution, verdict=shot.verdict, level=shot.level,
        fits=tracker.fits, doubtful=doubtful,
    )  # fmt: skip
    return replace(shot, solution=solution, rows=rows, no_panorama=why)


def _with_panorama(
    job: _Job,
    first: CalibratedShot,
    placed: Sequence[CameraPlacement],
    piece: set[int],
    frames: Callable[[], Iterator[Frame]],
    keep_frames: bool,
) -> CalibratedShot:
    """A shot's cameras and panorama by a second pass over its frames.

    first: as the first pass left it. placed: its frames in the reference's axes; piece: those that hang together.
    """
    tracker, keyframes, timings, head = job.tracker, first.keyframes, first.timings, first.level
    world = head.R_head_world if head.observable else np.eye(3)
    with timings.measure("plan"):
        placements = placements_of(first.solution, world, tracker.observations, tracker.size_px, keyframes)
        plan = _planned(job, [p for p in placements if p.frame in piece])
    if not plan.views.frames:
        size = f"{plan.surface.width} x {plan.surface.height}"
        full = frame_poses(tracker, keyframes, tracker.fits, start=first.solution)
        return _without_panorama(job, replace(first, solution=full), f"too small, {size} px")
    store = FrameStore(job.scratch, tracker.size_px)
    kept = False
    film: dict[int, bytes] = {}
    try:
        with timings.measure("second pass"):
            seen = filmed(frames(), chosen([o.frame for o in tracker.observations]), film)
            fits = _registered_again(job, first, placed, plan, seen, store)
        steps = frame_steps(tracker)
        with timings.measure("poses"):
            solution = frame_poses(tracker, keyframes, [*fits, *steps], start=first.solution)
            explained = rotation_fit(keyframes, solution, steps)
            if explained.refused:
                again = replace(
                    first, solution=solution, explained=explained, graph=_graph(tracker, fits), fits=tuple(fits),
                    film=film,
                )  # fmt: skip
                return _without_cameras(job, again)
            solution, doubtful = without_doubtful(
                solution, [*keyframes.fits, *fits], repeated_from(tracker.observations)
            )
        with timings.measure("composite"):
            panorama, players = _composed(job, solution, keyframes, world, plan, store)
        kept = keep_frames and panorama is not None
    finally:
        if not kept:
            store.close()
    rows = shot_rows(
        shot=job.shot, facts=job.facts, solution=solution, verdict=first.verdict, level=head, fits=fits,
        doubtful=doubtful,
    )  # fmt: skip
    return replace(
        first, solution=solution, graph=_graph(tracker, [*keyframes.fits, *fits]), rows=rows, panorama=panorama,
        no_panorama="" if panorama is not None else "no frame fits its camera", fits=tuple(fits),
        steps=tuple(steps), store=store if kept else None, explained=explained, trail=players, film=film,
    )  # fmt: skip


def _planned(job: _Job, placements: Sequence[CameraPlacement]) -> PanoramaPlan:
    """The panorama of these placements, by what the first pass' small pictures show."""
    images, tracker = job.tracker.images, job.tracker
    if images is None:
        return plan_panorama(placements, job.config)

    def mask(frame: int) -> NDArray[np.bool_] | None:
        return both_masks(job.mask, tracker.scene_mask(frame))

    glances = glances_of(images, {p.frame for p in placements}, mask, job.scratch)
    try:
        return plan_panorama(placements, job.config, glances=glances)
    finally:
        if glances is not None:
            glances.close()


def _registered_again(
    job: _Job,
    first: CalibratedShot,
    placed: Sequence[CameraPlacement],
    plan: PanoramaPlan,
    frames: Iterator[Frame],
    store: FrameStore,
) -> list[PairFit]:
    """Every frame against the refined keyframes; the plan's pictures, and what moves in them, go to the store."""
    tracker, planned = job.tracker, set(plan.views.frames)
    rolling = rolling_of(first.keyframes.readout_share, first.solution)
    return second_pass(
        frames,
        Retracker(
            tracker, first.solution, job.config.registration, tracker.register_options, rolling=rolling
        ),
        MovingFinder({p.frame: p for p in placed}, planned, store, tracker.scene_mask),
        store,
        planned=planned, mask=job.mask, stays=tracker.scene_mask, people=job.people, n_levels=job.n_levels,
        threads=job.config.run.threads or 2, progress=job.progress,
    )  # fmt: skip


def _composed(
    job: _Job,
    solution: Solution,
    keyframes: KeyframeResult,
    world: NDArray[np.float64],
    plan: PanoramaPlan,
    store: FrameStore,
) -> tuple[Panorama | None, Trail | None]:
    """The panorama of the frames that fit their cameras, and with players where asked; None where no stored one does.

    world (3, 3): axes of the panorama from those of the solution."""
    tracker = job.tracker
    fitting = replace(solution, log_f=np.where(contradicted_frames(solution), np.nan, solution.log_f))
    placements = placements_of(fitting, world, tracker.observations, tracker.size_px, keyframes)
    together = largest_piece(placements)
    placements = [p for p in placements if p.frame in together]
    if not any(p.frame in store for p in placements):
        return None, None

    def told(share: float) -> None:
        job.progress("composite", round(share * 100), 100)

    panorama = compose(plan, store, placements, job.config, job.scratch, told)
    return panorama, moments_of(panorama, store, plan, job.config, job.scratch)


def believed_level(head: Level, verdict: Verdict) -> Level:
    """The pan axis, if the focal is known: an axis found with a focal that is not known is as wrong as that focal."""
    if verdict.sigma_log_f_total < LEVEL_SIGMA:
        return head
    return _unknown_level(head)


def _unknown_level(head: Level) -> Level:
    return replace(head, observable=False, reason="focal_unknown", sentence=LEVEL_NEEDS_FOCAL)


def priors_of(config: Config, pixel_aspect: float) -> Priors:
    """calib's priors from what the user and the file know; a known focal comes in with the keyframes (shot_keyframes).

    pixel_aspect: width over height of a pixel; K counts in stored pixels, so fx / fy is its inverse.
    """
    o = config.calibration
    return Priors(
        aspect=1.0 / pixel_aspect,
        c0_std=0.05 if o.distortion else 1e-6,
        pp_std_x=1e-6 if o.fix_pp else Priors().pp_std_x,
        pp_std_y=1e-6 if o.fix_pp else Priors().pp_std_y,
    )


def _graph(tracker: ShotTracker, fits: Sequence[PairFit]) -> MotionGraph:
    return MotionGraph(
        frames=np.array([o.frame for o in tracker.observations], np.int64),
        fits=tuple(fits),
        size_px=tracker.size_px,
    )


def lost_rows(facts: Sequence[FrameFacts], reason: str) -> CameraTable:
    """Rows of frames that belong to no shot."""
    return blank_rows(facts, -1, "lost", reason)
