"""The keyframes of a shot when it has ended: from the first pass' pairs to focal, lens and turns that hold.

The order of the steps; what each computes lives in its own module.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.records import KnownFocal, Priors, Solution
from calib.refine import RefineOptions, refine
from mosaic.records import PairFit
from pipelines.bridge import Rolling
from pipelines.camera_track import frame_poses, frame_steps
from pipelines.config import Config
from pipelines.keyframe_graph import (
    KeyframeImages,
    KeyframeOptions,
    KeyframeResult,
    refine_keyframes,
    register_pairs,
)
from pipelines.pupil import with_pupil
from pipelines.readout import with_readout
from pipelines.shutter import find_shutter
from pipelines.tracking import ShotTracker
from pipelines.verified_part import part_to_solve_alone


def refine_options_of(config: Config) -> RefineOptions:
    """calib's refinement options from the configuration."""
    return RefineOptions(distortion=config.calibration.distortion, free_pp=not config.calibration.fix_pp)


def solve_keyframes(
    tracker: ShotTracker,
    images: KeyframeImages,
    *,
    mask: NDArray[np.bool_] | None,
    n_levels: int,
    config: Config,
) -> tuple[KeyframeResult, Solution | None]:
    """The refined keyframes, and a track of all frames to start from, where their cameras still hold it.

    mask: (h, w) usable pixels, as known at the shot's end; n_levels: of the pyramids.
    """
    templates = {k: key.template for k, key in tracker.keyframes.items()}
    options = KeyframeOptions(
        refine=refine_options_of(config), register=tracker.register_options, threads=config.run.threads or 2,
        # Between people a pair that the full model refuses is more often wrong than the model: no plainer one is tried.
        torn_share=np.inf if tracker.crowded else KeyframeOptions().torn_share, crowded=frozenset(tracker.crowded),
    )  # fmt: skip

    def refined(chosen: Iterable[int], running: Solution | None) -> KeyframeResult:
        own = {k: templates[k] for k in chosen}
        among = [f for f in tracker.fits if f.src in own and f.dst in own]
        return refine_keyframes(
            own, images, among, size_px=tracker.size_px, n_levels=n_levels, mask=mask, priors=tracker.priors,
            options=options, running=running,
        )  # fmt: skip

    def register(solved: Solution, rolling: Rolling | None = None) -> list[PairFit]:
        return register_pairs(templates, images, solved, n_levels, mask, options, rolling)

    result = refined(templates, tracker.calibrator.solution if tracker.trusts_camera else None)
    alone = part_to_solve_alone(
        [o.frame for o in tracker.observations if o.status == "ok" and o.reason != "duplicate"],
        templates,
        [*result.fits, *(f for f in tracker.fits if f.src in tracker.keyframes)],
        result.solution.reference,
    )
    if alone is not None:
        result = refined(sorted(alone), None)
    result = _with_central_reference(result, tracker.priors)
    result = with_pupil(result, register)
    tracks: list[Solution] = []  # of all frames; the rolling shutter is looked for in them, if it can be

    def track(found: KeyframeResult, start: Solution | None) -> Solution:
        tracks.append(frame_poses(tracker, found, tracker.fits, start=start, error_bars=False))
        return tracks[-1]

    result = with_readout(result, tracker.fits, register, track)
    shutter = find_shutter(
        result.fits, frame_steps(tracker), images, tracker.size_px, n_levels=n_levels, mask=mask
    )
    result = replace(result, shutter=shutter)
    scaled = _with_known_focal(result, tracker, config)
    if scaled is not result:  # other focals, other turns
        return scaled, None
    return result, tracks[-1] if tracks else None


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


def _with_known_focal(result: KeyframeResult, tracker: ShotTracker, config: Config) -> KeyframeResult:
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
        tracker.priors,
        known_focals=(KnownFocal(frame=keyframe, f_px=known.focal_px * zoom, std_px=std_px * zoom),),
    )
    refined = refine(
        result.graph,
        start=result.solution,
        priors=with_focal,
        options=replace(result.options, reference=result.solution.reference),
    )
    return replace(result, solution=refined) if np.isfinite(refined.log_f).any() else result
