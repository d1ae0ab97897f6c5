"""The running calibrator: keyframes are adjusted as they come, every other frame is one small solve against them.

Constant work: the adjustment runs over a window of keyframes (the most recent, and older ones that they link to), older
keyframes follow the common focal. A restart at a cut is a new object. Deterministic; no clock, no randomness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib import rotation, serial
from calib.gates import GateOptions
from calib.problem import AdaptiveLoss, Linearised, Packed, State, linearise, pack, robust_scale
from calib.records import HomographyEdge, HomographyGraph, Lens, Priors, Solution
from calib.refine import RefineOptions, refine
from calib.starts import state_from_solution
from calib.systematic import systematic_px

Array = NDArray[np.float64]

MAX_POSE_STEPS = 15
SETTLED_DECREMENT = 1e-2  # Newton decrement: a tenth of a step's standard deviation, squared
MAX_LOG_F_STEP, MAX_TURN_RAD = 0.3, 0.2  # of one step
# The previous frame's edge alone is trusted for the velocity while it stays this near to all edges together.
ALONE_LOG_F, ALONE_TURN_RAD = 0.1, 0.05
FAR_SCALE = 100.0  # robust residual scale, in stated sigmas (10 px), from which a guess is not worth refining

SENTENCES = {
    "ok": "The focal length is known with the stated error.",
    "not_ready": "The motion so far does not reveal the focal length; zoom ratio and motion are relative.",
    "no_edges": "No measurement links this frame to a known one.",
    "predicted": "Continued from the last motion; nothing was measured in this frame.",
    "diverged": "The measurements of this frame contradict the calibrated camera.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningOptions:
    """How the running calibrator works.

    window: keyframes adjusted together; linked: how many of them may be older ones with an edge into the recent ones.
    cold_at: keyframe counts at which the adjustment starts from scratch (multistart), so that an early wrong basin does
    not last. max_scale: robust residual scale, in stated sigmas, beyond which a frame's pose is refused.
    keep_frames: recent poses kept so that edges may name them. max_keyframes: the oldest but the first are forgotten
    beyond it, so that memory and work stay bounded however long the shot.
    two_view_motion, two_view_growth: rms motion in widths, and its growth since, at which the first keyframe and the
    newest frame are calibrated from scratch while there is no second keyframe (.1 s each). max_sigma: total relative
    focal error up to which the focal may be used (`ready`).
    """

    window: int = 24
    linked: int = 8
    cold_at: tuple[int, ...] = (2, 3, 5, 8, 13)
    max_scale: float = 8.0
    keep_frames: int = 8
    max_keyframes: int = 512
    two_view_motion: float = 0.005
    two_view_growth: float = 1.25
    max_sigma: float = 0.1
    refine: RefineOptions = field(default_factory=RefineOptions)
    gates: GateOptions = field(default_factory=GateOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraEstimate:
    """One frame: log_f of px, R (3, 3) = R_cam_world (world = axes of the first keyframe), relative errors, lens.

    sigma_log_f: total error of log f (inf before anything is known); sigma_log_zoom: relative to the first keyframe.
    ready: the focal may be used. status: 'ok', 'relative' (not ready), 'lost', 'predicted'; reason: code of SENTENCES.
    """

    frame: int
    log_f: float
    R: Array
    sigma_log_f: float
    sigma_log_zoom: float
    ready: bool
    lens: Lens
    status: str
    reason: str


@dataclass(slots=True)
class _Pose:
    log_f: float
    R: Array
    anchors: tuple[int, ...] = ()


class RunningCalibrator:
    """Calibrates while frames arrive. add_keyframe() for keyframes, update() for every other frame, in order."""

    def __init__(
        self, size_px: tuple[int, int], priors: Priors | None = None, options: RunningOptions | None = None
    ) -> None:
        self.size_px = (int(size_px[0]), int(size_px[1]))
        self.priors, self.options = priors or Priors(), options or RunningOptions()
        self._keyframes: list[int] = []
        self._edges: list[HomographyEdge] = []
        self._poses: dict[int, _Pose] = {}
        self._recent: dict[int, _Pose] = {}
        self._solution: Solution | None = None
        self._systematic = math.inf
        self._last: int | None = None
        self._velocity: tuple[float, Array] | None = None
        self._two_view_motion = 0.0
        self._sigma = (math.inf, math.inf)

    # ------------------------------------------------------------------ what is known
    @property
    def solution(self) -> Solution | None:
        """The last adjustment of keyframes (of the window), in world axes; None before two keyframes exist."""
        return self._solution if len(self._keyframes) > 1 else None

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Frame numbers of the keyframes that are kept."""
        return tuple(self._keyframes)

    @property
    def lens(self) -> Lens:
        """The lens as known now (the priors' at first)."""
        if self._solution is not None:
            return self._solution.lens
        pp = self.priors.pp_mean_px(self.size_px)
        return Lens(
            size_px=self.size_px,
            pp_px=pp,
            aspect=self.priors.aspect,
            c0=self.priors.c0_mean,
            c1=self.priors.c1_mean,
            k2=self.priors.k2_mean,
        )

    @property
    def sigma_log_f(self) -> float:
        """Total relative error of the common focal: statistical and systematic (10 % x s_px / S10)."""
        return math.hypot(self._sigma[0], self._systematic)

    @property
    def ready(self) -> bool:
        """Whether the focal may be used: error below max_sigma, measurements that fit."""
        s = self._solution
        return (
            s is not None and s.converged and self.sigma_log_f <= self.options.max_sigma
            and s.chi2_dof <= self.options.gates.max_chi2_dof
        )  # fmt: skip

    def pose(self, frame: int) -> tuple[float, Array] | None:
        """log f and R of a keyframe or recent frame, None when not known (any more)."""
        found = self._poses.get(frame) or self._recent.get(frame)
        return None if found is None else (found.log_f, found.R)

    # ------------------------------------------------------------------ keyframes
    def add_keyframe(self, frame: int, edges: Sequence[HomographyEdge] = ()) -> CameraEstimate:
        """Make `frame` a keyframe; edges link it to earlier keyframes. Adjusts the window of keyframes.

        The first keyframe defines the world axes. Raises ValueError: edges with frames that are no keyframes.
        """
        for edge in edges:
            if frame not in (edge.a, edge.b) or not ({edge.a, edge.b} - {frame}) <= set(self._keyframes):
                raise ValueError(
                    f"edge {edge.a} -> {edge.b} does not link keyframe {frame} to an earlier keyframe"
                )
        if frame in self._poses:
            raise ValueError(f"{frame} is a keyframe already")
        before = self.pose(frame)
        if not self._keyframes:
            log_f = self.priors.log_f_mean + math.log(self.size_px[0])
            self._keyframes.append(frame)
            self._poses[frame] = _Pose(log_f, np.eye(3))
            self._remember(frame, self._poses[frame])
            return self._estimate(frame, self._poses[frame], "relative", "not_ready")
        self._edges.extend(edges)
        if before is None:
            guess = self.update(frame, edges)
            before = (guess.log_f, guess.R) if guess.status in ("ok", "relative") else None
        if before is None:
            # Nothing links it: kept as a keyframe at the predicted pose; later edges may correct it.
            predicted = self.predict(frame)
            before = (predicted.log_f, predicted.R)
        self._keyframes.append(frame)
        self._poses[frame] = _Pose(*before)
        self._adjust()
        pose = self._poses[frame]
        self._remember(frame, pose)
        if not edges:
            return self._estimate(frame, pose, "lost", "no_edges")
        return self._estimate(frame, pose, *self._standing())

    def _standing(self) -> tuple[str, str]:
        """Status and reason of a frame that was measured."""
        return ("ok", "ok") if self.ready else ("relative", "not_ready")

    def _window(self) -> list[int]:
        """Keyframes to adjust: the most recent ones, and older ones that edges tie to them most."""
        recent = self._keyframes[-self.options.window :]
        if len(self._keyframes) <= self.options.window:
            return list(recent)
        recent = self._keyframes[-(self.options.window - self.options.linked) :]
        inside = set(recent)
        ties: dict[int, int] = {}
        for edge in self._edges:
            for mine, other in ((edge.a, edge.b), (edge.b, edge.a)):
                if mine in inside and other not in inside:
                    ties[other] = ties.get(other, 0) + 1
        older = sorted(ties, key=lambda f: (-ties[f], -f))[: self.options.linked]
        # Fill up with the youngest of the rest: chains need neighbours.
        for f in reversed(self._keyframes):
            if len(older) >= self.options.linked:
                break
            if f not in inside and f not in older:
                older.append(f)
        chosen = inside | set(older)
        return [f for f in self._keyframes if f in chosen]

    def _adjust(self) -> None:
        """Refine the window's keyframes; older ones follow the common focal, and the oldest are forgotten."""
        window = self._window()
        members = set(window)
        edges = tuple(e for e in self._edges if e.a in members and e.b in members)
        graph = HomographyGraph(frames=np.array(window), edges=edges, size_px=self.size_px)
        anchor = self._poses[window[0]]
        options = replace(self.options.refine, reference=window[0])
        cold = len(self._keyframes) in self.options.cold_at and len(self._keyframes) == len(window)
        start = None if cold or self._solution is None else self._known(window)
        solution = refine(graph, start=start, priors=self.priors, options=options)
        if start is None and not solution.converged and self._solution is not None:
            solution = refine(graph, start=self._known(window), priors=self.priors, options=options)
        fine = np.isfinite(solution.log_f)
        if not fine.any():
            return
        solution = replace(solution, R=solution.R @ anchor.R, reference=window[0])
        rows = [k for k in range(len(window)) if fine[k]]
        shift = float(np.mean([solution.log_f[k] - self._poses[window[k]].log_f for k in rows]))
        old_anchor = _Pose(anchor.log_f, anchor.R)
        for k in rows:
            self._poses[window[k]] = _Pose(float(solution.log_f[k]), solution.R[k])
        rest = [f for f in self._keyframes if f not in members]
        if rest:
            # The rest follows the common focal: log f by the shift, angles to the window by its inverse.
            turns = rotation.log(np.array([self._poses[f].R for f in rest]) @ old_anchor.R.T) * math.exp(
                -shift
            )
            for f, R in zip(rest, rotation.exp(turns) @ old_anchor.R, strict=True):
                self._poses[f] = _Pose(self._poses[f].log_f + shift, R)
        self._solution = self._regauge(solution)
        self._score(self._solution, graph)
        # The first keyframe stays: its axes are the world's.
        while len(self._keyframes) > max(self.options.max_keyframes, self.options.window + 1):
            oldest = next((k for k in self._keyframes[1:] if k not in members), None)
            if oldest is None:
                break
            self._keyframes.remove(oldest)
            del self._poses[oldest]
        keep = set(self._keyframes[-2 * self.options.window :]) | members
        self._edges = [e for e in self._edges if e.a in keep and e.b in keep]

    def _regauge(self, solution: Solution) -> Solution:
        """World axes = axes of the first keyframe, also after it has followed a change of focal from outside."""
        turn = self._poses[self._keyframes[0]].R.T
        for poses in (self._poses, self._recent):
            turned = rotation.orthonormalise(np.array([pose.R for pose in poses.values()]) @ turn)
            for (f, pose), R in zip(list(poses.items()), turned, strict=True):
                poses[f] = _Pose(pose.log_f, R, pose.anchors)
        self._poses[self._keyframes[0]].R = np.eye(3)
        return replace(solution, R=solution.R @ turn)

    def _score(self, solution: Solution, graph: HomographyGraph) -> None:
        """Take over the errors of a solution: statistical, of zoom, and systematic (10 % x s_px / S10)."""
        s_px = systematic_px(solution, graph, self.options.gates)["systematic_px"]
        self._systematic = 0.1 * s_px / solution.s10_px if solution.s10_px > 0 else math.inf
        sigma = solution.sigma_mean_log_f
        zoom = (
            float(np.nanmax(solution.sigma_log_zoom))
            if np.isfinite(solution.sigma_log_zoom).any()
            else math.inf
        )
        self._sigma = (sigma if np.isfinite(sigma) else math.inf, zoom)

    def _known(self, frames: Sequence[int]) -> Solution:
        """A bare solution of known poses, for solvers that want a start or held frames."""
        poses = [self._poses.get(f) or self._recent[f] for f in frames]
        n = len(poses)
        return Solution(
            frames=np.array(frames), log_f=np.array([p.log_f for p in poses]), R=np.array([p.R for p in poses]),
            lens=self.lens, reference=int(frames[0]), sigma_log_f=np.zeros(n), sigma_log_zoom=np.zeros(n),
            cov_rot=np.zeros((n, 3, 3)), sigma_mean_log_f=np.nan, sigma_mean_formal=np.nan, lens_std={},
            chi2_dof=np.nan,
            s10_px=0.0, edge_chi2=np.zeros(0), edge_kappa=np.zeros(0), edge_ok=np.zeros(0, bool), rms_px=np.zeros(n),
            converged=True, stop="held", n_steps=0, cost=np.nan, priors=self.priors,
        )  # fmt: skip

    # ------------------------------------------------------------------ frames
    def update(self, frame: int, edges: Sequence[HomographyEdge]) -> CameraEstimate:
        """The camera of one frame from edges to keyframes or recent frames (either direction), lens and those held."""
        known = self._usable(frame, edges)
        if known and len(self._keyframes) == 1:
            self._two_view(frame, known)
            known = self._usable(frame, known)
        if not known:
            return self._lost(frame, "no_edges")
        solved = self._solve(frame, known)
        if solved is None:
            return self._lost(frame, "diverged")
        pose, own, alone = solved
        self._measure_velocity(frame, pose, alone)
        self._remember(frame, pose)
        return self._estimate(frame, pose, *self._standing(), own)

    def _usable(self, frame: int, edges: Sequence[HomographyEdge]) -> list[HomographyEdge]:
        """Edges between `frame` and a frame whose pose is known."""
        mine = [(e, e.b if e.a == frame else e.a) for e in edges if frame in (e.a, e.b)]
        return [e for e, other in mine if other in self._poses or other in self._recent]

    def _solve(self, frame: int, edges: Sequence[HomographyEdge]) -> tuple[_Pose, float, _Pose | None] | None:
        """The frame's pose against held ones, its own error of log f, and its pose by the previous frame alone.

        None: too few measurements, no convergence, or residuals beyond options.max_scale."""
        others = sorted({e.b if e.a == frame else e.a for e in edges})
        graph = HomographyGraph(frames=np.array([*others, frame]), edges=tuple(edges), size_px=self.size_px)
        packed = pack(graph)
        if packed.dof.sum() < 8:
            return None
        poses = [self._poses.get(f) or self._recent[f] for f in others]
        shared = self.lens.shared(packed.log_f_pp)[None]
        row = len(others)
        first = packed.ia == row
        loss = AdaptiveLoss(packed.dof, self.options.refine.huber)

        def look_at(guess: _Pose | None) -> tuple[State, Linearised] | None:
            if guess is None:
                return None
            log_f = np.array([[*(p.log_f for p in poses), guess.log_f]])
            state = State(log_f, np.array([[*(p.R for p in poses), guess.R]]), shared)
            lin = linearise(packed, state, loss, pose_only=True)
            return (state, lin) if np.isfinite(lin.cost[0]) else None

        # The constant-velocity guess is a few px off; where it is not, chain along the measured homographies.
        found = look_at(self._extrapolated(frame))
        if found is None or robust_scale(found[1].e2, packed.dof)[0] > FAR_SCALE:
            found = look_at(self._chained(packed, graph)) or found
        if found is None:
            return None
        state, lin = found
        normal, settled = np.eye(4), False
        for _ in range(MAX_POSE_STEPS):
            blocks, gradient = lin.blocks[0], lin.gradient[0]
            normal = np.where(first[:, None, None], blocks[:, 0:4, 0:4], blocks[:, 4:8, 4:8]).sum(0)
            right = np.where(first[:, None], gradient[:, 0:4], gradient[:, 4:8]).sum(0)
            try:
                step = np.linalg.solve(normal, right)
            except np.linalg.LinAlgError:
                return None
            # A step so small is taken and not looked at again.
            settled = float(step @ right) < SETTLED_DECREMENT
            turn = float(np.abs(step[1:]).max())
            step = step / max(1.0, abs(step[0]) / MAX_LOG_F_STEP, turn / MAX_TURN_RAD)
            move = np.zeros((1, row + 1, 4))
            move[0, row] = step
            state = state.moved(move, np.zeros_like(shared))
            if settled:
                break
            lin = linearise(packed, state, loss, pose_only=True)
            if not np.isfinite(lin.cost[0]):
                return None
        if not settled:
            return None
        scale = float(robust_scale(lin.e2, packed.dof)[0])
        if scale > self.options.max_scale:
            return None
        try:
            own = math.sqrt(max(float(np.linalg.inv(normal)[0, 0]), 0.0)) * scale
        except np.linalg.LinAlgError:
            return None
        alone = self._direct_pose(frame, edges, state, row, lin)
        return _Pose(float(state.log_f[0, row]), state.R[0, row], tuple(others)), own, alone

    def _direct_pose(
        self, frame: int, edges: Sequence[HomographyEdge], state: State, row: int, lin: Linearised
    ) -> _Pose | None:
        """Pose by the edge to the previous frame alone: one Gauss-Newton step from the full one (< 1 px apart)."""
        which = [k for k, e in enumerate(edges) if {e.a, e.b} == {self._last, frame}]
        if not which:
            return None
        k = which[0]
        part = slice(0, 4) if edges[k].a == frame else slice(4, 8)
        try:
            step = np.linalg.solve(lin.blocks[0, k][part, part], lin.gradient[0, k][part])
        except np.linalg.LinAlgError:
            return None
        if abs(step[0]) > ALONE_LOG_F or np.abs(step[1:]).max() > ALONE_TURN_RAD:
            return None
        return _Pose(float(state.log_f[0, row] + step[0]), rotation.exp(step[1:]) @ state.R[0, row])

    def _extrapolated(self, frame: int) -> _Pose | None:
        if frame in self._recent:
            return self._recent[frame]
        if self._last is None or self._last not in self._recent:
            return None
        predicted = self.predict(frame)
        return _Pose(predicted.log_f, predicted.R)

    def _chained(self, packed: Packed, graph: HomographyGraph) -> _Pose | None:
        others = [int(f) for f in graph.frames[:-1]]
        state = state_from_solution(packed, graph.frames, self._known(others), 0)
        back = (self._poses.get(others[0]) or self._recent[others[0]]).R
        log_f, R = float(state.log_f[0, -1]), state.R[0, -1] @ back
        return _Pose(log_f, R) if np.isfinite(log_f) and np.isfinite(R).all() else None

    def _two_view(self, frame: int, edges: Sequence[HomographyEdge]) -> None:
        """Before a second keyframe: calibrate (first keyframe, this frame), again as the motion grows."""
        key = self._keyframes[0]
        mine = tuple(e for e in edges if {e.a, e.b} == {key, frame})
        if not mine:
            return
        known = np.trace(mine[0].info, axis1=1, axis2=2) > 1
        if not known.any():
            return
        shift = mine[0].grid_b[known] - mine[0].grid_a[known]
        moved = float(np.sqrt(np.mean(np.sum(shift**2, 1)))) / self.size_px[0]
        if moved < max(self.options.two_view_motion, self.options.two_view_growth * self._two_view_motion):
            return
        graph = HomographyGraph(frames=np.array([key, frame]), edges=mine, size_px=self.size_px)
        solution = refine(graph, priors=self.priors, options=replace(self.options.refine, reference=key))
        self._two_view_motion = moved
        if not np.isfinite(solution.log_f).all():
            return
        self._solution = solution
        self._score(solution, graph)
        self._poses[key] = _Pose(float(solution.log_f[0]), np.eye(3))
        # The other poses were found with another focal: they no longer fit this keyframe.
        self._recent = {key: self._poses[key], frame: _Pose(float(solution.log_f[1]), solution.R[1])}

    # ------------------------------------------------------------------ motion
    def _measure_velocity(self, frame: int, pose: _Pose, alone: _Pose | None) -> None:
        """Velocity a frame from the frame-to-frame edge alone; a keyframe's correction is no motion."""
        last = self._last
        if last is None or last == frame or last not in self._recent:
            return
        dt, before = frame - last, self._recent[last]
        if alone is None:
            # Two poses against the same keyframes carry the same correction, which cancels.
            if not pose.anchors or pose.anchors != before.anchors:
                return
            alone = pose
        turn = rotation.log(alone.R @ before.R.T) / dt
        self._velocity = ((alone.log_f - before.log_f) / dt, turn)

    def predict(self, frame: int) -> CameraEstimate:
        """Constant velocity from the last frame with a measured camera; status 'predicted', errors of that frame."""
        last = self._last
        if last is None:
            raise ValueError("predict() needs at least one frame")
        base = self._recent[last]
        zoom, turn = self._velocity if self._velocity is not None else (0.0, np.zeros(3))
        dt = frame - last
        pose = _Pose(base.log_f + zoom * dt, rotation.orthonormalise(rotation.exp(turn * dt) @ base.R))
        return self._estimate(frame, pose, "predicted", "predicted")

    def _remember(self, frame: int, pose: _Pose) -> None:
        self._recent[frame] = pose
        self._last = frame
        while len(self._recent) > self.options.keep_frames:
            del self._recent[min(self._recent)]

    def _lost(self, frame: int, reason: str) -> CameraEstimate:
        nan = _Pose(math.nan, np.full((3, 3), math.nan))
        return self._estimate(frame, nan, "lost", reason)

    def _estimate(
        self, frame: int, pose: _Pose, status: str, reason: str, own: float = 0.0
    ) -> CameraEstimate:
        return CameraEstimate(
            frame=frame, log_f=pose.log_f, R=pose.R, sigma_log_f=math.hypot(self.sigma_log_f, own),
            sigma_log_zoom=math.hypot(self._sigma[1], own), ready=self.ready and status == "ok", lens=self.lens,
            status=status, reason=reason,
        )  # fmt: skip

    # ------------------------------------------------------------------ persistence
    def state(self) -> dict[str, Any]:
        """Everything as plain JSON values: from_state(state()) goes on to the same numbers."""
        return {
            "size_px": list(self.size_px),
            "priors": serial.to_plain(self.priors),
            "options": serial.to_plain(self.options),
            "keyframes": list(self._keyframes),
            "edges": [serial.to_plain(e) for e in self._edges],
            "poses": [[f, p.log_f, p.R.tolist(), list(p.anchors)] for f, p in self._poses.items()],
            "recent": [[f, p.log_f, p.R.tolist(), list(p.anchors)] for f, p in self._recent.items()],
            "solution": None if self._solution is None else serial.to_plain(self._solution),
            "scalars": [serial.number(x) for x in (self._systematic, self._two_view_motion, *self._sigma)],
            "last": self._last,
            "velocity": None if self._velocity is None else [self._velocity[0], self._velocity[1].tolist()],
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RunningCalibrator:
        """The calibrator that state() described. Raises KeyError or TypeError for a foreign state."""
        self = cls(
            tuple(state["size_px"]),
            serial.from_plain(Priors, state["priors"]),
            serial.from_plain(RunningOptions, state["options"]),
        )
        self._keyframes = list(state["keyframes"])
        self._edges = [serial.from_plain(HomographyEdge, e) for e in state["edges"]]
        self._poses = {f: _Pose(v, np.array(R), tuple(a)) for f, v, R, a in state["poses"]}
        self._recent = {f: _Pose(v, np.array(R), tuple(a)) for f, v, R, a in state["recent"]}
        self._solution = None if state["solution"] is None else serial.from_plain(Solution, state["solution"])
        self._systematic, self._two_view_motion, *sigma = (serial.from_number(x) for x in state["scalars"])
        self._sigma = (sigma[0], sigma[1])
        self._last = state["last"]
        velocity = state["velocity"]
        self._velocity = None if velocity is None else (velocity[0], np.array(velocity[1]))
        return self
