"""A shot's camera track: every frame against its refined keyframes, and where that places it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.poses import PoseOptions, solve_poses
from calib.records import Solution
from mosaic.records import PairFit
from pipelines.bridge import CameraPlacement, CameraPose, homography_graph, rolling_of
from pipelines.keyframe_graph import KeyframeResult
from pipelines.readout import without_readout
from pipelines.shutter import USUAL
from pipelines.tracking import Observation, ShotTracker


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
    row = {int(f): i for i, f in enumerate(solution.frames)}
    repeats = repeated_from(tracker.observations)
    shown = {o.frame: repeats.get(o.frame, o.frame) for o in tracker.observations}
    kept = [frame for frame, first in shown.items() if first in row]
    pick = np.array([row[shown[frame]] for frame in kept], np.int64)
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


def repeated_from(observations: Iterable[Observation]) -> dict[int, int]:
    """The picture that each repeated one repeats, by number: the last one before it that was registered itself."""
    found: dict[int, int] = {}
    last: int | None = None
    for o in observations:
        if o.reason == "duplicate":
            if last is not None:
                found[o.frame] = last
        elif o.status == "ok":
            last = o.frame
    return found


def frame_steps(tracker: ShotTracker) -> list[PairFit]:
    """Frame-to-frame pairs of the first pass: they keep the track smooth where the keyframe changes."""
    order = [o.frame for o in tracker.observations if o.reason != "duplicate"]
    before = dict(zip(order[1:], order[:-1], strict=True))
    return [f for f in tracker.fits if f.usable and before.get(f.dst) == f.src and f.route != "composed"]


def placements_of(
    solution: Solution,
    R_surface_world: NDArray[np.float64],
    observations: Sequence[Observation],
    size_px: tuple[int, int],
    keyframes: KeyframeResult,
) -> list[CameraPlacement]:
    """Placements of all solved frames, in the panorama's axes; a frame's motion while the shutter is open is blur.

    keyframes: the pupil and the shutter, open and rolling, that were found with them belong to every frame.
    """
    parallax = keyframes.parallax
    turned = None if parallax is None else parallax.of_axes(R_surface_world)
    motion = {o.frame: o.motion_px for o in observations}
    rolling = rolling_of(keyframes.readout_share, solution)
    rates = {} if rolling is None else rolling.rates
    open_share = USUAL if keyframes.shutter is None else keyframes.shutter.share
    return [
        CameraPlacement(
            frame=int(frame),
            size_px=size_px,
            lens=solution.lens,
            pose=CameraPose(log_f=float(log_f), R=R @ R_surface_world.T),
            blur_px=float(np.nan_to_num(motion.get(int(frame), 0.0), nan=0.0)) * open_share,
            parallax=turned,
            share=0.0 if rolling is None else rolling.share,
            rate=rates.get(int(frame)),
        )
        for frame, log_f, R in zip(solution.frames, solution.log_f, solution.R, strict=True)
        if np.isfinite(log_f) and int(frame) in motion
    ]
