"""Focal, distortion and principal point of a shot: its keyframe pairs registered and refined in turns until they agree.

A pair registered through a wrong lens measures a little of that lens; registering again with the refined one and
refining again converges to a point that no longer depends on the start (measured: half of the error goes per round).
"""

from __future__ import annotations

import logging
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.parallax import Parallax
from calib.pupil import PupilFit
from calib.records import HomographyGraph, Priors, Solution
from calib.refine import RefineOptions, refine
from calib.rolling_shutter import RollingShutter
from mosaic.estimator import RegisterOptions, align
from mosaic.pyramid import Pyramid, build_pyramid, with_scene
from mosaic.records import PairFit
from mosaic.template import Template, prepare
from pipelines.bridge import CameraPose, Rolling, RotationZoomFamily, homography_graph, pair_state
from pipelines.crowd import doubted
from pipelines.shutter import Shutter

log = logging.getLogger(__name__)

# Width of glances, and frames between them: in .16 s a runner has gone half his width. 15 KB of disk each.
GLANCE_PX, GLANCE_EVERY = 160, 4
NEAREST, FARTHEST = (
    4,
    8,
)  # earlier keyframes that each one is paired with: the near ones hold, the far ones measure f


class KeyframePictures(Protocol):
    """Where keyframes' pictures come from: of one shot (KeyframeImages) or of several (merging.py)."""

    def pyramid(self, frame: int, n_levels: int, mask: NDArray[np.bool_] | None) -> Pyramid:
        """See KeyframeImages.pyramid."""
        ...


class KeyframeImages:
    """Gray pictures of keyframes on disk, so that a long shot does not fill the memory, and small ones of frames in
    between: glances. Closed with the shot."""

    def __init__(self, folder: str | os.PathLike[str], *, glances: bool = True) -> None:
        """folder: where the scratch file is made. glances: keep them; without a panorama nobody looks at them."""
        self._wants_glances = glances
        handle, name = tempfile.mkstemp(prefix="keyframes-", suffix=".raw", dir=folder)
        self._file, self._path = handle, Path(name)
        self._where: dict[int, tuple[int, tuple[int, ...], np.dtype[np.generic]]] = {}
        self._scene: dict[int, tuple[NDArray[np.uint8], tuple[int, ...]]] = {}  # 4 KB each at 1080p
        self._glances: dict[int, int] = {}  # frame -> where its small picture lies
        self._glance_size = (0, 0)
        self._end = 0

    def put(self, frame: int, pyramid: Pyramid, scene: NDArray[np.uint8] | None = None) -> None:
        """Keep the smoothed full-size level of a frame. scene: at a quarter of the size, 1 = without its people."""
        level = np.ascontiguousarray(pyramid.levels[0])
        os.pwrite(self._file, level.tobytes(), self._end)
        self._where[frame] = (self._end, level.shape, level.dtype)
        self._end += level.nbytes
        self.put_scene(frame, scene)

    def put_scene(self, frame: int, scene: NDArray[np.uint8] | None) -> None:
        """What of a kept frame is scene, as in `put`, once more is known of it."""
        if scene is not None:
            self._scene[frame] = np.packbits(scene), scene.shape

    def pyramid(self, frame: int, n_levels: int, mask: NDArray[np.bool_] | None) -> Pyramid:
        """The pyramid of a kept frame, under a mask that may be newer than the frame, and without its people."""
        offset, shape, dtype = self._where[frame]
        raw = os.pread(self._file, int(np.prod(shape)) * dtype.itemsize, offset)
        pyramid = build_pyramid(
            np.frombuffer(raw, dtype).reshape(shape), n_levels=n_levels, smooth=False, mask=mask
        )
        if frame not in self._scene:
            return pyramid
        bits, size = self._scene[frame]
        scene = np.unpackbits(bits, count=int(np.prod(size))).reshape(size)
        return with_scene(pyramid, scene)

    def put_glance(self, frame: int, pyramid: Pyramid) -> None:
        """Keep a small picture of a frame, unless one of the GLANCE_EVERY frames before has one. Frames in order."""
        if not self._wants_glances or frame - next(reversed(self._glances), -GLANCE_EVERY) < GLANCE_EVERY:
            return
        width, height = pyramid.size_px
        self._glance_size = (min(width, GLANCE_PX), max(1, round(height * min(width, GLANCE_PX) / width)))
        level = [p for p in pyramid.levels if p.shape[1] >= self._glance_size[0]][-1]
        small = cv2.resize(cast(Any, level), self._glance_size, interpolation=cv2.INTER_AREA)
        eight = np.ascontiguousarray(np.clip(np.rint(small), 0, 255), np.uint8)
        os.pwrite(self._file, eight.tobytes(), self._end)
        self._glances[frame] = self._end
        self._end += eight.nbytes

    @property
    def glances(self) -> tuple[int, ...]:
        """Frames of which there is a small picture, ascending."""
        return tuple(self._glances)

    def glance(self, frame: int) -> NDArray[np.uint8]:
        """The small picture (h, w) of a frame, GLANCE_PX wide or less. Raises KeyError for a frame without one."""
        width, height = self._glance_size
        raw = os.pread(self._file, width * height, self._glances[frame])
        return np.frombuffer(raw, np.uint8).reshape(height, width)

    def close(self) -> None:
        """Remove the file. A second call does nothing: the descriptor's number may be another file's by then."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._path.unlink(missing_ok=True)


CROWDED_SCORE = 0.4  # to which the pairs of keyframes that people fill are believed


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeOptions:
    """max_rounds of registering and refining; settled: change of mean log f at which they stop. max_distance: widths
    between two centres up to which keyframes are paired (1 - overlap). torn_share: unlinked keyframes beyond which the
    full model is given up for a plain one. crowded: keyframes that people fill (pipelines/crowd.py). threads: that
    register."""

    max_rounds: int = 8
    settled: float = 0.001
    max_distance: float = 0.8
    torn_share: float = 0.34
    crowded: frozenset[int] = frozenset()
    threads: int = 1
    register: RegisterOptions = field(default_factory=RegisterOptions)
    refine: RefineOptions = field(default_factory=RefineOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeResult:
    """The refined keyframes with the graph and options they were refined with, its fits, and the rounds it took.

    pupil, readout: what was found of a pupil's parallax and of a rolling shutter, which are then out of solution and
    graph (not out of the fits). shutter: how long it is open, where that shows."""

    solution: Solution
    graph: HomographyGraph
    fits: tuple[PairFit, ...]
    rounds: int
    options: RefineOptions
    pupil: PupilFit | None = None
    readout: RollingShutter | None = None
    shutter: Shutter | None = None

    @property
    def readout_share(self) -> float | None:
        """Of a frame's time, by the rolling shutter; None where none was found."""
        return self.readout.share if self.readout is not None and self.readout.found else None

    @property
    def parallax(self) -> Parallax | None:
        """Of the pupil, in the solution's axes; None where none was found."""
        return None if self.pupil is None else self.pupil.parallax


def pose_of(solution: Solution, frame: int) -> CameraPose | None:
    """A frame's camera in a solution, or None when it is not linked."""
    rows = np.flatnonzero(solution.frames == frame)
    if not len(rows) or not np.isfinite(solution.log_f[rows[0]]):
        return None
    return CameraPose(log_f=float(solution.log_f[rows[0]]), R=solution.R[rows[0]])


def distance_in_widths(a: CameraPose, b: CameraPose, width_px: int) -> float:
    """Displacement of a's centre in b, in widths, plus twice the log zoom ratio beyond 10 %; inf when behind."""
    axis = b.R @ a.R[2]
    if axis[2] <= 0.1:
        return float("inf")
    shift = float(np.hypot(axis[0], axis[1]) / axis[2] * np.exp(min(a.log_f, b.log_f)) / width_px)
    return shift + 2.0 * max(0.0, abs(b.log_f - a.log_f) - 0.1)


def refine_keyframes(
    templates: dict[int, Template],
    images: KeyframePictures,
    first_fits: list[PairFit],
    *,
    size_px: tuple[int, int],
    n_levels: int,
    mask: NDArray[np.bool_] | None,
    priors: Priors,
    options: KeyframeOptions,
    running: Solution | None = None,
) -> KeyframeResult:
    """Refine from the first pass' edges, then alternate registration and refinement (at most max_rounds).

    templates: keyframes by frame number. first_fits: what pass one measured among them. running: the first pass' own
    solution where it can be trusted; it only has to bring the pairs within reach of the first round, which looks for
    the optimum from scratch. Never raises on bad data: the solution says that it did not converge.
    """
    frames = sorted(templates)
    graph = homography_graph(frames, first_fits, size_px)
    refine_options = replace(options.refine, reference=_best_linked(graph))
    solution = refine(graph, start=running, priors=priors, options=refine_options)
    if running is not None and not (solution.converged and np.isfinite(solution.log_f).all()):
        solution = refine(graph, priors=priors, options=refine_options)
    fits = tuple(f for f in first_fits if f.src in templates and f.dst in templates)
    rounds = 0
    for rounds in range(1, options.max_rounds + 1):
        new = register_pairs(templates, images, solution, n_levels, mask, options)
        if not any(f.usable for f in new):
            break
        new_graph = homography_graph(frames, new, size_px)
        # The first round has edges that the chain of pass one lacked: look for the optimum from scratch.
        start = solution if rounds > 1 else None
        refined = refine(
            new_graph,
            start=start,
            priors=priors,
            options=replace(refine_options, reference=_best_linked(new_graph)),
        )
        if not np.isfinite(refined.log_f).any():
            break
        change = float(np.nanmean(refined.log_f) - np.nanmean(solution.log_f))
        solution, graph, fits = refined, new_graph, tuple(new)
        log.debug("keyframe round %d: mean log f moved by %.5f", rounds, change)
        if rounds > 1 and abs(change) < options.settled:
            break
    result = KeyframeResult(solution=solution, graph=graph, fits=fits, rounds=rounds, options=options.refine)
    lost = int((~np.isfinite(solution.log_f)).sum())
    if lost > options.torn_share * len(frames) and len(frames) > 1:
        plain = _without_lens(templates, images, first_fits, n_levels, mask, priors, options, size_px)
        if int((~np.isfinite(plain.solution.log_f)).sum()) < lost:
            return plain
    return result


def _without_lens(
    templates: dict[int, Template],
    images: KeyframePictures,
    first_fits: list[PairFit],
    n_levels: int,
    mask: NDArray[np.bool_] | None,
    priors: Priors,
    options: KeyframeOptions,
    size_px: tuple[int, int],
) -> KeyframeResult:
    """All keyframes in a plain pinhole model, no edge refused: for zoom ratio and homographies where the full model
    tears the graph apart (a wrong lens makes true edges look false). `judge` never claims a focal from it.
    """
    frames = sorted(templates)
    graph = homography_graph(frames, first_fits, size_px)
    plain = replace(
        options.refine, distortion=False, free_pp=False, bad_edge=np.inf, reference=_best_linked(graph)
    )
    solution = refine(graph, priors=priors, options=plain)
    fits = tuple(f for f in first_fits if f.src in templates and f.dst in templates)
    if np.isfinite(solution.log_f).any():
        new = register_pairs(templates, images, solution, n_levels, mask, options)
        # Pairs of the first pass hold the graph together; refined ones of the same frames replace them.
        better = {(f.src, f.dst) for f in new if f.usable}
        fits = (*(f for f in fits if (f.src, f.dst) not in better), *new)
        graph = homography_graph(frames, fits, size_px)
        solution = refine(graph, start=solution, priors=priors, options=plain)
    return KeyframeResult(solution=solution, graph=graph, fits=fits, rounds=1, options=plain)


def _best_linked(graph: HomographyGraph) -> int:
    """A frame of the largest connected part: a reference in a corner that hangs on nothing would lose all the rest."""
    part = {int(f): {int(f)} for f in graph.frames}
    for edge in graph.edges:
        a, b = part[edge.a], part[edge.b]
        if a is not b:
            a |= b
            for frame in b:
                part[frame] = a
    return max((int(f) for f in graph.frames), key=lambda f: (len(part[f]), -f))


def register_pairs(
    templates: dict[int, Template],
    images: KeyframePictures,
    solution: Solution,
    n_levels: int,
    mask: NDArray[np.bool_] | None,
    options: KeyframeOptions,
    rolling: Rolling | None = None,
) -> list[PairFit]:
    """Every keyframe to earlier ones that see the same view, through the solution's lens, from its cameras.

    rolling: of the shot's shutter, if there is one."""
    poses = {frame: pose for frame in templates if (pose := pose_of(solution, frame)) is not None}
    width = solution.lens.size_px[0]
    prepared = {}
    for frame, pose in poses.items():
        family = RotationZoomFamily(lens=solution.lens, log_f_src=pose.log_f)
        prepared[frame] = prepare(templates[frame], rolling.family(family, frame) if rolling else family)

    def register(b: int) -> list[PairFit]:
        near = sorted((distance_in_widths(poses[a], poses[b], width), a) for a in poses if a < b)
        near = [(d, a) for d, a in near if d <= options.max_distance]
        if len(near) > NEAREST + FARTHEST:
            near = near[:NEAREST] + near[-FARTHEST:]
        if not near:
            return []
        target = images.pyramid(b, n_levels, mask)
        levels: tuple[int, ...] | None = (2, 1, 0) if len(target.levels) > 2 else None
        crowded = b in options.crowded
        register_options = options.register
        if crowded:
            # The poses are good to a few pixels, and on a coarse level people reach across their masks.
            levels = (1, 0) if len(target.levels) > 1 else None
            register_options = replace(register_options, score_ok=CROWDED_SCORE)
        fits = [
            align(
                rolling.seen(prepared[a], b) if rolling else prepared[a],
                target,
                pair_state(poses[a], poses[b]),
                dst=b,
                levels=levels,
                options=register_options,
                route="keyframe pair",
            )[0]
            for _, a in near
        ]
        return [doubted(fit) for fit in fits] if crowded else fits

    with ThreadPoolExecutor(options.threads) as workers:
        return list(chain.from_iterable(workers.map(register, sorted(poses))))
