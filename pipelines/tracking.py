"""First pass over a shot: every frame to its predecessor and to a keyframe, and a camera for each as it arrives.

A shot starts in 8-parameter homographies; as soon as the running calibrator trusts its focal and distortion, frames
are registered in the camera's own four parameters. Shot boundaries are `shots.py`'s business.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.records import Lens, Priors
from calib.refine import RefineOptions
from calib.running import CameraEstimate, RunningCalibrator, RunningOptions
from mosaic.coords import normalise_homography, transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import Pyramid
from mosaic.records import FlowGrid, PairFit, PairStatus
from mosaic.rescue import match_features, phase_correlation
from mosaic.rivals import better_of_rivals
from mosaic.screen import WIDER, ScreenVotes, moves_more_widely, without_still
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import PreparedTemplate, SelectionOptions, Template, prepare, with_level
from mosaic.warp import WarpFamily
from pipelines.bridge import CameraPose, RotationZoomFamily, edge_from_fit, pair_state, pose_from_state
from pipelines.config import RegistrationOptions
from pipelines.keyframe_graph import KeyframeImages, distance_in_widths
from pipelines.preparation import PreparedFrame, finest_linked, finest_of

log = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]

TRUST_SIGMA = 0.3  # relative focal error at which four parameters already beat eight
FLASH_LOG_GAIN = 0.25  # of a pair of neighbours or of a keyframe: more is a flash, or an exposure on its way
FADING_SCORE = 0.5  # of a good link to the keyframe: the next one may be doubtful (score_ok is .6)
WEAK_CHAIN = 5  # frames without a direct link to the keyframe before a new keyframe is taken
RESTING_PX, MOVING_PX = (
    0.5,
    1.0,
)  # motion of the centre: none, if that is true; and surely some, if it was predicted
# A prediction that missed the last frame by less than a px of this level is looked for on it and finer ones only.
NEAR_LEVEL, NEAR_PX = 2, 4.0
SCREEN_LATE = 12  # frames after a graphic's appearance within which the votes find it
MAX_LINKS = 6  # earlier keyframes that a new one is registered to: nearest and farthest by predicted overlap

# The running estimate only has to stay locked: fewer starts and an earlier stop than the refinement over the shot.
RUNNING = RunningOptions(
    cold_at=(3, 6),
    two_view_motion=0.02,
    two_view_growth=1.5,
    refine=RefineOptions(
        k1_trials=(-0.02, 0.01, 0.04),
        focal_trials_w=(1.0, 2.0, 3.5),
        focal_k1=(0.0,),
        tolerance=1e-6,
        max_steps=60,
    ),
)


@dataclass(slots=True, eq=False)
class Keyframe:
    """A frame that others are registered to: its template, and a small picture for a rescue."""

    frame: int
    template: Template
    small: NDArray[np.uint8]
    prepared: PreparedTemplate | None = None
    prepared_for: tuple[float, Lens] | None = None

    def bind(self, log_f: float, lens: Lens) -> PreparedTemplate:
        """The template bound to the rotation + zoom family of this focal and lens; kept while they do not change."""
        if self.prepared is None or self.prepared_for is None or self.prepared_for != (log_f, lens):
            self.prepared = prepare(self.template, RotationZoomFamily(lens=lens, log_f_src=log_f))
            self.prepared_for = (log_f, lens)
        return self.prepared


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    """What pass one says of a frame: status 'ok', 'interpolated' or 'lost', its keyframe, motion in px since before."""

    frame: int
    pts_s: float
    status: str
    reason: str
    keyframe: int
    motion_px: float
    estimate: CameraEstimate | None


def selection_of(options: RegistrationOptions) -> SelectionOptions:
    """Pixels per level: the configured numbers hold at 1080p and are not exceeded."""
    return SelectionOptions(n_per_level=(options.n_fine, options.n_half, 2000, 1000, 600, 400))


@dataclass(slots=True, eq=False)
class ShotTracker:
    """The state of pass one within a shot. `step` returns False when the frame could not be linked at all."""

    size_px: tuple[int, int]
    options: RegistrationOptions
    priors: Priors
    images: KeyframeImages | None = None
    register_options: RegisterOptions = field(default_factory=RegisterOptions)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    fits: list[PairFit] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    calibrator: RunningCalibrator = field(init=False)
    _current: int = -1
    screen: ScreenVotes = field(init=False)
    _screen_cells: dict[int, NDArray[np.bool_]] = field(default_factory=dict)
    _previous: PreparedFrame | None = None
    _pose: CameraPose | None = None  # of the previous frame, while calibrated
    _H_previous_keyframe: FloatArray = field(default_factory=lambda: np.eye(3))
    _H_step: FloatArray = field(default_factory=lambda: np.eye(3))
    _velocity: tuple[float, FloatArray] = field(default_factory=lambda: (0.0, np.eye(3)))
    _missed_px: float = np.inf  # by how much the last prediction missed the centre
    _changes: deque[float] = field(default_factory=lambda: deque(maxlen=25))
    _n_chained: int = 0
    _chain: PairFit | None = (
        None  # current keyframe to the previous frame, composed while no direct link held
    )

    def __post_init__(self) -> None:
        self.calibrator = RunningCalibrator(self.size_px, priors=self.priors, options=RUNNING)
        self.screen = ScreenVotes(self.size_px)

    @property
    def trusts_camera(self) -> bool:
        """Whether the running focal and lens are good enough to register with: far looser than to publish them."""
        solution = self.calibrator.solution
        return solution is not None and solution.converged and self.calibrator.sigma_log_f <= TRUST_SIGMA

    @property
    def frames(self) -> list[int]:
        """Frame numbers seen by this tracker, in order."""
        return [o.frame for o in self.observations]

    def start(self, look: PreparedFrame) -> None:
        """Take the shot's first frame: it is the first keyframe and the provisional reference."""
        estimate = self.calibrator.add_keyframe(look.frame, [])
        self._add_keyframe(look)
        self._previous = look
        self._pose = None
        self._observe(look.frame, look.pts_s, "ok", "", 0.0, estimate)

    def step(self, look: PreparedFrame, *, rescue: bool = True) -> bool:
        """Register the next frame, update the running camera, take a keyframe when due. False: nothing linked it."""
        frame, pyramid = look.frame, look.pyramid
        if self._is_duplicate(look):
            last = self.observations[-1]
            self._observe(frame, look.pts_s, last.status, "duplicate", 0.0, last.estimate)
            return True
        before = len(self.fits)
        linked = (
            self._step_calibrated(frame, pyramid)
            if self.trusts_camera and self._pose is not None
            else self._step_free(frame, pyramid)
        )
        if not linked and rescue:
            linked = self._rescue(look)
        if not linked:
            return False
        fits = [f for f in self.fits[before:] if f.usable]
        estimate = self.calibrator.update(frame, [edge_from_fit(f) for f in fits])
        self._follow(fits, estimate)
        motion = self._motion(fits)
        self._observe(frame, look.pts_s, "ok", "", motion, estimate)
        self._look_at_screen(look, fits)
        self._previous = look
        if self._needs_keyframe(fits):
            self._change_keyframe(look, fits)
        return True

    def screen_mask(self, frame: int) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene: without the graphics that were seen to stay at this frame or soon after it.

        Found from pairs of neighbours, a few frames late; None: nothing stayed."""
        cells = [c for k in range(frame, frame + SCREEN_LATE) if (c := self._screen_cells.get(k)) is not None]
        return self.screen.full_size(np.logical_and.reduce(cells)) if cells else None

    def skip(self, frame: int, pts_s: float, status: str, reason: str) -> None:
        """Note a frame that was bridged or lost, so that the shot's list stays complete."""
        self._observe(frame, pts_s, status, reason, float("nan"), None)

    def cut_back(self, last: int) -> None:
        """Forget all frames after `last`: an edit was found there. Nothing may be stepped afterwards."""
        self.observations = [o for o in self.observations if o.frame <= last]
        self.fits = [f for f in self.fits if f.src <= last and f.dst <= last]
        self.keyframes = {k: key for k, key in self.keyframes.items() if k <= last}
        self._screen_cells = {k: cells for k, cells in self._screen_cells.items() if k <= last}

    # -- registration ------------------------------------------------------------------------------------------

    def _free_family(self) -> StiffHomographyFamily:
        return StiffHomographyFamily(size_px=self.size_px)

    def _step_free(self, frame: int, pyramid: Pyramid) -> bool:
        """8-parameter registration: to the previous frame from constant velocity, then to the keyframe."""
        family = self._free_family()
        coarse = self._coarse_levels(pyramid)
        step = self._H_step
        assert self._previous is not None
        fit, H_prev = align(
            prepare(self._previous.template, family),
            pyramid,
            step,
            dst=frame,
            levels=coarse,
            options=self.register_options,
            route="eight parameters",
        )
        if not fit.usable and not np.array_equal(step, np.eye(3)):
            fit, H_prev = align(
                prepare(self._previous.template, family),
                pyramid,
                np.eye(3),
                dst=frame,
                levels=coarse,
                route="still",
            )
        fit, H_prev = better_of_rivals(
            prepare(self._previous.template, family), pyramid, fit, H_prev, np.eye(3), levels=coarse,
            options=self.register_options,
        )  # fmt: skip
        fit, H_prev = self._beyond_graphics(
            family, pyramid, fit, H_prev, step, _displacement(step, self.size_px)[0]
        )
        self.fits.append(fit)
        start = (H_prev if fit.usable else step) @ self._H_previous_keyframe
        keyframe = self.keyframes[self._current]
        if keyframe.frame == self._previous.frame and fit.usable:
            levels: tuple[int, ...] = (0,)
        else:
            levels = (1, 0) if fit.usable else tuple(range(len(pyramid.levels) - 1, -1, -1))
        key_fit, H_key = align(
            prepare(keyframe.template, family),
            pyramid,
            start,
            dst=frame,
            levels=levels,
            options=self.register_options,
            route="eight parameters",
        )
        if keyframe.frame == self._previous.frame and key_fit.usable:
            self.fits[-1] = key_fit  # one edge, the finer one
        else:
            self.fits.append(key_fit)
        if key_fit.usable:
            self._H_step = normalise_homography(H_key @ np.linalg.inv(self._H_previous_keyframe))
            self._H_previous_keyframe = H_key
            return True
        if fit.usable:
            self._H_step = H_prev
            self._H_previous_keyframe = normalise_homography(H_prev @ self._H_previous_keyframe)
            return True
        return False

    def _step_calibrated(self, frame: int, pyramid: Pyramid) -> bool:
        """Rotation + zoom through the running lens: to the previous frame, then to the keyframe."""
        lens = self.calibrator.lens
        assert self._previous is not None and self._pose is not None
        rate, turn = self._velocity
        predicted = CameraPose(log_f=self._pose.log_f + rate, R=turn @ self._pose.R)
        family = RotationZoomFamily(lens=lens, log_f_src=self._pose.log_f)
        source = prepare(self._previous.template, family)
        coarse = self._coarse_levels(pyramid)
        near = tuple(i for i in coarse if i <= NEAR_LEVEL) if self._missed_px < NEAR_PX else coarse
        for levels in (near, coarse) if near != coarse else (coarse,):
            fit, state = align(
                source,
                pyramid,
                pair_state(self._pose, predicted),
                dst=frame,
                levels=levels,
                options=self.register_options,
            )
            if fit.status == PairStatus.OK:
                break
        if not fit.usable:
            fit, state = align(
                source, pyramid, pair_state(self._pose, self._pose), dst=frame, levels=coarse, route="still"
            )
        fit, state = better_of_rivals(
            source, pyramid, fit, state, pair_state(self._pose, self._pose), levels=coarse,
            options=self.register_options,
        )  # fmt: skip
        fit, state = self._beyond_graphics(
            family, pyramid, fit, state, pair_state(self._pose, predicted),
            self.size_px[0] * distance_in_widths(self._pose, predicted, self.size_px[0]),
        )  # fmt: skip
        self.fits.append(fit)
        keyframe = self.keyframes[self._current]
        key_pose = self._keyframe_pose(self._current)
        if key_pose is None:
            return fit.usable
        guess = pose_from_state(self._pose, state) if fit.usable else predicted
        fine = tuple(i for i in (1, 0) if i >= finest_linked(self.size_px))
        levels = fine if fit.usable else tuple(range(len(pyramid.levels) - 1, fine[-1] - 1, -1))
        key_fit, _ = align(
            keyframe.bind(key_pose.log_f, lens),
            pyramid,
            pair_state(key_pose, guess),
            dst=frame,
            levels=levels,
            options=self.register_options,
        )
        if key_fit.status != PairStatus.OK and fit.usable:
            # The running lens may be wrong, early in a shot: eight parameters do not depend on it.
            H = normalise_homography(fit.H_dst_src @ self._H_previous_keyframe)
            free_fit, _ = align(
                prepare(keyframe.template, self._free_family()),
                pyramid,
                H,
                dst=frame,
                levels=(2, 1, 0) if len(pyramid.levels) > 2 else None,
                options=self.register_options,
                route="eight parameters",
            )
            if free_fit.usable and not (key_fit.usable and key_fit.score <= free_fit.score):
                key_fit = free_fit
        self.fits.append(key_fit)
        if fit.usable:
            # Velocity from the frame-to-frame estimate alone: keyframe corrections are no motion (real-footage.md 7.5).
            self._velocity = (state.log_f - self._pose.log_f, state.R_dst_src)
            found = pose_from_state(self._pose, state)
            self._missed_px = self.size_px[0] * distance_in_widths(predicted, found, self.size_px[0])
        elif key_fit.usable:
            self._velocity = (0.0, np.eye(3))
            self._missed_px = np.inf
        return fit.usable or key_fit.usable

    def _beyond_graphics(
        self, family: WarpFamily, pyramid: Pyramid, fit: PairFit, state: Any, start: Any, expected_px: float
    ) -> tuple[PairFit, Any]:
        """The pair to the previous frame, fitted again without what stays on the screen where it seems not to move."""
        # Where the family itself puts the centre: the fit's homography follows the flow, of both scene and graphic.
        centre = (np.array([self.size_px], np.float64) - 1) / 2
        where, _, _ = family.warp(state, family.prepare(centre))
        if not fit.usable or not float(np.hypot(*(where - centre)[0])) <= RESTING_PX:
            return fit, state
        assert self._previous is not None
        kernel = self.register_options.kernel
        template = without_still(self._previous.template, pyramid, fit, kernel=kernel)
        if template is None:
            return fit, state
        levels = self._coarse_levels(pyramid)
        second, second_state = align(
            prepare(template, family), pyramid, start, dst=fit.dst, levels=levels, options=self.register_options,
            route="beyond graphics",
        )  # fmt: skip
        share = 1 / WIDER if expected_px > MOVING_PX else WIDER
        if second.usable and moves_more_widely(
            self._previous.template, pyramid, fit, second, share, kernel=kernel
        ):
            return second, second_state
        return fit, state

    def _look_at_screen(self, look: PreparedFrame, fits: list[PairFit]) -> None:
        step = self._step_fit(fits)
        if step is None or self._previous is None:
            return
        self.screen.look(self._previous.template, look.pyramid, step, kernel=self.register_options.kernel)
        cells = self.screen.mask()
        if cells is not None:
            self._screen_cells[look.frame] = cells

    def _rescue(self, look: PreparedFrame) -> bool:
        """Lost: phase correlation, then features, against the previous frame and the keyframe; verified directly."""
        family = self._free_family()
        keyframe = self.keyframes[self._current]
        candidates = [(keyframe.template, keyframe.small, True)]
        if self._previous is not None and self._previous.frame != keyframe.frame:
            candidates.insert(0, (self._previous.template, self._previous.small, False))
        for route in ("phase correlation", "features"):
            for template, source_small, is_keyframe in candidates:
                if route == "features":
                    H = match_features(source_small, look.small, self.size_px)
                    if H is None:
                        continue
                else:
                    H, _ = phase_correlation(source_small, look.small, self.size_px)
                levels = [
                    i for i in range(len(template.levels) - 1, -1, -1) if template.levels[i] is not None
                ]
                fit, state = align(
                    prepare(template, family),
                    look.pyramid,
                    H,
                    dst=look.frame,
                    levels=levels,
                    options=self.register_options,
                    route=route,
                )
                if fit.usable:
                    self.fits.append(fit)
                    self._H_step = np.eye(3)
                    self._velocity = (0.0, np.eye(3))
                    self._H_previous_keyframe = (
                        state if is_keyframe else normalise_homography(state @ self._H_previous_keyframe)
                    )
                    return True
        return False

    # -- keyframes ---------------------------------------------------------------------------------------------

    def _keyframe_pose(self, frame: int) -> CameraPose | None:
        pose = self.calibrator.pose(frame)
        return None if pose is None else CameraPose(log_f=pose[0], R=pose[1])

    def _needs_keyframe(self, fits: list[PairFit]) -> bool:
        """Far enough from the current keyframe. The first few come sooner: a short pan must not end with one.

        A doubtful frame (flash, blur, a crowd of players) waits for a better one, up to twice the distance; where a
        link to the keyframe will soon be doubtful, as players cover what it saw, the last good one is taken.
        """
        direct = next((f for f in fits if f.src == self._current), None)
        if direct is not None and direct.status == PairStatus.OK and direct.score > FADING_SCORE:
            return True
        moved, zoom = _displacement(self._H_previous_keyframe, self.size_px)
        share = min(1.0, len(self.keyframes) / 3.0)
        if any(f.status != PairStatus.OK or abs(np.log(f.gain)) > FLASH_LOG_GAIN for f in fits):
            share *= 2.0
        return (
            self._n_chained >= WEAK_CHAIN
            or moved > share * self.options.keyframe_shift * self.size_px[0]
            or abs(np.log(zoom)) > share * np.log(self.options.keyframe_zoom)
        )

    def _change_keyframe(self, look: PreparedFrame, fits: list[PairFit]) -> None:
        """Go back to a known keyframe when one sees the same view, else make this frame a keyframe."""
        frame, pyramid = look.frame, look.pyramid
        if self.trusts_camera and self._pose is not None:
            for distance, index in self._neighbours(self._pose)[:2]:
                if index == self._current or distance > 0.6 * self.options.keyframe_shift:
                    continue
                fit = self._link(index, self._pose, frame, pyramid)
                self.fits.append(fit)
                if fit.usable:
                    self._current = index
                    self._chain, self._n_chained = fit, 0
                    self._H_previous_keyframe = fit.H_dst_src
                    self.calibrator.update(frame, [edge_from_fit(f) for f in [*fits, fit]])
                    return
        links = [f for f in fits if f.src in self.keyframes]
        if self.trusts_camera and self._pose is not None:
            near = [
                (d, i)
                for d, i in self._neighbours(self._pose)
                if d < 1 - self.options.min_overlap and i != self._current
            ]
            chosen = (
                near
                if len(near) <= MAX_LINKS
                else near[: MAX_LINKS // 2] + near[-(MAX_LINKS - MAX_LINKS // 2) :]
            )
            for _, index in chosen:
                fit = self._link(index, self._pose, frame, pyramid)
                self.fits.append(fit)
                if fit.usable:
                    links.append(fit)
        if not links and self._chain is not None:
            links = [self._chain]
            self.fits.append(self._chain)
        self.calibrator.add_keyframe(frame, [edge_from_fit(f) for f in links])
        self._add_keyframe(look)
        self._pose = self._keyframe_pose(frame) if self.trusts_camera else None

    def _link(self, index: int, pose: CameraPose, frame: int, pyramid: Pyramid) -> PairFit:
        keyframe = self.keyframes[index]
        key_pose = self._keyframe_pose(index)
        assert key_pose is not None
        fit, _ = align(
            keyframe.bind(key_pose.log_f, self.calibrator.lens),
            pyramid,
            pair_state(key_pose, pose),
            dst=frame,
            levels=(2, 1, 0) if len(pyramid.levels) > 2 else None,
            options=self.register_options,
            route="link",
        )
        return fit

    def _neighbours(self, pose: CameraPose) -> list[tuple[float, int]]:
        """Keyframes by predicted displacement of the centre, in widths, plus twice the log zoom ratio."""
        found = []
        for index in self.keyframes:
            other = self._keyframe_pose(index)
            if other is None:
                continue
            found.append((distance_in_widths(other, pose, self.size_px[0]), index))
        return sorted(found)

    def _add_keyframe(self, look: PreparedFrame) -> None:
        selection = selection_of(self.options)
        template = with_level(look.template, look.pyramid, 0, options=selection)
        self.keyframes[look.frame] = Keyframe(frame=look.frame, template=template, small=look.small)
        if self.images is not None:
            self.images.put(look.frame, look.pyramid)
        self._current = look.frame
        self._chain, self._n_chained = None, 0
        self._H_previous_keyframe = np.eye(3)

    # -- bookkeeping -------------------------------------------------------------------------------------------

    def _coarse_levels(self, pyramid: Pyramid) -> tuple[int, ...]:
        """Levels of a pair of neighbours: to the half size, in a small picture to the full one."""
        return tuple(range(len(pyramid.levels) - 1, finest_of(self.size_px) - 1, -1))

    def _follow(self, fits: list[PairFit], estimate: CameraEstimate) -> None:
        if self.trusts_camera and np.isfinite(estimate.log_f):
            self._pose = CameraPose(log_f=estimate.log_f, R=estimate.R)
        else:
            self._pose = None
        direct = next((f for f in fits if f.src == self._current), None)
        step = self._step_fit(fits)
        if direct is not None:
            self._chain, self._n_chained = direct, 0
        elif step is not None and self._chain is not None:
            self._chain, self._n_chained = compose_fits(self._chain, step), self._n_chained + 1
        if self._chain is not None:
            self._H_previous_keyframe = self._chain.H_dst_src

    def _is_duplicate(self, look: PreparedFrame) -> bool:
        """A repeated picture (24 to 30 conversions) differs far less from its predecessor than pictures usually do."""
        if self._previous is None:
            return False
        before = self._previous.coarse.astype(np.float32)
        change = float(np.abs(look.coarse.astype(np.float32) - before).mean())
        usual = float(np.median(self._changes)) if len(self._changes) >= 3 else float("nan")
        if change < 0.02 or (change < 0.25 * usual and change < 0.6):
            return True
        self._changes.append(change)
        return False

    def _motion(self, fits: list[PairFit]) -> float:
        step = self._step_fit(fits)
        return _displacement(self._H_step if step is None else step.H_dst_src, self.size_px)[0]

    def _step_fit(self, fits: list[PairFit]) -> PairFit | None:
        """The first of the fits that comes from the previous frame."""
        assert self._previous is not None
        return next((f for f in fits if f.src == self._previous.frame), None)

    def _observe(
        self,
        frame: int,
        pts_s: float,
        status: str,
        reason: str,
        motion_px: float,
        estimate: CameraEstimate | None,
    ) -> None:
        self.observations.append(
            Observation(
                frame=frame,
                pts_s=pts_s,
                status=status,
                reason=reason,
                keyframe=self._current,
                motion_px=motion_px,
                estimate=estimate,
            )
        )


def _displacement(H: FloatArray, size_px: tuple[int, int]) -> tuple[float, float]:
    """How far the picture's centre moves under H, px, and the local scale there."""
    centre = np.array([(size_px[0] - 1) / 2.0, (size_px[1] - 1) / 2.0])
    d = size_px[0] / 8.0
    points = transfer(H, centre + np.array([[0.0, 0.0], [d, 0.0], [0.0, d]]))
    if not np.all(np.isfinite(points)):
        return float("inf"), 1.0
    area = np.linalg.det(points[1:] - points[0])
    return float(np.linalg.norm(points[0] - centre)), float(np.sqrt(max(area, 1e-9)) / d)


def compose_fits(first: PairFit, second: PairFit) -> PairFit:
    """The pair a -> c from a -> b and b -> c: first's cells carried on by second's homography, with its error added."""
    H = normalise_homography(second.H_dst_src @ first.H_dst_src)
    flow = first.flow
    carried = transfer(second.H_dst_src, flow.dst_px)
    good = np.isfinite(carried).all(axis=1)
    values, vectors = np.linalg.eigh(flow.info[good])
    # A chained frame-to-frame step is good to about .3 px where it was measured (real-footage.md 6.1).
    values = np.where(values > 1e-6, 1.0 / (1.0 / np.maximum(values, 1e-6) + 0.09), 0.0)
    return PairFit(
        src=first.src,
        dst=second.dst,
        H_dst_src=H,
        status=first.status,
        reason=first.reason,
        overlap=min(first.overlap, second.overlap),
        rms_grey=second.rms_grey,
        score=max(first.score, second.score),
        gain=first.gain * second.gain,
        offset=second.offset,
        n_steps=0,
        route="composed",
        flow=FlowGrid(
            src_px=flow.src_px[good],
            dst_px=carried[good],
            info=np.einsum("cij,cj,ckj->cik", vectors, values, vectors),
            weight=flow.weight[good],
            cell=flow.cell[good],
        ),
        anchors_px=first.anchors_px,
        info=first.info,
    )
