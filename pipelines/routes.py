"""How a frame of the first pass is registered: to the frame before it and to its keyframe, by one of three routes.

`register` takes the running camera's own four parameters where that camera is known, else eight; `recover` is for a
frame that it lost. Both are functions of the frame and of what is known before it, and keep no state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.records import Lens
from mosaic.coords import normalise_homography, transfer
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit, PairStatus
from mosaic.rescue import match_features, phase_correlation
from mosaic.rivals import better_of_rivals
from mosaic.screen import WIDER, moves_more_widely, without_still
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import PreparedTemplate, prepare
from mosaic.warp import nearest_state
from pipelines.bridge import CameraPose, PairState, RotationZoomFamily, pair_state, pose_from_state
from pipelines.chain import centre_motion
from pipelines.keyframe_graph import distance_in_widths
from pipelines.keyframes import Keyframe
from pipelines.preparation import PreparedFrame, finest_linked, finest_of

FloatArray = NDArray[np.float64]

# Motion of the centre, px: none, if that is true; and surely some, if it was predicted.
RESTING_PX, MOVING_PX = 0.5, 1.0
# A prediction that missed the last frame by less than a px of this level is looked for on it and finer ones only.
NEAR_LEVEL, NEAR_PX = 2, 4.0
RESCUED = ("phase correlation", "features")  # routes of a pair that no prediction found
# Beyond a cut another camera may show the same venue, and features find its stands there. 53 pairs that features or
# phase correlation found a quarter to half a picture away: right ones score .12 to .39, whether neighbours or 58 frames
# apart; wrong ones, across cuts and in smeared pictures, .39 and .58 to .79. That at .39 zoomed by 1.8.
RESCUED_SCORE, RESCUED_ZOOM = 0.5, 1.4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """What the frames before predict of the next step.

    H_step (3, 3): a frame to the next, as eight parameters found it last. log_zoom, turn (3, 3): change of log f and
    R_next_frame, as the running camera's four found them last. missed_px: by how much that camera's last prediction
    missed the centre; inf: there was none. found: the step is no prediction, but was found for this very pair.
    """

    H_step: FloatArray = field(default_factory=lambda: np.eye(3))
    log_zoom: float = 0.0
    turn: FloatArray = field(default_factory=lambda: np.eye(3))
    missed_px: float = np.inf
    found: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunningCamera:
    """The running calibrator's camera, while it is trusted: the lens, and the poses of the frame before and of the
    current keyframe (None: forgotten)."""

    lens: Lens
    previous: CameraPose
    keyframe: CameraPose | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """What a frame can be registered to, and what is known of it beforehand.

    H_previous_keyframe (3, 3): px of the keyframe to px of the frame before. camera: None while it is not trusted.
    """

    previous: PreparedFrame
    keyframe: Keyframe
    H_previous_keyframe: FloatArray
    motion: Motion
    camera: RunningCamera | None

    @property
    def follows_keyframe(self) -> bool:
        """Whether the frame before is the keyframe."""
        return self.keyframe.frame == self.previous.frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reached:
    """fits: pairs tried, failed ones too, that to the frame before first; motion: as the next frame shall expect it."""

    fits: tuple[PairFit, ...]
    motion: Motion

    @property
    def usable(self) -> list[PairFit]:
        """The pairs that hold; none: the frame is not linked."""
        return [f for f in self.fits if f.usable]


def register(look: PreparedFrame, known: Known, options: RegisterOptions) -> Reached:
    """The frame against the one before it, from the motion so far, then against the keyframe."""
    if known.camera is None:
        reached = _in_eight_parameters(look, known, options)
    else:
        reached = _in_the_cameras_own(look, known, known.camera, options)
    # For the next frame it is a prediction, whatever it was for this one.
    return replace(reached, motion=replace(reached.motion, found=False))


def recover(look: PreparedFrame, known: Known, options: RegisterOptions) -> Reached:
    """Lost: phase correlation, then features, against the frame before and the keyframe; verified directly.

    Only a pair without doubt is taken, and one that a lens could have reached: a wrong one hides a cut.
    """
    family = _free_family(look)
    for template, H, route in _coarse_starts(look, known):
        fit, _ = align(
            prepare(template, family), look.pyramid, H, dst=look.frame, options=options, route=route
        )
        if fit.status == PairStatus.OK and fit.score <= RESCUED_SCORE and _is_near(fit, look, known):
            # What is predicted from here on is a standstill: it may miss by anything.
            stopped = replace(known.motion, H_step=np.eye(3), log_zoom=0.0, turn=np.eye(3), missed_px=np.inf)
            return Reached(fits=(fit,), motion=stopped)
    return Reached(fits=(), motion=known.motion)


def _is_near(fit: PairFit, look: PreparedFrame, known: Known) -> bool:
    """Whether the zoom since the frame before, by a pair with it or with the keyframe, is small enough."""
    H = fit.H_dst_src
    if fit.src != known.previous.frame:
        H = H @ np.linalg.inv(known.H_previous_keyframe)
    _, zoom = centre_motion(H, look.pyramid.size_px)
    return bool(1 / RESCUED_ZOOM <= zoom <= RESCUED_ZOOM)


def expecting(known: Known, H_look_previous: FloatArray, size_px: tuple[int, int]) -> Known:
    """What is known, with the motion of a pair of this and the frame before in place of what was predicted."""
    motion = replace(known.motion, H_step=H_look_previous, found=True)
    if known.camera is not None:
        before, lens = known.camera.previous, known.camera.lens
        family = RotationZoomFamily(lens=lens, log_f_src=before.log_f)
        x, y = (np.linspace(0.1, 0.9, n) * (side - 1) for n, side in zip((8, 5), size_px, strict=True))
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        state = nearest_state(
            family, pair_state(before, before), family.prepare(points), transfer(H_look_previous, points)
        )
        motion = replace(motion, log_zoom=state.log_f - before.log_f, turn=state.R_dst_src)
    return replace(known, motion=motion)


def link(
    keyframe: Keyframe,
    pose: CameraPose,
    lens: Lens,
    look: PreparedFrame,
    look_pose: CameraPose,
    options: RegisterOptions,
) -> PairFit:
    """A frame against a keyframe that is not its own, through the running lens, from both cameras."""
    start = pair_state(pose, look_pose)
    return align(
        keyframe.bind(pose.log_f, lens), look.pyramid, start, dst=look.frame, levels=_three_finest(look.pyramid),
        options=options, route="link",
    )[0]  # fmt: skip


# -- eight parameters -------------------------------------------------------------------------------------------------


def _in_eight_parameters(look: PreparedFrame, known: Known, options: RegisterOptions) -> Reached:
    step, H_step = _free_to_previous(look, known, options)
    start = (H_step if step.usable else known.motion.H_step) @ known.H_previous_keyframe
    if known.follows_keyframe and step.usable:
        levels: tuple[int, ...] = (0,)
    else:
        levels = (1, 0) if step.usable else _down_to(0, look.pyramid)
    direct, H_frame_keyframe = align(
        prepare(known.keyframe.template, _free_family(look)), look.pyramid, start, dst=look.frame, levels=levels,
        options=options, route="eight parameters",
    )  # fmt: skip
    # Where the keyframe is the frame before: one edge, the finer one.
    fits = (direct,) if known.follows_keyframe and direct.usable else (step, direct)
    motion = known.motion
    if direct.usable:
        H = normalise_homography(H_frame_keyframe @ np.linalg.inv(known.H_previous_keyframe))
        motion = replace(motion, H_step=H)
    elif step.usable:
        motion = replace(motion, H_step=H_step)
    return Reached(fits=fits, motion=motion)


def _free_to_previous(
    look: PreparedFrame, known: Known, options: RegisterOptions
) -> tuple[PairFit, FloatArray]:
    """The pair with the frame before and its H, from constant velocity."""
    predicted, still = known.motion.H_step, np.eye(3)
    source = prepare(known.previous.template, _free_family(look))
    levels = _neighbours_levels(look.pyramid)
    if known.motion.found:
        route = "eight parameters"
        return align(
            source, look.pyramid, predicted, dst=look.frame, levels=levels[-1:], options=options, route=route
        )
    fit, H = align(
        source, look.pyramid, predicted, dst=look.frame, levels=levels, options=options, route="eight parameters"
    )  # fmt: skip
    if not fit.usable and not np.array_equal(predicted, still):
        fit, H = align(
            source, look.pyramid, still, dst=look.frame, levels=levels, options=options, route="still"
        )
    fit, H = better_of_rivals(source, look.pyramid, fit, H, still, levels=levels, options=options)
    expected_px, _ = centre_motion(predicted, look.pyramid.size_px)
    return _beyond_graphics(source, look, fit, H, predicted, expected_px, options)


def _free_family(look: PreparedFrame) -> StiffHomographyFamily:
    return StiffHomographyFamily(size_px=look.pyramid.size_px)


# -- the camera's own four --------------------------------------------------------------------------------------------


def _in_the_cameras_own(
    look: PreparedFrame, known: Known, camera: RunningCamera, options: RegisterOptions
) -> Reached:
    width_px = look.pyramid.size_px[0]
    before, motion = camera.previous, known.motion
    predicted = CameraPose(log_f=before.log_f + motion.log_zoom, R=motion.turn @ before.R)
    step, state = _camera_to_previous(look, known, camera, predicted, options)
    if camera.keyframe is None:
        return Reached(fits=(step,), motion=motion)
    found = pose_from_state(before, state) if step.usable else predicted
    direct = _camera_to_keyframe(look, known, camera, camera.keyframe, step, found, options)
    if step.usable:
        # Velocity from the frame-to-frame estimate alone: keyframe corrections are no motion (real-footage.md 7.5).
        missed_px = width_px * distance_in_widths(predicted, found, width_px)
        motion = replace(
            motion,
            log_zoom=state.log_f - before.log_f,
            turn=state.R_dst_src,
            missed_px=missed_px,
        )
    elif direct.usable:
        motion = replace(motion, log_zoom=0.0, turn=np.eye(3), missed_px=np.inf)
    return Reached(fits=(step, direct), motion=motion)


def _camera_to_previous(
    look: PreparedFrame,
    known: Known,
    camera: RunningCamera,
    predicted: CameraPose,
    options: RegisterOptions,
) -> tuple[PairFit, PairState]:
    """The pair with the frame before and its state, from the predicted camera."""
    width_px = look.pyramid.size_px[0]
    before = camera.previous
    start, still = pair_state(before, predicted), pair_state(before, before)
    source = prepare(known.previous.template, RotationZoomFamily(lens=camera.lens, log_f_src=before.log_f))
    levels = _neighbours_levels(look.pyramid)
    if known.motion.found:
        return align(source, look.pyramid, start, dst=look.frame, levels=levels[-1:], options=options)
    near = tuple(i for i in levels if i <= NEAR_LEVEL) if known.motion.missed_px < NEAR_PX else levels
    fit, state = align(source, look.pyramid, start, dst=look.frame, levels=near, options=options)
    if fit.status != PairStatus.OK and near != levels:
        fit, state = align(source, look.pyramid, start, dst=look.frame, levels=levels, options=options)
    if not fit.usable:
        fit, state = align(
            source, look.pyramid, still, dst=look.frame, levels=levels, options=options, route="still"
        )
    fit, state = better_of_rivals(source, look.pyramid, fit, state, still, levels=levels, options=options)
    expected_px = width_px * distance_in_widths(before, predicted, width_px)
    return _beyond_graphics(source, look, fit, state, start, expected_px, options)


def _camera_to_keyframe(
    look: PreparedFrame,
    known: Known,
    camera: RunningCamera,
    keyframe_pose: CameraPose,
    step: PairFit,
    guess: CameraPose,
    options: RegisterOptions,
) -> PairFit:
    """The pair with the keyframe, from the guessed camera. step: the pair with the frame before."""
    finest = finest_linked(look.pyramid.size_px)
    levels = tuple(i for i in (1, 0) if i >= finest) if step.usable else _down_to(finest, look.pyramid)
    fit, _ = align(
        known.keyframe.bind(keyframe_pose.log_f, camera.lens), look.pyramid, pair_state(keyframe_pose, guess),
        dst=look.frame, levels=levels, options=options,
    )  # fmt: skip
    if fit.status == PairStatus.OK or not step.usable:
        return fit
    # The running lens may be wrong, early in a shot: eight parameters do not depend on it.
    H = normalise_homography(step.H_dst_src @ known.H_previous_keyframe)
    free, _ = align(
        prepare(known.keyframe.template, _free_family(look)), look.pyramid, H, dst=look.frame,
        levels=_three_finest(look.pyramid), options=options, route="eight parameters",
    )  # fmt: skip
    return free if free.usable and not (fit.usable and fit.score <= free.score) else fit


# -- all routes -------------------------------------------------------------------------------------------------------


def _beyond_graphics(
    source: PreparedTemplate,
    look: PreparedFrame,
    fit: PairFit,
    state: Any,
    start: Any,
    expected_px: float,
    options: RegisterOptions,
) -> tuple[PairFit, Any]:
    """The pair to the frame before, fitted again without what stays on the screen where it seems not to move.

    start, expected_px: the predicted state and its motion of the centre."""
    family, template, pyramid = source.family, source.template, look.pyramid
    # Where the family itself puts the centre: the fit's homography follows the flow, of both scene and graphic.
    centre = (np.array([pyramid.size_px], np.float64) - 1) / 2
    where, _, _ = family.warp(state, family.prepare(centre))
    if not fit.usable or not float(np.hypot(*(where - centre)[0])) <= RESTING_PX:
        return fit, state
    moving = without_still(template, pyramid, fit, kernel=options.kernel)
    if moving is None:
        return fit, state
    second, second_state = align(
        prepare(moving, family), pyramid, start, dst=fit.dst, levels=_neighbours_levels(pyramid), options=options,
        route="beyond graphics",
    )  # fmt: skip
    share = 1 / WIDER if expected_px > MOVING_PX else WIDER
    if second.usable and moves_more_widely(template, pyramid, fit, second, share, kernel=options.kernel):
        return second, second_state
    return fit, state


def _coarse_starts(look: PreparedFrame, known: Known) -> Iterator[tuple[Any, FloatArray, str]]:
    """(template, H to the frame, route) to try for a lost frame, the likeliest first."""
    size_px = look.pyramid.size_px
    sources = [(known.keyframe.template, known.keyframe.small)]
    if not known.follows_keyframe:
        sources.insert(0, (known.previous.template, known.previous.small))
    for template, small in sources:
        yield template, phase_correlation(small, look.small, size_px)[0], "phase correlation"
    for template, small in sources:
        H = match_features(small, look.small, size_px)
        if H is not None:
            yield template, H, "features"


def _neighbours_levels(pyramid: Pyramid) -> tuple[int, ...]:
    """Levels of a pair of neighbours: to the half size, in a small picture to the full one."""
    return _down_to(finest_of(pyramid.size_px), pyramid)


def _down_to(finest: int, pyramid: Pyramid) -> tuple[int, ...]:
    """All levels from the coarsest to this one."""
    return tuple(range(len(pyramid.levels) - 1, finest - 1, -1))


def _three_finest(pyramid: Pyramid) -> tuple[int, ...] | None:
    """Levels of a pair whose start is good to some pixels; None: all that the template has."""
    return (2, 1, 0) if len(pyramid.levels) > 2 else None
