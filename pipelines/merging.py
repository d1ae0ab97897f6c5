"""Whether two shots were taken by one camera: pairs of keyframes across them, and one calibration of both.

Features give a pair its start, the direct estimator verifies it, and a joint refinement must then explain the pairs of
both shots by one lens and one place: another place sees another parallax, which no turn and no zoom explains. A merge
is accepted only with that evidence; every refusal has a reason. What becomes of merged shots: merged_shots.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib import rotation
from calib.covariance import edge_statistics
from calib.gates import GateOptions, judge
from calib.level import level
from calib.problem import Loss, State, pack
from calib.records import Level, Priors, Solution, Verdict
from calib.refine import refine
from mosaic.pyramid import Pyramid
from mosaic.records import PairFit, PairStatus
from mosaic.template import Template
from pipelines.config import Config
from pipelines.kept_shots import KeptShot, ShotShelf
from pipelines.keyframe_graph import KeyframeOptions, KeyframeResult, refine_keyframes, register_pairs
from pipelines.pupil import with_pupil
from pipelines.shot import believed_level
from pipelines.shot_keyframes import refine_options_of
from pipelines.shot_pairs import cross_pairs, spread

SENTENCES = {
    "": "One camera from one place explains the pictures of both shots.",
    "no_camera": "The shot has no keyframe that could be compared.",
    "no_room": "The shot's pictures could not be kept until the end: too many shots for the scratch space.",
    "no_match": "No two pictures of the shots have features in common.",
    "too_few_pairs": "Too few pairs of pictures were verified by direct alignment.",
    "contradicted": "The pairs across the shots contradict one camera that only turns and zooms: another place.",
    "residual": "The pairs across the shots leave more residual than one camera would: another place, or another lens.",
    "focal_disagrees": "The shots' own focal lengths do not agree within their stated errors.",
    "focal_lost": "Together the shots would lose a focal length that one of them has.",
    "focal_unknown": "No focal length is known even for both shots together, so a turn cannot be told from a move.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeOptions:
    """What is looked at and what a merge needs. Lengths in px are at W = 1280 and scale with the width.

    n_first, n_keyframes: keyframes of each side, compared at first, and when something matched. enough_pairs: verified
    pairs after which no more are looked for. min_pairs, min_keyframes: verified pairs, and keyframes of each side in
    them; a shot of a single keyframe may bring that one if min_pairs of a shot with a known focal meet it. kept_share:
    of the pairs across the shots that the joint calibration must keep. rms_px: largest residual of the pairs across;
    rms_ratio, rms_spare_px: and no more than so many times the shots' own and a spare. focal_sigmas: of their stated
    errors, by which the shots' own focals may differ. Measured: one camera again leaves .9 to 1.5 times the shots' own
    residual (six generator pairs, one real one), a camera 1 m closer 2.1 times, .3 m 1.7 times.
    """

    n_first: int = 4
    n_keyframes: int = 8
    enough_pairs: int = 16
    min_pairs: int = 3
    min_keyframes: int = 2
    kept_share: float = 0.6
    rms_px: float = 1.0
    rms_ratio: float = 1.6
    rms_spare_px: float = 0.1
    focal_sigmas: float = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Attempt:
    """A shot held against an earlier group: the outcome and its evidence. facts: JSON-ready."""

    shot: int
    into: int
    reason: str
    facts: dict[str, Any]

    @property
    def accepted(self) -> bool:
        """Whether they are one camera."""
        return self.reason == ""

    def as_dict(self) -> dict[str, Any]:
        """For run.json."""
        sentence = SENTENCES[self.reason]
        return {"shot": self.shot, "into": self.into, "merged": self.accepted, "reason": self.reason,
                "sentence": sentence, **self.facts}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Group:
    """Shots of one camera, and its calibration in the axes of the first shot's reference frame."""

    members: tuple[int, ...]
    result: KeyframeResult
    verdict: Verdict
    level: Level
    templates: dict[int, Template] = field(repr=False)
    owner: dict[int, int] = field(repr=False)  # keyframe -> shot

    @property
    def first(self) -> int:
        """The shot that gives world and reference frame."""
        return self.members[0]


def group_of(shot: KeptShot) -> Group:
    """A shot by itself."""
    return Group(
        members=(shot.index,), result=shot.solved.keyframes, verdict=shot.solved.verdict, level=shot.solved.level,
        templates={k: key.template for k, key in shot.keyframes.items()},
        owner=dict.fromkeys(shot.keyframes, shot.index),
    )  # fmt: skip


def find_groups(
    shelf: ShotShelf, config: Config, options: MergeOptions | None = None
) -> tuple[list[Group], list[Attempt]]:
    """All kept shots in groups of one camera each, and every attempt, in order: each shot against each earlier group
    until one takes it."""
    options = options or MergeOptions()
    groups: list[Group] = []
    attempts: list[Attempt] = []
    for index in shelf.indices:
        shot = shelf.load(index)
        for place, group in enumerate(groups):
            attempt, joined = join(group, shot, shelf, config, options)
            attempts.append(attempt)
            if joined is not None:
                groups[place] = joined
                break
        else:
            groups.append(group_of(shot))
    for index in shelf.left_out:
        attempts.append(Attempt(shot=index, into=-1, reason="no_room", facts={}))
    return groups, attempts


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """Pyramids of the keyframes of several shots, each under its own shot's mask."""

    shelf: ShotShelf
    shots: dict[int, KeptShot]  # by keyframe

    def pyramid(self, frame: int, n_levels: int, mask: NDArray[np.bool_] | None) -> Pyramid:
        """See KeyframePictures.pyramid; the mask handed in is nobody's."""
        return self.shelf.pyramid(self.shots[frame], frame)


def join(
    group: Group, shot: KeptShot, shelf: ShotShelf, config: Config, options: MergeOptions
) -> tuple[Attempt, Group | None]:
    """Hold a shot against a group: the attempt with its evidence, and the larger group where they are one camera."""
    facts: dict[str, Any] = {}

    def refused(reason: str) -> tuple[Attempt, None]:
        return Attempt(shot=shot.index, into=group.first, reason=reason, facts=facts), None

    if not shot.keyframes or not group.templates:
        return refused("no_camera")
    members = [shelf.load(i) for i in group.members]
    shots = {k: s for s in (*members, shot) for k in s.keyframes}
    cross, n_tried, n_matched = cross_pairs(
        spread(group.result.solution, sorted(group.templates), options.n_keyframes),
        spread(shot.solved.keyframes.solution, sorted(shot.keyframes), options.n_keyframes),
        shots, shelf, n_first=options.n_first, enough=options.enough_pairs,
    )  # fmt: skip
    facts |= {"pairs_compared": n_tried, "pairs_matched": n_matched, "pairs_verified": len(cross)}
    if n_matched == 0:
        return refused("no_match")
    facts["overlap"] = max((f.overlap for f in cross), default=0.0)
    if not _enough([(f.src, f.dst) for f in cross], group, shot, options):
        return refused("too_few_pairs")

    templates = group.templates | {k: key.template for k, key in shot.keyframes.items()}
    joint = _calibrated(group, shot, cross, templates, _Pictures(shelf, shots), config)
    if joint is None:
        return refused("contradicted")
    reason = _contradiction(joint, group, shot, options, facts)
    if reason:
        return refused(reason)
    shift = joint.pupil.shift_log_f if joint.pupil is not None else 0.0
    verdict = judge(joint.solution, joint.graph, GateOptions(refine=joint.options), pupil_shift_log_f=shift)
    facts["sigma_relative"] = verdict.sigma_log_f_total
    if not verdict.claims_focal:
        had = group.verdict.claims_focal or shot.solved.verdict.claims_focal
        return refused("focal_lost" if had else "focal_unknown")
    accepted = Attempt(shot=shot.index, into=group.first, reason="", facts=facts)
    return accepted, Group(
        members=(*group.members, shot.index),
        result=joint,
        verdict=verdict,
        level=believed_level(level(joint.solution), verdict),
        templates=templates,
        owner=group.owner | dict.fromkeys(shot.keyframes, shot.index),
    )


def _contradiction(
    joint: KeyframeResult, group: Group, shot: KeptShot, options: MergeOptions, facts: dict[str, Any]
) -> str:
    """What speaks against one camera in the joint calibration, as a reason; '' for nothing. Adds to the facts."""
    edges, ok = joint.graph.edges, joint.solution.edge_ok
    across = np.array([(e.a in group.templates) != (e.b in group.templates) for e in edges], bool)
    usable = [f for f in joint.fits if f.usable]  # edges are made of these, in this order
    tried = [f for f in joint.fits if (f.src in group.templates) != (f.dst in group.templates)]
    kept = [
        (e.a, e.b)
        for e, f, c, k in zip(edges, usable, across, ok, strict=True)
        if c and k and f.status == PairStatus.OK
    ]
    known = _known(joint.solution)
    before = _known(group.result.solution) | _known(shot.solved.keyframes.solution)
    rms = edge_rms_px(joint)
    scale = joint.graph.size_px[0] / 1280
    # Pairs that the joint calibration dropped speak too: all that lie across, not only those that fit.
    between = (
        float(np.median(rms[across & np.isfinite(rms)])) if (across & np.isfinite(rms)).any() else np.nan
    )
    inside = ok & ~across & np.isfinite(rms)
    own = float(np.median(rms[inside])) if inside.any() else np.nan
    limit = options.rms_px * scale
    if np.isfinite(own):
        limit = min(limit, options.rms_ratio * own + options.rms_spare_px * scale)
    differ, allowed = _focals(joint.solution, group, shot, options)
    facts |= {
        "pairs_joint": len(tried),
        "pairs_kept": len(kept),
        "keyframes_lost": len(before - known),
        "residual_px": between,
        "residual_own_px": own,
        "residual_limit_px": limit,
        "focal_difference": differ,
        "focal_difference_allowed": allowed,
        **_turn(joint.solution, shot),
    }
    if not _enough(kept, group, shot, options) or len(kept) < options.kept_share * len(tried):
        return "contradicted"
    if len(before - known) > (1 - options.kept_share) * len(before):
        return "contradicted"
    if not between <= limit:
        return "residual"
    return "focal_disagrees" if np.isfinite(allowed) and not abs(differ) <= allowed else ""


def _enough(pairs: Sequence[tuple[int, int]], group: Group, shot: KeptShot, options: MergeOptions) -> bool:
    """Whether the pairs are enough, from enough keyframes of each side."""
    theirs = {f for pair in pairs for f in pair if f in shot.keyframes}
    ours = {f for pair in pairs for f in pair if f in group.templates}
    if len(pairs) < options.min_pairs:
        return False
    if min(len(theirs), len(ours)) >= options.min_keyframes:
        return True
    # A camera that stands still has one keyframe. Against three others of a known camera its four unknowns are
    # measured three times over; against unknown ones nearly any homography could be explained.
    if len(shot.keyframes) == 1 and group.verdict.claims_focal:
        return len(ours) >= options.min_pairs
    if len(group.templates) == 1 and shot.solved.verdict.claims_focal:
        return len(theirs) >= options.min_pairs
    return False


# ---- one calibration of both


def _calibrated(
    group: Group, shot: KeptShot, cross: list[PairFit], templates: dict[int, Template], pictures: _Pictures,
    config: Config,
) -> KeyframeResult | None:  # fmt: skip
    """Both as if they were one shot, in the axes of the group's reference; None where they do not hold together."""
    own = shot.solved.keyframes
    priors = _priors(shot.priors, group.result.solution.priors, own.solution.priors)
    options = KeyframeOptions(refine=refine_options_of(config), register=shot.register)
    result = refine_keyframes(
        templates, pictures, [*group.result.fits, *own.fits, *cross], size_px=shot.size_px, n_levels=shot.n_levels,
        mask=None, priors=priors, options=options,
    )  # fmt: skip
    reference = group.result.solution.reference
    if reference not in _known(result.solution):
        return None
    if result.solution.reference != reference:
        solution = refine(
            result.graph, start=result.solution.with_reference(reference), priors=priors,
            options=replace(result.options, reference=reference),
        )  # fmt: skip
        result = replace(result, solution=solution)
    result = with_pupil(
        result, lambda solved: register_pairs(templates, pictures, solved, shot.n_levels, None, options)
    )
    return result if result.solution.reference == reference else None


def _priors(priors: Priors, *others: Priors) -> Priors:
    """The shot's priors with the focals that the user gave for any of the shots."""
    known = {k.frame: k for p in others for k in p.known_focals}
    return replace(priors, known_focals=tuple(known[f] for f in sorted(known)))


def _known(solution: Solution) -> set[int]:
    return {int(f) for f in solution.frames[np.isfinite(solution.log_f)]}


def edge_rms_px(result: KeyframeResult) -> NDArray[np.float64]:
    """Rms residual (E,) px of every edge of the result's graph under its cameras; cells of players count less."""
    solution, packed = result.solution, pack(result.graph)
    lens = solution.lens
    shared = np.array([[*lens.pp_px, np.log(lens.aspect), lens.c0, lens.c1]])
    state = State(solution.log_f[None], solution.R[None], shared)
    scale = np.array([max(1.0, float(np.sqrt(np.nan_to_num(solution.chi2_dof, nan=1.0))))])
    with np.errstate(invalid="ignore"):
        return edge_statistics(packed, state, Loss("huber", scale))[3]


def _turn(solution: Solution, shot: KeptShot) -> dict[str, Any]:
    """How the shot's own reference camera is turned and zoomed against the group's."""
    frame = shot.solved.keyframes.solution.reference
    if frame not in _known(solution):
        return {}
    row, ref = solution.index(frame), solution.index(solution.reference)
    pan, tilt, roll = (float(np.degrees(v)) for v in rotation.to_pan_tilt_roll(solution.R[row]))
    return {
        "reference_frames": [solution.reference, frame],
        "rotation_deg": {"pan": pan, "tilt": tilt, "roll": roll},
        "zoom_ratio": float(np.exp(solution.log_f[row] - solution.log_f[ref])),
    }


def _focals(joint: Solution, group: Group, shot: KeptShot, options: MergeOptions) -> tuple[float, float]:
    """By how much the two own focals differ, as a relative error against the zoom ratio that the pairs across measure,
    and what their stated errors allow; NaN where one of them has none."""
    if not (group.verdict.claims_focal and shot.solved.verdict.claims_focal):
        return float("nan"), float("nan")

    def change(own: Solution) -> float:
        both = sorted(_known(own) & _known(joint))
        rows = [(joint.index(f), own.index(f)) for f in both]
        return float(np.mean([joint.log_f[j] - own.log_f[o] for j, o in rows])) if rows else float("nan")

    differ = change(group.result.solution) - change(shot.solved.keyframes.solution)
    sigma = np.hypot(group.verdict.sigma_log_f_total, shot.solved.verdict.sigma_log_f_total)
    return differ, float(options.focal_sigmas * sigma)
