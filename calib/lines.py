"""Lines that are straight in the scene, as evidence of the lens: their undistorted points must lie on a line.

A touchline across half of the picture fixes k1 where focal and distortion otherwise trade (real-footage.md 2: 1 % of
focal length for .0005 of k1). Straightness does not depend on focal, rotation or aspect, so a line is a term in its
frame's k1(f), k2 and principal point alone; nothing has to be known of where it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import distortion
from calib.camera import N_SHARED
from calib.records import StraightLine

Array = NDArray[np.float64]


class LineTerm(NamedTuple):
    """One line at S states: cost (S,), gradient (S, 1 + s) and normal block (S, 1 + s, 1 + s) over log f of its frame

    and the s shared unknowns (J^T W r with r = measured less predicted, as `problem.Linearised` has it).
    """

    cost: Array
    gradient: Array
    block: Array


def line_term(line: StraightLine, log_f: Array, shared: Array, width_px: float, log_f_pp: float) -> LineTerm:
    """The term of a line at log f (S,) of its frame and shared (S, 5) or (S, 8); cost inf outside the lens model."""
    residual, J = bow(line.points_px, log_f, shared, width_px, log_f_pp)
    weight = line.weight / line.sigma_px**2
    cost = weight * np.sum(residual**2, -1)
    gradient = -weight * np.sum(J * residual[:, None], -1)
    return LineTerm(np.where(np.isfinite(cost), cost, np.inf), gradient, weight * J @ np.swapaxes(J, 1, 2))


def bow(
    points_px: Array, log_f: Array, shared: Array, width_px: float, log_f_pp: float
) -> tuple[Array, Array]:
    """Distances (S, m) px of undistorted raw points (m, 2) from the line that fits them best, and their derivatives

    (S, 1 + s, m) by log f and the shared unknowns, the line following.
    """
    s2 = (width_px / 2) ** 2
    wide = shared.shape[1] > N_SHARED
    zoom = (log_f - np.log(width_px))[:, None]
    c1 = shared[:, 4, None]
    k1 = shared[:, 3, None] + c1 * zoom
    k2 = shared[:, 5, None] if wide else np.zeros_like(k1)
    drift = shared[:, 6:8] if wide else np.zeros((len(shared), 2))
    since = (log_f - log_f_pp)[:, None]
    d = points_px[None] - (shared[:, :2] + drift * since)[:, None]
    rho_d = np.linalg.norm(d, axis=-1) / np.sqrt(s2)
    rho = distortion.undistorted_radius(rho_d, k1, k2)
    u = d * (rho / np.maximum(rho_d, 1e-12))[..., None]
    centred = u - u.mean(1, keepdims=True)
    finite = np.isfinite(centred).all((1, 2))
    _, _, axes = np.linalg.svd(np.where(finite[:, None, None], centred, 0.0), full_matrices=False)
    along, normal = axes[:, 0, :, None], axes[:, 1, :, None]
    residual = np.where(finite[:, None], (centred @ normal)[..., 0], np.nan)

    # Undistortion: du = D^-1 (dp - dpp) - u (rho^2 dk1 + rho^4 dk2) / slope; D^-1 = (I - ratio u u^T) / g.
    r2 = rho * rho
    slope, g = 1 + r2 * (3 * k1 + 5 * k2 * r2), 1 + r2 * (k1 + k2 * r2)
    height = (u @ normal)[..., 0]
    ratio = (2 * k1 + 4 * k2 * r2) / s2 / slope
    by_pp = -(normal[:, None, :, 0] - (ratio * height)[..., None] * u) / g[..., None]  # (S, m, 2)
    by_k1 = -height * r2 / slope
    columns = np.zeros((len(shared), 1 + shared.shape[1], len(points_px)))
    columns[:, 0] = c1 * by_k1 + np.sum(by_pp * drift[:, None], -1)
    columns[:, 1], columns[:, 2] = by_pp[..., 0], by_pp[..., 1]
    columns[:, 4], columns[:, 5] = by_k1, zoom * by_k1
    if wide:
        columns[:, 6] = by_k1 * r2
        columns[:, 7], columns[:, 8] = since * by_pp[..., 0], since * by_pp[..., 1]
    # The line follows: what a shift and a turn of it explain is no bow.
    t = (centred @ along)[..., 0]
    t = t / np.maximum(np.linalg.norm(t, axis=-1, keepdims=True), 1e-300)
    columns -= columns.mean(-1, keepdims=True)
    columns -= (columns @ t[..., None]) * t[:, None]
    return residual, columns
