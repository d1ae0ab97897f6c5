"""Shots and fixed graphics of a clip by a cheap first pass: the main job's splitter and overlay finder, less of both.

Registered at half the size where that leaves 480 px, in eight parameters; no camera is estimated and nothing is kept.
On the five clips at hand its cuts are those of the same pass with the running camera, which takes a third more time
(15 to 30 ms CPU a frame without).
"""

from __future__ import annotations

import math
from typing import Any, cast

import cv2
import numpy as np

from calib.records import Priors
from calib.running import RunningCalibrator
from mosaic.estimator import RegisterOptions
from pipelines.config import Config
from pipelines.decode import Clip
from pipelines.overlays import OverlayFinder
from pipelines.preparation import prepare_frame, refuse_tiny
from pipelines.progress import Progress, silent
from pipelines.shots import ShotSplitter, TrackedShot
from pipelines.tracking import ShotTracker, selection_of

HALF_FROM_PX = 960  # width from which half the size still has the texture to register


class _NoCamera:
    """Stands in for the tracker's running calibrator: it never trusts a camera, so that it registers without one."""

    solution = None
    sigma_log_f = math.inf

    def add_keyframe(self, frame: int, edges: object) -> None:
        """Nothing is estimated."""

    def update(self, frame: int, edges: object) -> None:
        """Nothing is estimated."""

    def pose(self, frame: int) -> None:
        """There is none."""


def look_at(
    clip: Clip, config: Config, *, seconds: float | None = 60.0, progress: Progress = silent
) -> dict[str, Any]:
    """{'shots': ..., 'overlays': ...} of the clip's first seconds (None: all of it), JSON-ready; see probe.probe.

    Raises what decoding raises, and InputError where the pictures are too small.
    """
    refuse_tiny(clip.facts.path, clip.facts.size_px)
    w, h = clip.facts.size_px
    shrink = 2 if w >= HALF_FROM_PX else 1
    size_px = ((w + shrink - 1) // shrink, (h + shrink - 1) // shrink)
    register = RegisterOptions(kernel=config.registration.kernel)

    def new_tracker() -> ShotTracker:
        tracker = ShotTracker(size_px, config.registration, Priors(), register_options=register)
        tracker.calibrator = cast(RunningCalibrator, _NoCamera())
        return tracker

    splitter = ShotSplitter(new_tracker, config.shots.bridge_frames)
    finder = OverlayFinder((w, h), config.overlays)
    cv2.setNumThreads(config.run.threads or 2)
    expected = _expected_frames(clip, seconds)
    shots: list[dict[str, Any]] = []
    first_s, n_frames, complete = math.nan, 0, True
    for frame in clip:
        if n_frames == 0:
            first_s = frame.pts_s
        elif seconds is not None and frame.pts_s - first_s >= seconds:
            complete = False
            break
        n_frames += 1
        gray = frame.gray if shrink == 1 else cv2.resize(frame.gray, size_px, interpolation=cv2.INTER_AREA)
        look = prepare_frame(frame.index, frame.pts_s, gray, selection=selection_of(config.registration))
        found = splitter.push(look)
        shots += [_shot(shot, shrink) for shot in found]
        finder.update(frame.gray, shrink * splitter.last_motion_px)
        progress("first look", n_frames, expected)
    shots += [_shot(shot, shrink, complete=complete) for shot in splitter.finish()]
    long_enough = [shot for shot in shots if shot["n_frames"] >= config.shots.min_frames]
    facts = finder.facts()
    return {
        "shots": {
            "estimated": True,
            "reason": "",
            "seconds": None if seconds is None else float(seconds),
            "complete": complete,
            "n_frames": n_frames,
            "n_frames_in_no_shot": n_frames - sum(shot["n_frames"] for shot in long_enough),
            "list": long_enough,
        },
        "overlays": {
            "estimated": config.overlays.enabled and facts["reason"] == "",
            "reason": facts["reason"] if config.overlays.enabled else "switched_off",
            "samples": facts["samples"],
            "graphics": facts["graphics"],
            "bars": facts["bars"],
            "masked_share": facts["masked_share"],
        },
    }


def _expected_frames(clip: Clip, seconds: float | None) -> int | None:
    """For the progress bar, by the header: None when it does not say."""
    total, fps = clip.facts.n_frames_header, clip.facts.picture_fps
    if seconds is None or not math.isfinite(fps):
        return total
    asked = math.ceil(seconds * fps)
    return asked if total is None else min(asked, total)


def _shot(tracked: TrackedShot, shrink: int, *, complete: bool = True) -> dict[str, Any]:
    """ended_by: 'cut', 'fade', 'transition', 'lost' track, 'end' of the clip, 'limit': the look ended there."""
    seen = tracked.tracker.observations
    motion = np.array([o.motion_px for o in seen[1:]], float)
    motion = shrink * motion[np.isfinite(motion)]
    return {
        "first_frame": seen[0].frame,
        "last_frame": seen[-1].frame,
        "n_frames": len(seen),
        "start_s": float(seen[0].pts_s),
        "end_s": float(seen[-1].pts_s),
        "ended_by": tracked.end if complete or tracked.end != "end" else "limit",
        "motion_px_per_frame": float(np.median(motion)) if len(motion) else None,
    }
