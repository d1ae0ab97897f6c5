"""What the data show of errors that all their edges share: smooth residual fields, halves of the shot, constant k.

The statistical sigma sees only errors that differ from edge to edge; a wrong lens model or a pupil off the axis are in
every edge alike. Sources: calibration.md 7; real-footage.md 6.5 to 6.8, whose limits are in px at W = 1280.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.covariance import edge_statistics
from calib.edges import common_variance
from calib.problem import Loss, Packed, pack, residuals, state_of, whitened_squares
from calib.records import HomographyGraph, Solution
from calib.refine import RefineOptions, refine

if TYPE_CHECKING:
    from calib.gates import GateOptions

Array = NDArray[np.float64]


def _residual_fields(solution: Solution, graph: HomographyGraph) -> tuple[Packed, Array, Array, Array] | None:
    """Accepted edges packed, their residuals (E, m, 2) px, scalar weights (E, m), and smooth residual (E,) px."""
    fine = set(solution.frames[np.isfinite(solution.log_f)].tolist())
    pairs = zip(graph.edges, solution.edge_ok, strict=True)
    edges = [e for e, ok in pairs if ok and e.a in fine and e.b in fine]
    if not edges:
        return None
    packed = pack(graph, edges)
    state = state_of(packed, solution)
    loss = Loss("huber", np.array([max(1.0, np.sqrt(solution.chi2_dof))]))
    with np.errstate(all="ignore"):
        _, _, smooth, _ = edge_statistics(packed, state, loss)
        rx, ry, _ = residuals(packed, state)
        _, weight = loss.value_and_weight(whitened_squares(packed, state))
    field = np.stack([rx[0], ry[0]], -1)
    # Only cells that know both directions: along a line's own direction the residual says nothing.
    known = (packed.dof >= 2) & np.isfinite(field).all(-1)
    weight = np.where(known, weight[0] * (packed.s11**2 + packed.s22**2 + 2 * packed.s12**2), 0.0)
    return packed, np.where(known[..., None], field, 0.0), weight, smooth


def coherent_px(solution: Solution, graph: HomographyGraph) -> float:
    """Rms over accepted edges of the smooth residual, px: what homographies of the model leave over, edge by edge."""
    found = _residual_fields(solution, graph)
    if found is None:
        return float("nan")
    smooth = found[3][np.isfinite(found[3])]
    if not len(smooth):
        return float("nan")
    # Rms, not median: an edge without visible smooth error is luck. Clipped: one bad edge is not the shot.
    return float(np.sqrt(np.mean(np.minimum(smooth, 3 * np.median(smooth) + 1e-9) ** 2)))


def shared_px(solution: Solution, graph: HomographyGraph) -> float:
    """Smooth residual that the edges share, px rms on the edge where it is largest.

    A wrong lens model or a pupil off the pan axis leaves the same field in every edge, in proportion to its motion;
    errors of single edges do not. A cubic field times the motion is fitted to the even and to the odd edges apart,
    and the product of the two fits is free of the single edges' errors on average. 0 where the two disagree.
    """
    found = _residual_fields(solution, graph)
    if found is None or found[0].n_edges < 4:
        return float("nan")
    packed, field, weight, _ = found
    W, H = packed.size_px
    x, y = (packed.b_x - (W - 1) / 2) / (W / 2), (packed.b_y - (H - 1) / 2) / (W / 2)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], -1)
    motion_px = np.stack([packed.b_x - packed.a_x, packed.b_y - packed.a_y], -1)
    total = np.maximum(weight.sum(1), 1e-12)
    mean = np.sum(motion_px * weight[..., None], 1) / total[:, None]
    _, _, axes = np.linalg.svd(mean, full_matrices=False)
    along = mean @ axes[0] / W  # (E,) signed motion along the shot's main direction, widths
    if not np.any(along):
        return 0.0  # nothing moved at all: there is no field in proportion to motion
    design = basis * along[:, None, None]
    fields = []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        D, w = design[part].reshape(-1, basis.shape[-1]), weight[part].reshape(-1)
        normal = (D * w[:, None]).T @ D
        # A little ridge: cells that no half has seen must not be extrapolated to.
        normal += 1e-3 * np.trace(normal) / len(normal) * np.eye(len(normal))
        fields.append(design @ np.linalg.solve(normal, (D * w[:, None]).T @ field[part].reshape(-1, 2)))
    product = np.sum(np.sum(fields[0] * fields[1], -1) * weight, 1) / total
    # All edges tell the strength, each scales it by its own motion: one noisy edge does not decide.
    strength = float(np.sum(product * total) / np.sum(along**2 * total))
    return float(np.sqrt(max(strength, 0.0)) * np.max(np.abs(along)))


def systematic_px(solution: Solution, graph: HomographyGraph, options: GateOptions) -> dict[str, float]:
    """The systematic error s_px that the data themselves show, px, and its parts."""
    scale = graph.size_px[0] / 1280
    coherent, shared = coherent_px(solution, graph), shared_px(solution, graph)
    seen = shared if np.isfinite(shared) else options.unknown_shared_px * scale
    s_px = float(
        np.hypot(options.shared_gain * seen, options.coherent_gain * np.nan_to_num(coherent, nan=0.0))
    )
    return {
        "coherent_px": coherent,
        "shared_px": shared,
        "systematic_px": max(s_px, options.systematic_floor_px * scale),
    }


def _mean_difference(a: Solution, b: Solution) -> float:
    both = np.isfinite(a.log_f) & np.isfinite(b.log_f)
    return float(np.mean(a.log_f[both] - b.log_f[both])) if both.any() else float("nan")


def halves_sigma(solution: Solution, graph: HomographyGraph, options: RefineOptions) -> float:
    """Systematic part seen by fitting the first and the second half of the edges (by time) apart.

    Half the difference of their common focals, after what their own statistical errors explain. 0 when they agree or
    when a half cannot be fitted (its error bar then explains everything).
    """
    good = np.flatnonzero(solution.edge_ok)
    if len(good) < 6:
        return 0.0
    middle = np.array([graph.edges[k].a + graph.edges[k].b for k in good])
    order = good[np.argsort(middle, kind="stable")]
    parts = []
    for half in (order[: len(order) // 2], order[len(order) // 2 :]):
        edges = tuple(graph.edges[k] for k in sorted(half.tolist()))
        frames = np.array(sorted({e.a for e in edges} | {e.b for e in edges}))
        sub = HomographyGraph(frames=frames, edges=edges, size_px=graph.size_px)
        part = refine(
            sub, start=solution, priors=solution.priors, options=replace(options, reference=int(frames[0]))
        )
        rows = np.array([solution.index(f) for f in frames.tolist()])
        both = np.isfinite(part.log_f) & np.isfinite(solution.log_f[rows])
        if not part.converged or not both.any() or not np.isfinite(part.sigma_mean_log_f):
            return 0.0
        parts.append((float(np.mean(part.log_f[both] - solution.log_f[rows][both])), part.sigma_mean_log_f))
    (d1, s1), (d2, s2) = parts
    return float(np.sqrt(max((d1 - d2) ** 2 - s1**2 - s2**2, 0.0)) / 2)


def constant_k_sigma(
    solution: Solution, graph: HomographyGraph, options: RefineOptions
) -> tuple[float, float]:
    """Systematic part from constant k against k(f), and the plain difference of log f. (0, 0) where c1 is not free.

    A constant k that the data reject counts for little: weight 1 / (1 + z^2 / 4), z^2 its excess cost in units of
    the observed, edge-correlated noise.
    """
    if not solution.lens_std.get("c1", 0.0) > 0:
        return 0.0, 0.0
    held = replace(options, zoom_for_c1=np.inf, reference=solution.reference)
    constant = refine(graph, start=solution, priors=solution.priors, options=held)
    if not constant.converged:
        return 0.0, 0.0
    difference = _mean_difference(constant, solution)
    kappa = common_variance(solution.edge_kappa[solution.edge_ok], solution.chi2_dof)
    z2 = max(constant.cost - solution.cost, 0.0) / kappa
    return abs(difference) / (1 + z2 / 4), difference


def distortion_extreme(solution: Solution) -> bool:
    """Whether k(f) lies beyond two of its prior's deviations: no broadcast lens is like that.

    Lenses change k1_half by .02 as f doubles or less (real-footage.md 2); two deviations are .07."""
    lens, priors = solution.lens, solution.priors
    return bool(
        abs(lens.c0 - priors.c0_mean) > 2 * priors.c0_std or abs(lens.c1 - priors.c1_mean) > 2 * priors.c1_std
    )


def sigma_parts(solution: Solution, graph: HomographyGraph, options: GateOptions) -> dict[str, float]:
    """Parts of the total sigma of the common log f: cluster, signal (10 % x s_px / S10), halves, constant_k;

    and what they were made of: coherent_px, shared_px, systematic_px, constant_k_difference.
    """
    systematic = systematic_px(solution, graph, options)
    s_px = systematic["systematic_px"]
    halves = halves_sigma(solution, graph, options.refine) if options.refits else 0.0
    constant_k, difference = (
        constant_k_sigma(solution, graph, options.refine) if options.refits else (0.0, 0.0)
    )
    if distortion_extreme(solution):
        # No lens is like that: k(f) soaks up something else, and how well it fits says nothing for it.
        constant_k = max(constant_k, abs(difference) / 2)
    return {
        "cluster": solution.sigma_mean_log_f,
        "signal": 0.1 * s_px / solution.s10_px if solution.s10_px > 0 else float("inf"),
        "halves": halves,
        "constant_k": constant_k,
        "constant_k_difference": difference,
        **systematic,
    }
