"""First pass over a shot: every frame to its predecessor and to a keyframe, and a camera for each as it arrives.

A shot starts in 8-parameter homographies; as soon as the running calibrator trusts its focal and distortion, frames
are registered in the camera's own four parameters (routes.py). Shot boundaries are `shots.py`'s business.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib.records import Priors
from calib.refine import RefineOptions
from calib.running import CameraEstimate, RunningCalibrator, RunningOptions
from mosaic.estimator import RegisterOptions
from mosaic.records import PairFit
from mosaic.template import SelectionOptions, with_level
from pipelines.bridge import CameraPose, edge_from_fit
from pipelines.chain import Chain, centre_motion
from pipelines.config import RegistrationOptions
from pipelines.crowd import CrowdWatch, doubted
from pipelines.keyframe_graph import KeyframeImages
from pipelines.keyframes import Keyframe, KeyframePolicy
from pipelines.preparation import PreparedFrame
from pipelines.repeats import Repeats
from pipelines.routes import Known, Motion, Reached, RunningCamera, expecting, link, recover, register
from pipelines.screen_masks import ScreenMasks

TRUST_SIGMA = 0.3  # relative focal error at which four parameters already beat eight

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
    _current: int = -1  # keyframe that frames are registered to
    _previous: PreparedFrame | None = None
    _pose: CameraPose | None = None  # of the previous frame, while calibrated
    _motion: Motion = field(default_factory=Motion)
    _chain: Chain = field(default_factory=Chain)  # current keyframe to the previous frame
    _repeats: Repeats = field(default_factory=Repeats)
    _policy: KeyframePolicy = field(init=False)
    _screen: ScreenMasks = field(init=False)
    _crowd: CrowdWatch = field(init=False)

    def __post_init__(self) -> None:
        self.calibrator = RunningCalibrator(self.size_px, priors=self.priors, options=RUNNING)
        self._policy = KeyframePolicy(size_px=self.size_px, options=self.options)
        self._screen = ScreenMasks(self.size_px)
        self._crowd = CrowdWatch(selection_of(self.options))

    @property
    def trusts_camera(self) -> bool:
        """Whether the running focal and lens are good enough to register with: far looser than to publish them."""
        solution = self.calibrator.solution
        return solution is not None and solution.converged and self.calibrator.sigma_log_f <= TRUST_SIGMA

    def start(self, look: PreparedFrame) -> None:
        """Take the shot's first frame: it is the first keyframe and the provisional reference."""
        estimate = self.calibrator.add_keyframe(look.frame, [])
        self._add_keyframe(look)
        self._previous = look
        self._observe(look, "ok", "", 0.0, estimate)

    def step(self, look: PreparedFrame, *, rescue: bool = True) -> bool:
        """Register the next frame, update the running camera, take a keyframe when due. False: nothing linked it.

        rescue: whether to try the costly routes too. Raises ValueError before `start`.
        """
        previous = self._previous
        if previous is None:
            raise ValueError(f"frame {look.frame} cannot follow: the shot has not been started")
        if self._repeats.is_repeat(previous.coarse, look.coarse):
            last = self.observations[-1]
            self._observe(look, last.status, "duplicate", 0.0, last.estimate)
            return True
        reached, look = self._register(look, previous, costly=rescue)
        fits = reached.usable
        if not fits:
            return False
        self._motion = reached.motion
        estimate = self.calibrator.update(look.frame, [edge_from_fit(f) for f in fits])
        self._pose = None
        if self.trusts_camera and np.isfinite(estimate.log_f):
            self._pose = CameraPose(log_f=estimate.log_f, R=estimate.R)
        step, direct = _first_from(previous.frame, fits), _first_from(self._current, fits)
        before, self._chain = self._chain, self._chain.followed(direct, step)
        moved_px, _ = centre_motion(
            step.H_dst_src if step is not None else self._chain.H_since(before), self.size_px
        )
        self._observe(look, "ok", "", moved_px, estimate)
        if self.images is not None:
            self.images.put_glance(look.frame, look.pyramid)
        if step is not None:
            self._screen.look(previous.template, look.pyramid, step, self.register_options.kernel)
        self._previous = look
        if self._policy.is_due(self._chain, direct, fits, len(self.keyframes)):
            self._change_keyframe(look, fits)
        return True

    def screen_mask(self, frame: int) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene: without the graphics that were seen to stay at this frame or soon after it.

        Found from pairs of neighbours, a few frames late; None: nothing stayed."""
        return self._screen.at(frame)

    @property
    def crowded(self) -> tuple[int, ...]:
        """Frames that people fill, registered by the scene between them."""
        return self._crowd.frames

    def scene_mask(self, frame: int) -> NDArray[np.bool_] | None:
        """The same as screen_mask, and without people where they filled the picture."""
        stays, scene = self.screen_mask(frame), self._crowd.scene(frame)
        if scene is None:
            return stays
        width, height = self.size_px
        whole = np.repeat(np.repeat(scene > 0, 4, axis=0), 4, axis=1)[:height, :width]
        return whole if stays is None else whole & stays

    def skip(self, frame: int, pts_s: float, status: str, reason: str) -> None:
        """Note a frame that was bridged or lost, so that the shot's list stays complete."""
        self.observations.append(
            Observation(
                frame=frame, pts_s=pts_s, status=status, reason=reason, keyframe=self._current,
                motion_px=float("nan"), estimate=None,
            )
        )  # fmt: skip

    def cut_back(self, last: int) -> None:
        """Forget all frames after `last`: an edit was found there. Nothing may be stepped afterwards."""
        self.observations = [o for o in self.observations if o.frame <= last]
        self.fits = [f for f in self.fits if f.src <= last and f.dst <= last]
        self.keyframes = {k: key for k, key in self.keyframes.items() if k <= last}
        self._screen.cut_back(last)
        self._crowd.cut_back(last)

    def _register(
        self, look: PreparedFrame, previous: PreparedFrame, *, costly: bool
    ) -> tuple[Reached, PreparedFrame]:
        """The frame by the cheapest route that links it, and masked if people fill it; pairs that fail are kept too."""
        camera = None
        if self.trusts_camera and self._pose is not None:
            camera = RunningCamera(
                lens=self.calibrator.lens, previous=self._pose, keyframe=self._keyframe_pose(self._current)
            )
        known = Known(
            previous=previous, keyframe=self.keyframes[self._current],
            H_previous_keyframe=self._chain.H_frame_keyframe, motion=self._motion, camera=camera,
        )  # fmt: skip
        reached = register(look, known, self.register_options)
        reached, look = self._past_people(reached, look, known)
        self.fits.extend(reached.fits)
        if costly and not reached.usable:
            reached = recover(look, known, self.register_options)
            self.fits.extend(reached.fits)
        return reached, look

    def _past_people(
        self, reached: Reached, look: PreparedFrame, known: Known
    ) -> tuple[Reached, PreparedFrame]:
        """What was reached or, where people fill the picture, what is without them; and the frame as it was used."""
        crowd, step = self._crowd, reached.fits[0]
        found = crowd.scene_between(known.previous, look, step)
        if found is None:
            return reached, look
        before, masked = crowd.without_people(known.previous, look, found.scene)
        known = expecting(self._without_people(known, before), found.fit.H_dst_src, self.size_px)
        again = register(masked, known, self.register_options)
        if not again.fits[0].usable:
            return reached, look
        crowd.accept(masked, look)
        return replace(again, fits=tuple(doubted(fit) for fit in again.fits)), masked

    def _without_people(self, known: Known, previous: PreparedFrame) -> Known:
        """What is known, with the frame before without its people; it may be the keyframe."""
        keyframe = known.keyframe
        if known.follows_keyframe:
            keyframe = self._as_keyframe(previous)
            self.keyframes[keyframe.frame] = keyframe
            if self.images is not None:
                self.images.put_scene(previous.frame, previous.scene)
        return replace(known, previous=previous, keyframe=keyframe)

    def _keyframe_pose(self, frame: int) -> CameraPose | None:
        pose = self.calibrator.pose(frame)
        return None if pose is None else CameraPose(log_f=pose[0], R=pose[1])

    def _change_keyframe(self, look: PreparedFrame, fits: Sequence[PairFit]) -> None:
        """Go back to a known keyframe when one sees the same view, else make this frame a keyframe."""
        pose = self._pose if self.trusts_camera else None
        near: list[tuple[float, int]] = []
        if pose is not None:
            poses = {k: known for k in self.keyframes if (known := self._keyframe_pose(k)) is not None}
            near = self._policy.nearest(pose, poses)
            for index in self._policy.same_view(near, self._current):
                fit = self._link(index, poses[index], look, pose)
                if fit.usable:
                    self._current, self._chain = index, Chain(fit=fit)
                    self.calibrator.update(look.frame, [edge_from_fit(f) for f in [*fits, fit]])
                    return
        links = [f for f in fits if f.src in self.keyframes]
        if pose is not None:
            tried = [self._link(k, poses[k], look, pose) for k in self._policy.to_link(near, self._current)]
            links += [f for f in tried if f.usable]
        if not links and self._chain.fit is not None:
            links = [self._chain.fit]
            self.fits.append(self._chain.fit)
        self.calibrator.add_keyframe(look.frame, [edge_from_fit(f) for f in links])
        self._add_keyframe(look)
        self._pose = self._keyframe_pose(look.frame) if self.trusts_camera else None

    def _link(self, index: int, index_pose: CameraPose, look: PreparedFrame, pose: CameraPose) -> PairFit:
        lens, keyframe = self.calibrator.lens, self.keyframes[index]
        fit = link(keyframe, index_pose, lens, look, pose, self.register_options)
        self.fits.append(fit)
        return fit

    def _add_keyframe(self, look: PreparedFrame) -> None:
        self.keyframes[look.frame] = self._as_keyframe(look)
        if self.images is not None:
            self.images.put(look.frame, look.pyramid, look.scene)
        self._current, self._chain = look.frame, Chain()

    def _as_keyframe(self, look: PreparedFrame) -> Keyframe:
        options = self._crowd.selection_for(look)
        template = with_level(look.template, look.pyramid, 0, options=options)
        return Keyframe(frame=look.frame, template=template, small=look.small)

    def _observe(
        self, look: PreparedFrame, status: str, reason: str, motion_px: float, estimate: CameraEstimate | None
    ) -> None:
        self.observations.append(
            Observation(
                frame=look.frame, pts_s=look.pts_s, status=status, reason=reason, keyframe=self._current,
                motion_px=motion_px, estimate=estimate,
            )
        )  # fmt: skip


def _first_from(src: int, fits: Sequence[PairFit]) -> PairFit | None:
    """The first of the pairs that comes from this frame."""
    return next((f for f in fits if f.src == src), None)
