"""Error bars at an optimum: covariance, cluster-robust sigma of the mean log f, signal S10, edge statistics.

Source: calibration.md 6.6, 6.7, 7.3, 7.4. The formal covariance takes cells for independent; cells of one edge share
the errors of its registration, so the sandwich over edges is what gets published, and all variances are scaled by it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import homography
from calib.camera import SHARED
from calib.problem import Loss, Packed, PriorTerms, State, chunks, residuals, whitened_squares
from calib.records import Lens, Priors, Solution, StartResult
from calib.solver import Layout, NormalEquations, Result

Array = NDArray[np.float64]

# Correlated registration errors inflate an edge's variance about 6-fold (measured: kappa 6.3-7.4 with .1 px smooth
# error on .1 px noise). With few edges the data cannot say so themselves: that many pseudo-edges stand for it.
KAPPA_PRIOR, KAPPA_PRIOR_EDGES = 4.0, 4.0


def homography_energy(packed: Packed, whitened: Array) -> Array:
    """Squared length (E,) of whitened residuals (E, 2 m) within what a change of each edge's homography could make.

    That is at most eight directions; those that the points do not span count for nothing.
    """
    a, _, root = packed.points()
    E, m = packed.dof.shape
    H = np.where(np.isfinite(packed.H), packed.H, np.eye(3))
    W = packed.size_px[0]
    T = np.array([[1 / W, 0, -0.5], [0, 1 / W, -0.5 * packed.size_px[1] / W], [0, 0, 1]])
    points = homography.apply(T, a)
    J = homography.point_jacobian(T @ H @ np.linalg.inv(T), points) * W
    J = np.where(np.isfinite(J), J, 0.0)
    J = (root @ J * (packed.dof > 0)[..., None, None]).reshape(E, 2 * m, 9)
    # The smallest of the nine directions is the scale of H, which moves nothing; a Gram matrix of nine columns costs a
    # tenth of a decomposition of 2 m rows.
    values, vectors = np.linalg.eigh(np.swapaxes(J, 1, 2) @ J)
    values, vectors = values[:, 1:], vectors[:, :, 1:]
    along = np.swapaxes(vectors, 1, 2) @ (np.swapaxes(J, 1, 2) @ whitened[..., None])
    keep = values > 1e-11 * values[:, -1:]
    return np.sum(np.where(keep, along[..., 0] ** 2 / np.where(keep, values, 1.0), 0.0), 1)


def edge_statistics(packed: Packed, state: State, loss: Loss) -> tuple[Array, Array, Array, Array]:
    """Per edge: chi2 per degree of freedom, kappa (variance in homography directions), smooth residual in px rms,

    and rms px of the residual (weighted by robust weights). NaN for edges without known points or impossible ones.
    """
    parts = [
        _statistics(packed.select(part), state, loss)
        for part in chunks(packed.n_edges, 1, packed.dof.shape[1])
    ]
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)
    chi2, kappa, smooth, rms = (np.concatenate(values) for values in zip(*parts, strict=True))
    return chi2, kappa, smooth, rms


def _statistics(packed: Packed, state: State, loss: Loss) -> tuple[Array, Array, Array, Array]:
    rx, ry, _ = residuals(packed, state)
    rx, ry = rx[0], ry[0]
    ex, ey = packed.s11 * rx + packed.s12 * ry, packed.s12 * rx + packed.s22 * ry
    known = packed.dof > 0
    impossible = (known & ~np.isfinite(ex)).any(1)
    ex, ey = np.where(known & np.isfinite(ex), ex, 0.0), np.where(known & np.isfinite(ey), ey, 0.0)
    e2 = ex**2 + ey**2
    _, weight = loss.value_and_weight(e2[None])
    weight = weight[0]
    dof = packed.dof.sum(1)
    with np.errstate(all="ignore"):
        chi2 = np.sum(weight * e2, 1) / np.maximum(dof, 1)
        root = np.sqrt(weight)
        whitened = np.stack([ex * root, ey * root], -1).reshape(len(dof), -1)
        energy = homography_energy(packed, whitened)
        kappa = energy / 8
        # The part of the energy that noise of the observed level (outside these directions) would not explain.
        floor = np.maximum(np.sum(whitened**2, 1) - energy, 0) / np.maximum(dof - 8, 1)
        smooth = np.maximum(energy - 8 * floor, 0)
        # px: divide by the mean information along the cells' known directions.
        information = (packed.s11**2 + packed.s12**2 * 2 + packed.s22**2) * known
        per_dof = information.sum(1) / np.maximum(dof, 1)
        smooth_px = np.sqrt(smooth / np.maximum(dof, 1) / np.maximum(per_dof, 1e-12)) * np.sqrt(2)
        rms = np.sqrt(np.sum(weight * e2, 1) / np.maximum(dof, 1) / np.maximum(per_dof, 1e-12)) * np.sqrt(2)
    bad = (dof == 0) | impossible
    for values in (chi2, kappa, smooth_px, rms):
        values[bad] = np.nan
    return chi2, kappa, smooth_px, rms


def perspective_signal(packed: Packed, state: State, layout: Layout, direction: Array, u: Array) -> float:
    """S10: rms px that the best edge moves when mean log f = u . x is forced by 0.1 and all else re-optimises.

    direction: covariance times u.
    """
    denominator = float(u @ direction)
    if not np.isfinite(denominator) or denominator <= 0:
        return 0.0
    a = (0.1 * direction / denominator)[layout.columns]  # (E, 8 + s)
    best = 0.0
    for part in chunks(packed.n_edges, 1, packed.dof.shape[1]):
        _, _, J = residuals(packed, state, part, jacobian=True)
        moved = np.einsum("ejcm,ej->ecm", J[0], a[part])
        known = packed.dof[part] > 0
        square = np.where(known, np.sum(moved**2, 1), 0.0).sum(1) / np.maximum(known.sum(1), 1)
        best = max(best, float(np.nanmax(square, initial=0.0)))
    return float(np.sqrt(best))


def summarise(
    packed: Packed, frames: NDArray[np.int64], row: int, terms: PriorTerms, result: Result, ok: NDArray[np.bool_],
    loss: Loss, linked: NDArray[np.bool_], priors: Priors, starts: tuple[StartResult, ...], share: float,
) -> Solution:  # fmt: skip
    """Solution with error bars from a finished minimisation over the accepted edges."""
    n = packed.n_frames
    state, used = result.state, packed.select(ok)
    layout = Layout(used, row, terms.free, ~linked if not linked.all() else None)
    chi2, kappa, _, rms_edge = edge_statistics(packed, state, loss)
    n_free = int(layout.active.sum())
    dof = max(float(used.dof.sum()) - n_free, 1.0)
    whitened = whitened_squares(used, state)
    _, weight = loss.value_and_weight(whitened)
    with np.errstate(invalid="ignore"):  # a point outside the lens model has infinite misfit and no weight
        chi2_dof = float(np.nansum(weight * whitened) / dof)
    values, names = state.shared[0], SHARED[: layout.n_shared]
    lens = Lens(
        size_px=packed.size_px, pp_px=values[:2], aspect=float(np.exp(values[2])), c0=float(values[3]),
        c1=float(values[4]),
    )  # fmt: skip
    if len(values) > 5:
        lens = replace(lens, k2=float(values[5]), pp_drift_px=values[6:], pp_log_f=packed.log_f_pp)
    sigma_log_f, sigma_zoom = np.full(n, np.nan), np.full(n, np.nan)
    cov_rot = np.full((n, 3, 3), np.nan)
    lens_std: dict[str, float] = dict.fromkeys(names, float("nan"))
    formal = sigma_mean = float("nan")
    s10, factor = 0.0, 1.0
    converged = bool(result.converged[0])
    try:
        parts = NormalEquations(layout, terms, state, result.lin).covariance_parts()
        blocks, shared = parts.frame_blocks(), parts.shared_variances()
        variances = np.concatenate([np.diagonal(blocks, axis1=1, axis2=2).ravel(), shared])
        if not np.isfinite(variances).all() or (variances < 0).any():
            raise np.linalg.LinAlgError("covariance is not positive")
        u, first = np.zeros(layout.size), np.zeros(layout.size)
        u[0 : 4 * n : 4] = linked / linked.sum()
        first[4 * row] = 1.0
        mean, zoom = parts.product(u), parts.product(first)
        if not float(u @ mean) > 0:
            raise np.linalg.LinAlgError("covariance is not positive")
        formal = float(np.sqrt(u @ mean))
        sigma_mean = _cluster_sigma(mean, u, layout, terms, result, kappa[ok], chi2_dof, n_free)
        s10 = perspective_signal(used, state, layout, mean, u)
        factor = max(sigma_mean / formal, 1.0) if formal > 0 else 1.0
        sigma_log_f = np.sqrt(blocks[:, 0, 0]) * factor
        relative = blocks[:, 0, 0] + blocks[row, 0, 0] - 2 * zoom[0 : 4 * n : 4]
        sigma_zoom = np.sqrt(np.maximum(relative, 0)) * factor
        cov_rot = blocks[:, 1:, 1:] * factor**2
        lens_std = {
            name: float(np.sqrt(shared[k])) * factor if layout.active[4 * n + k] else 0.0
            for k, name in enumerate(names)
        }
    except np.linalg.LinAlgError:
        converged = False
    rms = np.full(n, np.nan)
    good = ok & np.isfinite(rms_edge)
    ends = np.concatenate([packed.ia[good], packed.ib[good]])
    total, count = np.bincount(ends, np.tile(rms_edge[good] ** 2, 2), n), np.bincount(ends, minlength=n)
    rms[count > 0] = np.sqrt(total[count > 0] / count[count > 0])
    log_f, R = state.log_f[0].copy(), state.R[0].copy()
    for values in (log_f, R, sigma_log_f, sigma_zoom, cov_rot, rms):
        values[~linked] = np.nan
    return Solution(
        frames=frames, log_f=log_f, R=R, lens=lens, reference=int(frames[row]), sigma_log_f=sigma_log_f,
        sigma_log_zoom=sigma_zoom, cov_rot=cov_rot, sigma_mean_log_f=sigma_mean, sigma_mean_formal=formal,
        lens_std=lens_std, chi2_dof=chi2_dof, s10_px=s10, edge_chi2=chi2, edge_kappa=kappa, edge_ok=ok,
        rms_px=rms, converged=converged,
        stop=result.stop[0] if converged or result.stop[0] != "converged" else "singular",
        n_steps=int(result.n_steps[0]), cost=float(result.cost[0]), starts=starts, linear_valid=share, priors=priors,
    )  # fmt: skip


def _cluster_sigma(
    a: Array,
    u: Array,
    layout: Layout,
    terms: PriorTerms,
    result: Result,
    kappa: Array,
    chi2_dof: float,
    n_free: int,
) -> float:
    """sigma of u^T x: sandwich over edges plus priors, never below the chi2-scaled formal value; few edges: kappa.

    a: covariance times u.
    """
    E = len(layout.columns)
    per_edge = np.einsum("ej,ej->e", a[layout.columns], result.lin.gradient[0])
    spare = 8 * E - n_free
    # Prior information is not an edge's: its error enters with its own variance.
    prior = float(
        np.sum(a[4 * layout.n :] ** 2 * np.where(layout.active[4 * layout.n :], terms.precision, 0.0))
    )
    prior += float((a[0 : 4 * layout.n : 4].mean()) ** 2 * terms.mean_precision)
    prior += float(np.sum(a[4 * terms.known_row] ** 2 * terms.known_precision))
    for (row, term), (_, line) in zip(terms.line_terms(result.state), terms.lines, strict=True):
        mine = a[[4 * row, *range(4 * layout.n, layout.size)]]
        prior += line.weight * float(mine @ term.block[0] @ mine)  # its weight is no smaller error
    formal = float(u @ a)
    data = max(formal - prior, 0.0)
    chi2 = max(chi2_dof, 1.0)
    observed = float(np.nansum(kappa)) * 8
    expected = max(spare, 0)
    # Few spare equations: kappa is not known from the data and a prior of a few pseudo-edges fills in.
    blend = (observed + KAPPA_PRIOR * chi2 * 8 * KAPPA_PRIOR_EDGES) / (expected + 8 * KAPPA_PRIOR_EDGES)
    from_kappa = data * max(blend, 1.0) + prior
    if spare > 4 * 8:
        cluster = 8 * E / spare * float(np.sum(per_edge**2)) + prior
        return float(np.sqrt(max(cluster, data * chi2 + prior)))
    return float(np.sqrt(max(from_kappa, data * chi2 + prior)))


__all__ = ["edge_statistics", "homography_energy", "perspective_signal", "summarise"]
