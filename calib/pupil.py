"""The entrance pupil in front of the pan axis: its parallax over a pitch and a stand, estimated and taken out.

A camera's pupil sits some decimetres before the axis that the head turns about, so turning also moves it, and near
things move against far ones: pixels over a dozen degrees, which biases the focal length by several per cent. The scene
is taken for a level pitch below and a stand round about (vertical, at one distance); what the pictures tell are the
ratios of the offset to the axis' height over the pitch and to the stand's distance. Source: real-footage.md 5 and 6.5.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib.camera import SHARED
from calib.edges import common_variance
from calib.level import LevelOptions, level
from calib.parallax import Parallax
from calib.problem import Loss, Packed, PriorTerms, linearise, pack, residuals, state_of
from calib.records import HomographyGraph, Solution
from calib.refine import RefineOptions, refine
from calib.solver import Layout, NormalEquations

Array = NDArray[np.float64]

SENTENCES = {
    "ok": "The parallax of the pupil was estimated and taken out.",
    "head_axis_unknown": "The pan axis of the head is not known, so near and far cannot be told apart.",
    "not_significant": "The measurements show no parallax of a pupil.",
    "not_better": "The measurements fit no better with the parallax of a pupil.",
    "not_converged": "The fit with a pupil did not settle.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PupilOptions:
    """How fit_pupil() works.

    over_height, over_stand: prior of offset / height and offset / distance, and the start: .4 m (real-footage.md 6.5)
    over 15 m and over 80 m; their _std: as much again. min_sigmas: of either ratio, with the edges' common errors in,
    before it is believed. min_gain: fall of the cost, in units of the edges' common errors, that it must bring: the
    prior alone must not decide. max_rounds: of estimating the ratios and refining again. tilt_std_deg: worst error of
    the head's axis that still serves.
    """

    over_height: float = 0.027
    over_height_std: float = 0.027
    over_stand: float = 0.005
    over_stand_std: float = 0.005
    min_sigmas: float = 3.0
    min_gain: float = 9.0
    max_rounds: int = 5
    tilt_std_deg: float = 2.0
    refine: RefineOptions = field(default_factory=RefineOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PupilFit:
    """over_height, over_stand: pupil offset over the axis' height above the pitch and over the stand's distance, with

    standard deviations. accepted, reason (key of SENTENCES), sentence. solution, graph: refined on the measurements
    without the parallax, and those; the ones handed in where it was not accepted. parallax: the scene in the axes of
    `solution`, None where not accepted. shift_log_f: what taking it out did to the mean log f.
    """

    over_height: float
    over_stand: float
    over_height_std: float
    over_stand_std: float
    accepted: bool
    reason: str
    sentence: str
    solution: Solution
    graph: HomographyGraph
    parallax: Parallax | None
    shift_log_f: float


def parallax_px(packed: Packed, solution: Solution, parallax: Parallax) -> Array:
    """Displacement (E, m, 2) px of each point of a in b by a pupil; NaN behind the camera.

    With f the optical axes and d the ray of a, all in head axes: b sees d + nearness(d) (f_a - f_b).
    """
    to_head = parallax.R_head_world.T
    lens, (ia, ib) = solution.lens, (packed.ia, packed.ib)
    a, _, _ = packed.points()
    R_a, R_b = solution.R[ia] @ to_head, solution.R[ib] @ to_head
    ideal = lens.undistort(a, solution.log_f[ia][:, None])
    homogeneous = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], -1)
    rays = homogeneous @ np.swapaxes(np.linalg.inv(lens.K(solution.log_f[ia])), 1, 2) @ R_a
    moved = rays + parallax.nearness(rays)[..., None] * (R_a[:, 2] - R_b[:, 2])[:, None]
    K_b = lens.K(solution.log_f[ib])

    def seen(directions: Array) -> Array:
        w = directions @ np.swapaxes(R_b, 1, 2) @ np.swapaxes(K_b, 1, 2)
        with np.errstate(all="ignore"):
            return lens.distort(
                np.where(w[..., 2:] > 0, w[..., :2] / w[..., 2:], np.nan), solution.log_f[ib][:, None]
            )

    return seen(moved) - seen(rays)


def without_parallax(graph: HomographyGraph, solution: Solution, parallax: Parallax) -> HomographyGraph:
    """The graph with the parallax taken out of grid_b; H, only a start value, as it was.

    solution: cameras of the graph's frames, in the world axes of `parallax`; edges of unknown cameras stay.
    """
    usable = [k for k, e in enumerate(graph.edges) if _known(solution, e.a) and _known(solution, e.b)]
    packed = pack(graph, [graph.edges[k] for k in usable])
    shift = np.nan_to_num(parallax_px(packed, solution, parallax))
    edges = list(graph.edges)
    for row, k in enumerate(usable):
        edges[k] = replace(edges[k], grid_b=edges[k].grid_b - shift[row, : len(edges[k].grid_b)])
    return replace(graph, edges=tuple(edges))


def _known(solution: Solution, frame: int) -> bool:
    return bool(np.isfinite(solution.log_f[solution.index(frame)]))


def _step(
    graph: HomographyGraph, solution: Solution, parallax: Parallax, options: PupilOptions
) -> tuple[Array, Array]:
    """Gauss-Newton step of the ratios with everything else re-optimised, and their covariance; graph as measured."""
    edges = [e for e, ok in zip(graph.edges, solution.edge_ok, strict=True) if ok]
    packed = pack(graph, edges)
    if solution.lens.is_wide:  # the prior of a drifting principal point is of where the solution has it
        packed = replace(packed, log_f_pp=solution.lens.pp_log_f)
    state = state_of(packed, solution)
    free = np.array([solution.lens_std.get(k, 0.0) > 0 for k in SHARED[: state.shared.shape[1]]])
    terms = PriorTerms(solution.priors, graph.size_px, graph.frames, free, packed.log_f_pp)
    layout = Layout(packed, solution.index(solution.reference), free)
    loss = Loss("huber", np.array([max(1.0, float(np.sqrt(solution.chi2_dof)))]))
    ratios = np.array([parallax.over_height, parallax.over_stand])

    def displaced(at: Array) -> Array:
        there = replace(parallax, over_height=float(at[0]), over_stand=float(at[1]))
        return parallax_px(packed, solution, there)

    shift = np.nan_to_num(displaced(ratios))
    h = np.array([1e-4, 2e-5])
    slopes = []
    for k, unit in enumerate(np.eye(2)):
        up, down = (displaced(ratios + sign * h * unit) for sign in (1, -1))
        slopes.append(np.nan_to_num(up - down) / (2 * h[k]))
    rx, ry, J = residuals(packed, state, jacobian=True)
    known = packed.dof > 0

    def white(x: Array, y: Array) -> Array:
        both = np.stack([packed.s11 * x + packed.s12 * y, packed.s12 * x + packed.s22 * y], -1)
        return np.where(known[..., None], both, 0.0)

    e = white(rx[0] - shift[..., 0], ry[0] - shift[..., 1])
    weight = loss.value_and_weight(np.sum(e**2, -1)[None])[1][0]
    P = np.stack([white(s[..., 0], s[..., 1]) for s in slopes])
    Jw = np.stack([white(J[0, :, c, 0], J[0, :, c, 1]) for c in range(J.shape[2])])
    cross = np.einsum("em,cemx,kemx->kec", weight, Jw, P)
    corrected = replace(packed, b_x=packed.b_x - shift[..., 0], b_y=packed.b_y - shift[..., 1])
    equations = NormalEquations(layout, terms, state, linearise(corrected, state, loss))
    coupling = np.where(layout.active, layout.vector(cross), 0.0)
    eliminated = np.stack([equations.solve_for(c) for c in coupling])
    prior = 1 / np.array([options.over_height_std, options.over_stand_std]) ** 2
    normal = np.einsum("em,kemx,lemx->kl", weight, P, P) - coupling @ eliminated.T
    gradient = np.einsum("em,kemx,emx->k", weight, P, e) - eliminated @ equations.gradient[0]
    # The prior is of the measurements' own scale, so that it does not fade as edges that share errors are added.
    kappa = common_variance(solution.edge_kappa[solution.edge_ok], solution.chi2_dof)
    information = normal / kappa + np.diag(prior)
    mean = np.array([options.over_height, options.over_stand])
    return np.linalg.solve(information, gradient / kappa + prior * (mean - ratios)), np.linalg.inv(
        information
    )


def fit_pupil(graph: HomographyGraph, solution: Solution, options: PupilOptions | None = None) -> PupilFit:
    """The pupil's parallax estimated from a calibrated graph, and the calibration without it.

    graph: keyframes and edges (raw px) as measured; solution: refine() of it. Alternates Gauss-Newton steps of the two
    ratios, everything else re-optimised to first order, with refinements of the corrected measurements. Returns a
    PupilFit; on data that do not show a parallax the solution handed in, with the reason. Judge `fit.solution` with
    `fit.graph`. Raises ValueError when graph and solution do not belong together.
    """
    options = options or PupilOptions()
    if len(solution.edge_ok) != len(graph.edges) or len(solution.frames) != len(graph.frames):
        raise ValueError("fit_pupil() needs the graph that the solution was refined on")
    loose = LevelOptions(max_std_rad=float(np.deg2rad(options.tilt_std_deg)), max_residual_ratio=np.inf)
    # From the prior: at 0 the nearer surface is undefined, and where the pitch ends must be about right from the start.
    best, corrected, cov, parallax = solution, graph, np.full((2, 2), np.nan), None
    ratios = np.array([options.over_height, options.over_stand])
    for _ in range(options.max_rounds):
        if not best.converged or not np.isfinite(best.log_f).all():
            return _refused(solution, graph, "not_converged")
        head = level(best, loose)
        if not head.observable:
            return _refused(solution, graph, "head_axis_unknown")
        at = Parallax(
            over_height=float(ratios[0]), over_stand=float(ratios[1]), R_head_world=head.R_head_world
        )
        step, cov = _step(graph, best, at, options)
        ratios = np.maximum(ratios + np.clip(step, -0.02, 0.02), 1e-5)
        parallax = replace(at, over_height=float(ratios[0]), over_stand=float(ratios[1]))
        corrected = without_parallax(graph, best, parallax)
        best = refine(corrected, start=best, priors=solution.priors,
                      options=replace(options.refine, reference=best.reference))  # fmt: skip
        if np.all(np.abs(step) < 0.1 * np.sqrt(np.diagonal(cov))):
            break
    if not best.converged:
        return _refused(solution, graph, "not_converged")
    std = np.sqrt(np.diagonal(cov))
    if not (ratios > options.min_sigmas * std).any():
        return _refused(solution, graph, "not_significant", ratios, std)
    kappa = common_variance(solution.edge_kappa[solution.edge_ok], solution.chi2_dof)
    if not (solution.cost - best.cost) / kappa > options.min_gain:
        return _refused(solution, graph, "not_better", ratios, std)
    return PupilFit(
        over_height=float(ratios[0]), over_stand=float(ratios[1]), over_height_std=float(std[0]),
        over_stand_std=float(std[1]), accepted=True, reason="ok", sentence=SENTENCES["ok"], solution=best,
        graph=corrected, parallax=parallax, shift_log_f=float(np.mean(best.log_f - solution.log_f)),
    )  # fmt: skip


def _refused(
    solution: Solution,
    graph: HomographyGraph,
    reason: str,
    ratios: Array | None = None,
    std: Array | None = None,
) -> PupilFit:
    nan = np.full(2, np.nan)
    ratios, std = nan if ratios is None else ratios, nan if std is None else std
    return PupilFit(
        over_height=float(ratios[0]), over_stand=float(ratios[1]), over_height_std=float(std[0]),
        over_stand_std=float(std[1]), accepted=False, reason=reason, sentence=SENTENCES[reason], solution=solution,
        graph=graph, parallax=None, shift_log_f=0.0,
    )  # fmt: skip
