"""Second pass over a shot: every frame again, to keyframes whose cameras and lens are now known.

The running estimate was good enough to stay locked; the refined one takes the last tenths of a pixel out of the
warp, so that residual flow is measured where the linearisation holds. Poses come from the flow, not from the warp: a
pair whose warp was good in the first pass already is kept as it is, and its pixels are not looked at again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib.records import Solution
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit, PairStatus
from mosaic.template import PreparedTemplate, prepare
from pipelines.bridge import CameraPose, Rolling, RotationZoomFamily, pair_state
from pipelines.config import RegistrationOptions
from pipelines.keyframe_graph import distance_in_widths
from pipelines.tracking import ShotTracker

# Keyframes that a frame is registered to: two where the second is hardly farther than the nearest, so that nothing
# jumps where they change places.
LINKS = 2
SECOND = 2.0
# A first-pass pair as good as this is kept, if the refined cameras explain it. Registered again, and to two keyframes,
# cameras of such frames move by .02 px rms on generator clips and .05 px on real ones (largest .07 and .3): no nearer
# to the truth, and no smoother (focal's step error .00002, pan's .0003 degrees, both ways).
SURE_SCORE, SURE_PX = 0.3, 0.5


@dataclass(slots=True, eq=False)
class Retracker:
    """Registers a shot's frames against its keyframes with held cameras. `approximate` has a pose for every frame.
    rolling: of the shot's shutter, if there is one. Safe to use from several threads."""

    tracker: ShotTracker
    approximate: Solution
    options: RegistrationOptions
    register_options: RegisterOptions = field(default_factory=RegisterOptions)
    rolling: Rolling | None = None
    _row: dict[int, int] = field(init=False)
    _sure: dict[tuple[int, int], PairFit] = field(init=False)
    _prepared: dict[int, PreparedTemplate] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self._row = {int(f): i for i, f in enumerate(self.approximate.frames)}
        # Through a warp without the shutter a pair keeps a part of it to itself (readout.py).
        first = self.tracker.fits if self.rolling is None else []
        self._sure = {(f.src, f.dst): f for f in first if self._is_sure(f)}

    def pose(self, frame: int) -> CameraPose | None:
        """The approximate camera of a frame, or None where the first pass has none."""
        row = self._row.get(frame)
        if row is None or not np.isfinite(self.approximate.log_f[row]):
            return None
        return CameraPose(log_f=float(self.approximate.log_f[row]), R=self.approximate.R[row])

    def _is_sure(self, fit: PairFit) -> bool:
        """Whether a pair of the first pass was found in the camera's own parameters, beyond doubt."""
        row = self._row.get(fit.dst)
        return (
            fit.status == PairStatus.OK
            and fit.route == "predicted"
            and fit.score < SURE_SCORE
            and fit.src in self.tracker.keyframes
            and row is not None
            and bool(self.approximate.rms_px[row] < SURE_PX)
        )

    def register(self, frame: int, pyramid: Callable[[], Pyramid]) -> list[PairFit]:
        """Fits of one frame to its nearest keyframes; none where the first pass has no camera for it.

        pyramid: of the frame, asked for only where no pair of it is sure."""
        pose = self.pose(frame)
        if pose is None or frame in self.tracker.keyframes:
            return []  # keyframes were registered to each other until they settled, and are held
        near = self._nearest(frame, pose)
        wanted = [index for distance, index in near[:LINKS] if distance <= SECOND * near[0][0] + 0.02]
        sure = [self._sure[index, frame] for index in wanted if (index, frame) in self._sure]
        if sure:
            return sure
        fits = []
        for index in wanted:
            key_pose = self.pose(index)
            if key_pose is None:
                continue
            fit, _ = align(
                self._bound(index, key_pose, frame),
                pyramid(),
                pair_state(key_pose, pose),
                dst=frame,
                levels=(1, 0),
                options=self.register_options,
                route="refined",
            )
            fits.append(fit)
        return fits

    def _bound(self, index: int, pose: CameraPose, frame: int) -> PreparedTemplate:
        with self._lock:
            if index not in self._prepared:
                if len(self._prepared) > 24:
                    self._prepared.pop(next(iter(self._prepared)))
                plain = RotationZoomFamily(lens=self.approximate.lens, log_f_src=pose.log_f)
                family = plain if self.rolling is None else self.rolling.family(plain, index)
                self._prepared[index] = prepare(self.tracker.keyframes[index].template, family)
            bound = self._prepared[index]
        return bound if self.rolling is None else self.rolling.seen(bound, frame)

    def _nearest(self, frame: int, pose: CameraPose) -> list[tuple[float, int]]:
        """(displacement in widths, keyframe), nearest first; at least `min_overlap` of the picture in common."""
        found = []
        width = self.tracker.size_px[0]
        for index in self.tracker.keyframes:
            other = self.pose(index)
            if other is None or index == frame:
                continue
            distance = distance_in_widths(other, pose, width)
            if distance < 1.0 - self.options.min_overlap:
                found.append((distance, index))
        return sorted(found)
