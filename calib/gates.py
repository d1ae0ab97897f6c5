"""Whether a focal length may be published, with its honest error bar; otherwise a reason. Never a guess.

The error bar is the statistical one and what `systematic` finds of errors that all edges share. Sources: calibration.md
7; real-footage.md 6.5 to 6.8, whose limits are in px at W = 1280 and scale with the width.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib import distortion, rotation
from calib.edges import common_variance
from calib.records import HomographyGraph, Solution, Verdict
from calib.refine import RefineOptions
from calib.systematic import distortion_extreme, sigma_parts

Array = NDArray[np.float64]

SENTENCES = {
    "ok": "The focal length is known with the stated error.",
    "too_few_edges": "Fewer than two frames could be linked, so there is nothing to calibrate from.",
    "not_converged": "The calibration did not reach an optimum.",
    "linear_invalid": "No pair of frames gives a real focal length: the motion does not look like a rotation.",
    "focal_unobservable": "The motion constrains the focal length too weakly.",
    "no_rotation": "The camera hardly turns, and only a turn reveals the focal length.",
    "zoom_only": "The camera zooms without turning; that gives the zoom ratio but not the focal length.",
    "roll_only": "The camera only rolls about its viewing direction, which does not reveal the focal length.",
    "perspective_signal_below_systematics": "The perspective of this motion is smaller than the measuring errors.",
    "model_misfit": "The measurements contradict a camera that only turns and zooms.",
    "distortion_not_modelled": "The lens distortion was held fixed without being known, which biases the focal length.",
    "pp_at_border": "The principal point ended at an impossible place, so the model does not describe this shot.",
    "focal_out_of_range": "The focal length that fits is outside what broadcast lenses have.",
    "band_only": "Texture was found only in a narrow band of the picture, and such focal lengths are wrong.",
    "ambiguous": "Two different focal lengths explain the measurements equally well.",
    "distortion_invalid": "The lens distortion that fits folds the picture over itself.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class GateOptions:
    """Limits of a focal claim; px are at W = 1280 and scale with the width.

    max_sigma: largest relative error worth a claim. systematic_floor_px: smallest systematic error ever assumed.
    coherent_gain, shared_gain: systematic px per px of smooth residual, of single edges and of what edges share.
    unknown_shared_px: the latter where fewer than four edges cannot say (the typical value of real clips).
    The S10 gate follows: S10 >= s_px is the same as a signal part of at most 10 %, and s_px never falls below the
    floor. Simulated tracks with a pupil .6 m in front of the axis (30): errors 6 % rms, stated 7.6 %, all inside two
    sigma; without: .3 to .4 % rms, stated 1.4 %. max_chi2_dof: 2.4 to 3.4 is normal on
    real clips that work, 7 where tracking failed. pp_x_sigmas of the prior; pp_y_px (parallax ends there).
    f_range_w in widths. min_rows of 5 grid rows with texture; row_share of all cells makes a row count.
    min_rotation_w: motion of the centre, in widths, below which a shot "hardly turns".
    refits: measure halves and constant k (three warm refinements); False leaves these parts at 0.
    pupil_share: of what taking out a pupil's parallax did to log f: the scene is no level pitch and upright wall. On
    generator clips of a stadium with rising tiers and of a hall (6) a tenth to a third of it was left as an error.
    """

    max_sigma: float = 0.1
    systematic_floor_px: float = 0.05
    coherent_gain: float = 0.5
    shared_gain: float = 1.0
    unknown_shared_px: float = 0.2
    max_chi2_dof: float = 6.0
    inflated_chi2_dof: float = 1.5
    pp_x_sigmas: float = 3.0
    pp_y_px: float = 60.0
    f_range_w: tuple[float, float] = (0.3, 20.0)
    min_rows: int = 3
    row_share: float = 0.03
    min_rotation_w: float = 0.02
    refits: bool = True
    pupil_share: float = 0.25
    refine: RefineOptions = field(default_factory=RefineOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """What the camera did: turn of the viewing direction and roll (rad, largest between frames), centre motion in

    widths, zoom range as a ratio.
    """

    turn_rad: float
    roll_rad: float
    centre_w: float
    zoom_range: float


def motion(solution: Solution) -> Motion:
    """Extent of the motion of a solution's cameras, NaN rows left out."""
    fine = np.isfinite(solution.log_f)
    if fine.sum() < 2:
        return Motion(turn_rad=0.0, roll_rad=0.0, centre_w=0.0, zoom_range=1.0)
    R, log_f = solution.R[fine], solution.log_f[fine]
    axis = R[:, 2, :]
    turn = np.arccos(np.clip(axis @ axis.T, -1, 1))
    # arccos loses small angles; the chord keeps them.
    chord = np.linalg.norm(axis[:, None] - axis[None], axis=-1)
    turn = np.where(chord < 0.1, chord, turn)
    _, _, roll = rotation.to_pan_tilt_roll(R)
    f = np.exp(log_f)
    centre = np.max(turn * np.sqrt(f[:, None] * f[None])) / solution.lens.size_px[0]
    return Motion(
        turn_rad=float(turn.max()), roll_rad=float(np.ptp(np.unwrap(roll))), centre_w=float(centre),
        zoom_range=float(np.exp(np.ptp(log_f))),
    )  # fmt: skip


def support_rows(graph: HomographyGraph, edge_ok: NDArray[np.bool_], row_share: float) -> int:
    """Rows of the 5-row grid that carry at least row_share of all known cells of the accepted edges."""
    counts = np.zeros(5)
    for edge, ok in zip(graph.edges, edge_ok, strict=True):
        if ok:
            known = np.trace(edge.info, axis1=1, axis2=2) > 1
            row = np.clip((edge.grid_a[known, 1] + 0.5) / graph.size_px[1] * 5, 0, 4.999).astype(int)
            counts += np.bincount(row, minlength=5)
    return int(np.sum(counts > row_share * max(counts.sum(), 1)))


def judge(
    solution: Solution,
    graph: HomographyGraph,
    options: GateOptions | None = None,
    *,
    pupil_shift_log_f: float = 0.0,
) -> Verdict:
    """The gates, in the order in which they explain a failure best, and the total error bar.

    graph: the one the solution was refined on (same edges). pupil_shift_log_f: what fit_pupil() did to the mean log f
    on the way here. Returns a Verdict; it never raises on bad data.
    """
    options = options or GateOptions()
    if len(solution.edge_ok) != len(graph.edges) or len(solution.frames) != len(graph.frames):
        raise ValueError("judge() needs the graph that the solution was refined on")
    moved = motion(solution)
    rows = support_rows(graph, solution.edge_ok, options.row_share)
    usable = np.isfinite(solution.sigma_mean_log_f) and np.isfinite(solution.log_f).sum() >= 2
    parts = sigma_parts(solution, graph, options) if usable else {}
    total = float("nan")
    if usable:
        parts["pupil"] = options.pupil_share * abs(pupil_shift_log_f)
        names = ("cluster", "signal", "halves", "constant_k", "pupil")
        total = float(np.sqrt(sum(parts[k] ** 2 for k in names)))
    reason = _reason(solution, graph, options, parts, total, rows, moved) if usable else _unusable(solution)
    return Verdict(
        claims_focal=reason == "ok", reason=reason, sentence=SENTENCES[reason], sigma_log_f_total=total,
        sigma_parts=parts, s10_px=solution.s10_px, chi2_dof=solution.chi2_dof, support_rows=rows,
        rotation_deg=float(np.rad2deg(moved.turn_rad)), zoom_range=moved.zoom_range,
        flags=_flags(solution, graph, options, parts) if usable else (),
    )  # fmt: skip


def _unusable(solution: Solution) -> str:
    if len(solution.frames) == 1:
        return "no_rotation"  # one keyframe did for the whole shot: a second one is taken as soon as the camera moves
    return "too_few_edges" if solution.stop == "no_edges" else "not_converged"


def _reason(
    solution: Solution, graph: HomographyGraph, options: GateOptions, parts: dict[str, float], total: float,
    rows: int, moved: Motion,
) -> str:  # fmt: skip
    W = graph.size_px[0]
    if solution.chi2_dof > options.max_chi2_dof:
        return "model_misfit"
    if not (total <= options.max_sigma and parts["signal"] <= 0.1):
        if moved.centre_w < options.min_rotation_w:
            if moved.zoom_range > 1.03:
                return "zoom_only"
            return "roll_only" if moved.roll_rad > np.deg2rad(1.5) else "no_rotation"
        if not solution.converged:
            return "not_converged"
        return "perspective_signal_below_systematics" if parts["signal"] > 0.1 else "focal_unobservable"
    if not solution.converged:
        return "not_converged"
    if solution.linear_valid == 0:
        return "linear_invalid"
    priors = solution.priors
    if solution.lens_std.get("c0", 0.0) == 0 and priors.c0_std > 0.005:
        return "distortion_not_modelled"
    if not np.all(_invertible(solution)):
        return "distortion_invalid"
    log_f_w = solution.log_f[np.isfinite(solution.log_f)] - np.log(W)
    low, high = np.log(options.f_range_w[0]), np.log(options.f_range_w[1])
    if (log_f_w < low).any() or (log_f_w > high).any():
        return "focal_out_of_range"
    offset = np.abs(solution.lens.pp_px - priors.pp_mean_px(graph.size_px))
    if offset[0] > options.pp_x_sigmas * priors.pp_std_x * W or offset[1] > options.pp_y_px * W / 1280:
        return "pp_at_border"
    if rows < options.min_rows:
        return "band_only"
    return "ambiguous" if _ambiguous(solution, total) else "ok"


def _invertible(solution: Solution) -> NDArray[np.bool_]:
    W, H = solution.lens.size_px
    k1 = solution.lens.k1_half(solution.log_f[np.isfinite(solution.log_f)])
    return np.asarray(distortion.fold_square(k1, solution.lens.k2) > 1 + (H / W) ** 2)


def _ambiguous(solution: Solution, total: float) -> bool:
    if len(solution.starts) < 2:
        return False
    kappa = common_variance(solution.edge_kappa[solution.edge_ok], solution.chi2_dof)
    best = min(solution.starts, key=lambda s: s.cost)
    return any(
        abs(s.mean_log_f_over_w - best.mean_log_f_over_w) > max(total, 0.02)
        and (s.cost - best.cost) / kappa < 10
        for s in solution.starts
        if s.converged
    )


def _flags(
    solution: Solution, graph: HomographyGraph, options: GateOptions, parts: dict[str, float]
) -> tuple[str, ...]:
    W, priors = graph.size_px[0], solution.priors
    flags = []
    if solution.chi2_dof > options.inflated_chi2_dof:
        flags.append("inflated")
    if (~solution.edge_ok).any():
        flags.append("bad_edges")
    if not np.isfinite(solution.log_f).all():
        flags.append("unlinked_frames")
    if abs(solution.lens.pp_px[1] - priors.pp_mean_px(graph.size_px)[1]) > 2 * priors.pp_std_y * W:
        flags.append("effective_pp")
    if distortion_extreme(solution):
        flags.append("distortion_extreme")
    if max(parts["halves"], parts["constant_k"]) > max(parts["cluster"], parts["signal"]):
        flags.append("subsets_disagree")
    if priors.aspect_std == 0:
        flags.append("aspect_assumed")
    return tuple(flags)
