"""How well a camera that only turns and zooms explains a shot, and what is refused because it does not.

A player who fills the picture, a crowd that the whole picture moves with, a camera that travels past near things: each
pair of pictures still aligns, on what moves, and a focal, a zoom and a panorama would come of it. Two measures tell.
The refined keyframes, whose pairs then contradict each other far beyond what noise and players leave; and the steps
from picture to picture, which the solved cameras must repeat. Neither knows what is in the picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.gates import GateOptions
from calib.records import Solution, Verdict
from mosaic.coords import transfer
from mosaic.records import PairFit
from pipelines.bridge import CameraPlacement, CameraPose
from pipelines.keyframe_graph import KeyframeResult

REASON = "not_a_rotation"
SENTENCE = "No camera that only turns and zooms explains the pictures: people fill them, or the camera moves."
# Median rms residual of the keyframes' pairs, px at W = 1280, from which on a graph that also fails the gate of
# chi2_dof is refused. Generated close-ups with a known ground, 640x360: tracks that followed the person instead (17 to
# 31 px off) left 3.6 to 4.9 px at a chi2_dof of 8.5 to 13, a real close-up 4.6 and 10; those that followed the ground
# (.2 to 2 px off) and crowds on their feet 1.0 to 3.1 at .6 to 4.5. Real and generated wide shots: .1 to 1.1, at most
# 1.7; with 40 % players 1.4 to 3.0, at most 3.5.
MISFIT_PX = 2.0
# Where the keyframes are few, chi2_dof says less. Half of the gate's is enough if besides the cameras do not repeat the
# measured steps: median px at W = 1280. Shots with a chi2_dof above 3 whose cameras were right, or lost where not
# (crowds, 40 % players): .3 to 1.04; wrong ones: 1.3 to 5.6.
DOUBT_SHARE, DOUBT_STEP_PX = 0.5, 1.25
# A measured step is contradicted by cameras that move the picture elsewhere by more than this share of the width. In
# the shots whose cameras are right (2,300 steps) not one was; in the refused real close-up all are, and a third of
# those of a transition that was taken for a shot.
STEP_WIDTHS = 0.02
STEPS_SHARE = 0.25  # of the steps that may be contradicted: frames that were carried off are their own affair
MIN_STEPS = 4
REACH = 0.9  # sizes of the picture between the centres of two that still share a strip
LEAST_PIECE = 0.5  # of the frames with a camera that must hang together for a panorama


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationFit:
    """What speaks for and against a turning, zooming camera. residual_px: median rms of the keyframes, px of the frame,
    NaN unknown. chi2_dof: of the keyframe graph. steps: measured between neighbour frames that both have a camera;
    step_error_px: the median by which the cameras miss them, NaN unknown; steps_contradicted: how many they contradict.
    width_px: of the frame; limits are for 1280."""

    residual_px: float
    chi2_dof: float
    width_px: int
    step_error_px: float
    steps: int
    steps_contradicted: int

    @property
    def refused(self) -> bool:
        """Whether no camera may be claimed for any of the shot's frames."""
        px, gate = self.width_px / 1280, GateOptions().max_chi2_dof
        doubtful = self.chi2_dof > DOUBT_SHARE * gate and self.step_error_px > DOUBT_STEP_PX * px
        misfit = self.residual_px > MISFIT_PX * px and (self.chi2_dof > gate or doubtful)
        scattered = self.steps >= MIN_STEPS and self.steps_contradicted > STEPS_SHARE * self.steps
        return misfit or scattered

    def facts(self) -> dict[str, Any]:
        """For run.json."""
        return {
            "refused": self.refused,
            "residual_px": self.residual_px,
            "residual_limit_px": MISFIT_PX * self.width_px / 1280,
            "step_error_px": self.step_error_px,
            "steps": self.steps,
            "steps_contradicted": self.steps_contradicted,
        }


def rotation_fit(result: KeyframeResult, track: Solution, steps: Iterable[PairFit]) -> RotationFit:
    """Measures of a shot. track: cameras of all its frames; steps: measured pairs of neighbours, as `frame_steps`."""
    rms = result.solution.rms_px[np.isfinite(result.solution.rms_px)]
    width = track.lens.size_px[0]
    apart = step_errors_px(track, steps)
    return RotationFit(
        residual_px=float(np.median(rms)) if len(rms) else float("nan"),
        chi2_dof=float(result.solution.chi2_dof),
        width_px=width,
        step_error_px=float(np.median(apart)) if len(apart) else float("nan"),
        steps=len(apart),
        steps_contradicted=int((~(apart <= STEP_WIDTHS * width)).sum()),
    )


def step_errors_px(track: Solution, steps: Iterable[PairFit]) -> NDArray[np.float64]:
    """(n,) px: how far the cameras of two neighbours put what one shows from where their pair measured it: the median
    of four points, a quarter of the picture from its sides.

    Pairs of frames without a camera are passed over; inf where the cameras leave the points behind them."""
    row = {int(f): i for i, f in enumerate(track.frames) if np.isfinite(track.log_f[i])}
    width, height = track.lens.size_px
    points = np.array([[x * width, y * height] for y in (0.25, 0.75) for x in (0.25, 0.75)])

    def camera(row: int, frame: int) -> CameraPlacement:
        # With the lens: where it is hardly known it may be extreme, and the cameras repeat the steps all the same.
        pose = CameraPose(log_f=float(track.log_f[row]), R=track.R[row])
        return CameraPlacement(frame=frame, size_px=(width, height), lens=track.lens, pose=pose)

    errors = []
    for fit in steps:
        a, b = row.get(fit.src), row.get(fit.dst)
        if a is None or b is None or not fit.usable:
            continue
        rays = camera(a, fit.src).pixel_to_ray(points)
        placed = camera(b, fit.dst).ray_to_pixel(rays)
        error = float(np.median(np.linalg.norm(placed - transfer(fit.H_dst_src, points), axis=1)))
        errors.append(error if np.isfinite(error) else np.inf)
    return np.array(errors)


def refuse(verdict: Verdict) -> Verdict:
    """The verdict of a shot that no rotation explains."""
    return replace(verdict, claims_focal=False, reason=REASON, sentence=SENTENCE)


def largest_piece(placements: Sequence[CameraPlacement]) -> set[int]:
    """Frames of the largest group of pictures that overlap, one leading to the next.

    A frame that overlaps no other was carried off: in a panorama it would stand as an island on black."""
    if not placements:
        return set()
    log_f = np.array([p.pose.log_f for p in placements])
    R = np.array([p.pose.R for p in placements])
    left = np.ones(len(placements), bool)
    best = np.zeros(len(placements), bool)
    while left.sum() > best.sum():
        piece = np.zeros(len(placements), bool)
        waiting = [int(np.argmax(left))]
        left[waiting] = False
        while waiting:
            here = waiting.pop()
            piece[here] = True
            # Where this picture's middle lies in the others, in sizes of the wider picture of the two.
            axis = R @ R[here, 2]
            with np.errstate(divide="ignore", invalid="ignore"):
                shift = axis[:, :2] / axis[:, 2:] * np.exp(np.minimum(log_f, log_f[here]))[:, None]
            shift /= np.array(placements[here].size_px)
            near = left & (axis[:, 2] > 0.1) & (np.abs(shift) < REACH).all(axis=1)
            left[near] = False
            waiting += np.flatnonzero(near).tolist()
        best = piece if piece.sum() > best.sum() else best
    return {p.frame for p, together in zip(placements, best, strict=True) if together}
