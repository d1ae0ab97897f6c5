"""One shot from its first pass to its rows: keyframes refined, frames registered again, poses, verdict, panorama.

The order of the second half of the main job. What each step computes lives in its own module.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.gates import GateOptions, judge
from calib.level import level
from calib.poses import PoseOptions, solve_poses
from calib.records import KnownFocal, Level, Priors, Solution, Verdict
from calib.refine import RefineOptions, refine
from mosaic.composite import Panorama, composite
from mosaic.cropping import crop_inside
from mosaic.framestore import FrameStore
from mosaic.records import MotionGraph, PairFit
from mosaic.surface import Surface, choose_surface
from mosaic.views import CompositeOptions, ViewPlan, plan_views
from pipelines.bridge import CameraPlacement, CameraPose, Rolling, homography_graph, rolling_of
from pipelines.config import Config
from pipelines.decode import Frame
from pipelines.film import chosen, filmed
from pipelines.keyframe_graph import (
    KeyframeImages,
    KeyframeOptions,
    KeyframeResult,
    refine_keyframes,
    register_pairs,
)
from pipelines.links import contradicted_frames, without_doubtful
from pipelines.moments import Trail, choose_moments, trail
from pipelines.moving import MovingFinder
from pipelines.pupil import with_pupil
from pipelines.readout import with_readout, without_readout
from pipelines.records import CameraTable
from pipelines.retracking import Retracker
from pipelines.rotation_fit import LEAST_PIECE, RotationFit, largest_piece, refuse, rotation_fit
from pipelines.second_pass import second_pass
from pipelines.table import FrameFacts, blank_rows, concatenate, shot_rows
from pipelines.tracking import Observation, ShotTracker
from pipelines.verified_part import part_to_solve_alone

log = logging.getLogger(__name__)

MAX_PLACEMENTS_FOR_SURFACE = 400
LEVEL_SIGMA = 0.3  # relative focal error above which the pan axis is not believed
LEVEL_NEEDS_FOCAL = "The pan axis needs a focal length, and that is not known well enough."


@dataclass(slots=True)
class Timings:
    """Seconds per stage, added up."""

    seconds: dict[str, float] = field(default_factory=dict)

    def measure(self, stage: str) -> _Stopwatch:
        """`with timings.measure('stage'):` adds the elapsed wall time."""
        return _Stopwatch(self, stage)


@dataclass(slots=True)
class _Stopwatch:
    timings: Timings
    stage: str
    started: float = 0.0

    def __enter__(self) -> None:
        self.started = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        elapsed = time.perf_counter() - self.started
        self.timings.seconds[self.stage] = self.timings.seconds.get(self.stage, 0.0) + elapsed


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
) -> CalibratedShot:
    """Second half of the job for one shot. keep_frames: leave the panorama's frames open; the caller closes them.

    facts: per frame number. frames: starts (or goes on with) a second decoding of the clip that will reach the shot's
    frames. mask: usable pixels, as known at the shot's end. Raises only on mistakes; bad footage is a verdict.
    """
    timings = Timings()
    priors, refine_options = tracker.priors, refine_options_of(config)
    # A quarter of a run in which no frame goes by: without a line of its own the program would seem to hang.
    progress("calibration", 0, None)
    with timings.measure("keyframes"):
        templates = {k: key.template for k, key in tracker.keyframes.items()}
        options_k = KeyframeOptions(
            refine=refine_options, register=tracker.register_options, threads=config.run.threads or 2
        )

        def refined(chosen: Iterable[int], running: Solution | None) -> KeyframeResult:
            own = {k: templates[k] for k in chosen}
            return refine_keyframes(
                own,
                images,
                [f for f in tracker.fits if f.src in own and f.dst in own],
                size_px=tracker.size_px,
                n_levels=n_levels,
                mask=mask,
                priors=priors,
                options=options_k,
                running=running,
            )

        result = refined(templates, tracker.calibrator.solution if tracker.trusts_camera else None)
        alone = part_to_solve_alone(
            [o.frame for o in tracker.observations if o.status == "ok"],
            templates,
            [*result.fits, *(f for f in tracker.fits if f.src in tracker.keyframes)],
            result.solution.reference,
        )
        if alone is not None:
            result = refined(sorted(alone), None)
        result = _with_central_reference(result, priors)

        def register(solved: Solution, rolling: Rolling | None = None) -> list[PairFit]:
            return register_pairs(templates, images, solved, n_levels, mask, options_k, rolling)

        result = with_pupil(result, register)

        track: Solution | None = None

        def poses(found: KeyframeResult, start: Solution | None) -> Solution:
            nonlocal track
            track = frame_poses(tracker, found, tracker.fits, start=start, error_bars=False)
            return track

        result = with_readout(result, tracker.fits, register, poses)
        scaled = _with_known_focal(result, tracker, config, priors)
        if scaled is not result:  # other focals, other turns
            result, track = scaled, None
        shift = result.pupil.shift_log_f if result.pupil is not None else 0.0
        verdict = judge(
            result.solution, result.graph, GateOptions(refine=result.options), pupil_shift_log_f=shift
        )
        head = believed_level(level(result.solution), verdict)
    shot_facts = [facts[o.frame] for o in tracker.observations]

    def refused(track: Solution, explained: RotationFit, fits: Sequence[PairFit]) -> CalibratedShot:
        turned_down = refuse(verdict)
        return CalibratedShot(
            solution=track, verdict=turned_down, level=_unknown_level(head), keyframes=result,
            graph=_graph(tracker, fits), rows=blank_rows(shot_facts, shot, "lost", turned_down.reason),
            panorama=None, no_panorama="no camera that turns and zooms explains the pictures", timings=timings,
            fits=tuple(fits), explained=explained,
        )  # fmt: skip

    steps = frame_steps(tracker)
    with timings.measure("poses"):
        approximate = frame_poses(
            tracker, result, tracker.fits, start=track, error_bars=not config.panorama.enabled
        )
        explained = rotation_fit(result, approximate, steps)
    progress("calibration", 1, 1)
    if explained.refused:
        return refused(approximate, explained, tracker.fits)
    # Where frames lie relative to each other: the axes of the reference will do.
    placed = placements_of(approximate, np.eye(3), tracker.observations, tracker.size_px, result)
    placeable = largest_piece(placed)
    torn = len(placeable) < LEAST_PIECE * np.isfinite(approximate.log_f).sum()
    usable = config.panorama.enabled and placeable and not torn
    if not usable:
        if config.panorama.enabled:
            approximate = frame_poses(tracker, result, tracker.fits, start=approximate)
        keyed = [f for f in tracker.fits if f.src in tracker.keyframes]
        approximate, doubtful = without_doubtful(approximate, [*result.fits, *keyed])
        rows = shot_rows(
            shot=shot, facts=shot_facts, solution=approximate, verdict=verdict, level=head, fits=tracker.fits,
            doubtful=doubtful,
        )  # fmt: skip
        why = "the pictures do not hang together" if placeable else "no frame has a camera"
        if not config.panorama.enabled:
            why = "switched off"
        return CalibratedShot(
            solution=approximate, verdict=verdict, level=head, keyframes=result, graph=_graph(tracker, tracker.fits),
            rows=rows, panorama=None, no_panorama=why, timings=timings, fits=tuple(tracker.fits),
            explained=explained,
        )  # fmt: skip

    world = head.R_head_world if head.observable else np.eye(3)
    options = CompositeOptions(views=config.panorama.views)
    with timings.measure("plan"):
        placements = placements_of(approximate, world, tracker.observations, tracker.size_px, result)
        surface, plan = _plan([p for p in placements if p.frame in placeable], config, options)
    store = FrameStore(scratch, tracker.size_px)
    kept = False
    film: dict[int, bytes] = {}
    try:
        with timings.measure("second pass"):
            planned = set(plan.frames)
            fits = second_pass(
                filmed(frames(), chosen([o.frame for o in tracker.observations]), film),
                Retracker(
                    tracker, approximate, config.registration, tracker.register_options,
                    rolling=rolling_of(result.readout_share, approximate),
                ),
                MovingFinder({p.frame: p for p in placed}, planned, store, tracker.screen_mask),
                store,
                planned=planned, mask=mask, stays=tracker.screen_mask, n_levels=n_levels,
                threads=config.run.threads or 2, progress=progress,
            )  # fmt: skip
        with timings.measure("poses"):
            solution = frame_poses(tracker, result, [*fits, *steps], start=approximate)
            explained = rotation_fit(result, solution, steps)
            if explained.refused:
                return replace(refused(solution, explained, fits), film=film)
            solution, doubtful = without_doubtful(solution, [*result.fits, *fits])
        with timings.measure("composite"):
            fitting = replace(solution, log_f=np.where(contradicted_frames(solution), np.nan, solution.log_f))
            placements = placements_of(fitting, world, tracker.observations, tracker.size_px, result)
            together = largest_piece(placements)
            placements = [p for p in placements if p.frame in together]
            panorama, players = None, None
            if any(p.frame in store for p in placements):
                panorama = composite(
                    plan, store, placements, surface, options, scratch=scratch,
                    progress=lambda share: progress("composite", round(share * 100), 100),
                )  # fmt: skip
                if config.panorama.crop == "inside":
                    panorama = crop_inside(panorama)
                players = _trail_of(panorama, store, plan, config, scratch)
        kept = keep_frames and panorama is not None
    finally:
        if not kept:
            store.close()
    rows = shot_rows(
        shot=shot,
        facts=shot_facts,
        solution=solution,
        verdict=verdict,
        level=head,
        fits=fits,
        doubtful=doubtful,
    )
    return CalibratedShot(
        solution=solution, verdict=verdict, level=head, keyframes=result, graph=_graph(tracker, [*result.fits, *fits]),
        rows=rows, panorama=panorama, no_panorama="" if panorama is not None else "no frame fits its camera",
        timings=timings, fits=tuple(fits), steps=tuple(steps), store=store if kept else None,
        explained=explained, trail=players, film=film,
    )  # fmt: skip


def _trail_of(
    panorama: Panorama, store: FrameStore, plan: ViewPlan, config: Config, scratch: Path
) -> Trail | None:
    """The panorama with the players of the moments that the configuration asks for; None: it asks for none here."""
    options = config.panorama
    stored = [k for k in plan.frames if k in store and k in panorama.placements]
    wanted = [k for k in options.moment_frames if stored and stored[0] <= k <= stored[-1]]
    if options.moment_frames and not wanted:
        return None  # of another shot
    if not (wanted or options.moments):
        return None
    return trail(panorama, store, choose_moments(stored, options.moments, wanted), str(scratch))


def believed_level(head: Level, verdict: Verdict) -> Level:
    """The pan axis, if the focal is known: an axis found with a focal that is not known is as wrong as that focal."""
    if verdict.sigma_log_f_total < LEVEL_SIGMA:
        return head
    return _unknown_level(head)


def _unknown_level(head: Level) -> Level:
    return replace(head, observable=False, reason="focal_unknown", sentence=LEVEL_NEEDS_FOCAL)


def priors_of(config: Config, pixel_aspect: float) -> Priors:
    """calib's priors from what the user and the file know; a known focal comes in by `_with_known_focal`.

    pixel_aspect: width over height of a pixel; K counts in stored pixels, so fx / fy is its inverse.
    """
    o = config.calibration
    return Priors(
        aspect=1.0 / pixel_aspect,
        c0_std=0.05 if o.distortion else 1e-6,
        pp_std_x=1e-6 if o.fix_pp else Priors().pp_std_x,
        pp_std_y=1e-6 if o.fix_pp else Priors().pp_std_y,
    )


def refine_options_of(config: Config) -> RefineOptions:
    """calib's refinement options from the configuration."""
    return RefineOptions(distortion=config.calibration.distortion, free_pp=not config.calibration.fix_pp)


def placements_of(
    solution: Solution,
    R_surface_world: NDArray[np.float64],
    observations: Sequence[Observation],
    size_px: tuple[int, int],
    keyframes: KeyframeResult,
) -> list[CameraPlacement]:
    """Placements of all solved frames, in the panorama's axes; half a frame's motion counts as blur.

    keyframes: the pupil and the rolling shutter that were found with them belong to every frame.
    """
    parallax = keyframes.parallax
    turned = None if parallax is None else parallax.of_axes(R_surface_world)
    motion = {o.frame: o.motion_px for o in observations}
    rolling = rolling_of(keyframes.readout_share, solution)
    rates = {} if rolling is None else rolling.rates
    return [
        CameraPlacement(
            frame=int(frame),
            size_px=size_px,
            lens=solution.lens,
            pose=CameraPose(log_f=float(log_f), R=R @ R_surface_world.T),
            blur_px=float(np.nan_to_num(motion.get(int(frame), 0.0), nan=0.0)) * 0.5,
            parallax=turned,
            share=0.0 if rolling is None else rolling.share,
            rate=rates.get(int(frame)),
        )
        for frame, log_f, R in zip(solution.frames, solution.log_f, solution.R, strict=True)
        if np.isfinite(log_f) and int(frame) in motion
    ]


def _with_central_reference(result: KeyframeResult, priors: Priors) -> KeyframeResult:
    """The same keyframes in the axes of the one nearest to the middle of the motion.

    A planar panorama about the end of a pan is all foreshortening, and homographies to it are long.
    """
    solution = result.solution
    known = np.flatnonzero(np.isfinite(solution.log_f))
    if len(known) < 2:
        return result
    axes = solution.R[known, 2, :]
    middle = axes.mean(axis=0)
    central = int(solution.frames[known[int(np.argmax(axes @ middle))]])
    if central == solution.reference:
        return result
    refined = refine(
        result.graph,
        start=solution.with_reference(central),
        priors=priors,
        options=replace(result.options, reference=central),
    )
    return replace(result, solution=refined) if np.isfinite(refined.log_f).any() else result


def _with_known_focal(
    result: KeyframeResult, tracker: ShotTracker, config: Config, priors: Priors
) -> KeyframeResult:
    """The keyframes refined again with the user's focal, when there is one and it belongs to this shot.

    The focal of an ordinary frame is carried to its nearest keyframe by the measured zoom ratio (good to .1 %).
    """
    known = config.calibration
    frames = [o.frame for o in tracker.observations]
    if known.focal_px is None or not np.isfinite(result.solution.log_f).any():
        return result
    frame = result.solution.reference if known.focal_frame is None else known.focal_frame
    if frame not in frames:
        return result
    track = frame_poses(tracker, result, tracker.fits)
    row = np.flatnonzero(track.frames == frame)
    if not len(row) or not np.isfinite(track.log_f[row[0]]):
        return result
    solved = result.solution.frames[np.isfinite(result.solution.log_f)]
    keyframe = int(solved[np.argmin(np.abs(solved - frame))])
    zoom = float(np.exp(result.solution.log_f[result.solution.index(keyframe)] - track.log_f[row[0]]))
    std_px = known.focal_std_px or 0.02 * known.focal_px
    with_focal = replace(
        priors, known_focals=(KnownFocal(frame=keyframe, f_px=known.focal_px * zoom, std_px=std_px * zoom),)
    )
    refined = refine(
        result.graph,
        start=result.solution,
        priors=with_focal,
        options=replace(result.options, reference=result.solution.reference),
    )
    return replace(result, solution=refined) if np.isfinite(refined.log_f).any() else result


def frame_poses(
    tracker: ShotTracker,
    result: KeyframeResult,
    fits: Sequence[PairFit],
    *,
    start: Solution | None = None,
    error_bars: bool = True,
) -> Solution:
    """Every frame against the held keyframes. A shot of one keyframe keeps its prior focal and is never claimed.

    start: an earlier track of the shot in the same axes, to begin from. error_bars: see calib.poses.PoseOptions.
    """
    held = result.solution
    frames = [o.frame for o in tracker.observations if o.status != "lost" and o.reason != "duplicate"]
    if not np.isfinite(held.log_f).any():
        held = _prior_only(held, tracker)
    between = [f for f in fits if not (f.src in tracker.keyframes and f.dst in tracker.keyframes)]
    graph = homography_graph(frames, between, tracker.size_px)
    bars = PoseOptions(error_bars=error_bars)
    if result.parallax is None and result.readout_share is None:
        return _with_duplicates(solve_poses(graph, held, options=bars, start=start), tracker)
    # What pupil and shutter did to a pair wants cameras only roughly: those of an earlier track will do.
    rough = start if start is not None else solve_poses(graph, held, options=PoseOptions(error_bars=False))
    solved = solve_poses(without_readout(graph, rough, result), held, options=bars, start=rough)
    return _with_duplicates(solved, tracker)


def _prior_only(solution: Solution, tracker: ShotTracker) -> Solution:
    """The first keyframe at the prior focal, as the thing that other frames are related to."""
    row = solution.index(solution.reference)
    log_f = solution.log_f.copy()
    log_f[row] = solution.priors.log_f_mean + np.log(tracker.size_px[0])
    R = solution.R.copy()
    R[row] = np.eye(3)
    return replace(solution, log_f=log_f, R=R)


def _with_duplicates(solution: Solution, tracker: ShotTracker) -> Solution:
    """Repeated pictures get the camera of the picture that they repeat."""
    order = [o.frame for o in tracker.observations]
    row = {int(f): i for i, f in enumerate(solution.frames)}
    source: list[int] = []
    kept: list[int] = []
    last: int | None = None
    for o in tracker.observations:
        if o.frame in row:
            last = row[o.frame]
        elif o.reason != "duplicate" or last is None:
            continue
        kept.append(o.frame)
        source.append(last if last is not None else row[order[0]])
    pick = np.array(source)
    return replace(
        solution,
        frames=np.array(kept),
        log_f=solution.log_f[pick],
        R=solution.R[pick],
        sigma_log_f=solution.sigma_log_f[pick],
        sigma_log_zoom=solution.sigma_log_zoom[pick],
        cov_rot=solution.cov_rot[pick],
        rms_px=solution.rms_px[pick],
    )


def frame_steps(tracker: ShotTracker) -> list[PairFit]:
    """Frame-to-frame pairs of the first pass: they keep the track smooth where the keyframe changes."""
    order = [o.frame for o in tracker.observations if o.reason != "duplicate"]
    before = dict(zip(order[1:], order[:-1], strict=True))
    return [f for f in tracker.fits if f.usable and before.get(f.dst) == f.src and f.route != "composed"]


def _plan(
    placements: Sequence[CameraPlacement], config: Config, options: CompositeOptions
) -> tuple[Surface, ViewPlan]:
    stride = max(1, len(placements) // MAX_PLACEMENTS_FOR_SURFACE)
    surface = choose_surface(
        placements[::stride], config.panorama.projection, max_pixels=config.panorama.max_megapixels * 1e6
    )
    return surface, plan_views(placements, surface, options)


def _graph(tracker: ShotTracker, fits: Sequence[PairFit]) -> MotionGraph:
    return MotionGraph(
        frames=np.array([o.frame for o in tracker.observations], np.int64),
        fits=tuple(fits),
        size_px=tracker.size_px,
    )


def lost_rows(facts: Sequence[FrameFacts], reason: str) -> CameraTable:
    """Rows of frames that belong to no shot."""
    return blank_rows(facts, -1, "lost", reason)


__all__ = [
    "CalibratedShot",
    "Timings",
    "believed_level",
    "concatenate",
    "frame_poses",
    "lost_rows",
    "placements_of",
    "priors_of",
    "refine_options_of",
    "solve_shot",
]
