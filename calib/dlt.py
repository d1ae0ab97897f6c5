"""Homographies from point matches: normalised, information-weighted DLT, batched; maximum likelihood, covariance.

The DLT starts things; `fit` is the estimator to report: Gauss-Newton on the transfer error (noise in b, or in both:
Sampson's first-order weights), Huber weights, covariance of h. Source: calibration.md 3; Hartley and Zisserman 4.
Other estimators, each with a covariance, are in homography_fit.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography

Array = NDArray[np.float64]


def square_root_information(info: ArrayLike) -> Array:
    """Symmetric square roots (..., 2, 2) of positive semi-definite information (..., 2, 2): S S = info."""
    A = np.asarray(info, float)
    root_det = np.sqrt(np.maximum(A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0], 0.0))
    trace = A[..., 0, 0] + A[..., 1, 1] + 2 * root_det
    scale = np.sqrt(np.where(trace > 0, trace, 1.0))
    return np.where(
        trace[..., None, None] > 0, (A + root_det[..., None, None] * np.eye(2)) / scale[..., None, None], 0.0
    )


def normalisation(points: Array, weight: Array) -> tuple[Array, Array]:
    """T (..., 3, 3) and T points (..., m, 2): centroid 0, mean distance sqrt 2 (Hartley), weights (..., m)."""
    total = np.maximum(weight.sum(-1), 1e-300)
    centre = (points * weight[..., None]).sum(-2) / total[..., None]
    distance = np.linalg.norm(points - centre[..., None, :], axis=-1)
    scale = np.sqrt(2) / np.maximum((distance * weight).sum(-1) / total, 1e-12)
    T = np.zeros((*points.shape[:-2], 3, 3))
    T[..., 0, 0] = T[..., 1, 1] = scale
    T[..., :2, 2] = -scale[..., None] * centre
    T[..., 2, 2] = 1
    return T, (points - centre[..., None, :]) * scale[..., None, None]


def dlt(points_a_px: ArrayLike, points_b_px: ArrayLike, root_info: ArrayLike | None = None) -> Array:
    """H_b_a (..., 3, 3), det 1, from matches (..., m, 2) weighted by square roots of their information (..., m, 2, 2).

    Rows of weight 0 do not count. NaN where fewer than four points, a collinear set, or the ratio of the two smallest
    singular values (below 10) leave H undetermined. Batched over the leading axes.
    """
    a, b = np.broadcast_arrays(np.asarray(points_a_px, float), np.asarray(points_b_px, float))
    S = np.broadcast_to(np.eye(2), (*a.shape, 2)) if root_info is None else np.asarray(root_info, float)
    S = np.broadcast_to(S, (*a.shape, 2))
    weight = (np.abs(S).sum((-1, -2)) > 0) & np.isfinite(a).all(-1) & np.isfinite(b).all(-1)
    a, b = np.where(weight[..., None], a, 0.0), np.where(weight[..., None], b, 0.0)
    Ta, x = normalisation(a, weight.astype(float))
    Tb, u = normalisation(b, weight.astype(float))
    rows = np.zeros((*a.shape[:-1], 2, 9))
    ones = np.concatenate([x, np.ones((*x.shape[:-1], 1))], -1)
    rows[..., 0, 0:3], rows[..., 1, 3:6] = ones, ones
    rows[..., 0, 6:9], rows[..., 1, 6:9] = -u[..., :1] * ones, -u[..., 1:] * ones
    rows = (np.where(weight[..., None, None], S, 0.0) @ rows).reshape(*a.shape[:-2], -1, 9)
    values, vectors = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)
    H = homography.normalise(np.linalg.inv(Tb) @ vectors[..., :, 0].reshape(*a.shape[:-2], 3, 3) @ Ta)
    # Singular values are square roots of eigenvalues; 1e-24 of the largest is rounding, not a noise level.
    floor = np.maximum(values[..., 0], 1e-15 * values[..., -1])
    ill = (values[..., 1] < 100 * floor) & (values[..., 1] < 1e-8 * values[..., -1])
    good = (weight.sum(-1) >= 4) & ~ill
    return np.where(good[..., None, None], H, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HomographyFit:
    """H_b_a (3, 3) det 1; cov (9, 9) of its row-major entries (rank 8); chi2, dof; weights (m,); n_steps; converged."""

    H: Array
    cov: Array
    chi2: float
    dof: int
    weights: Array
    n_steps: int
    converged: bool


def fit(
    points_a_px: ArrayLike,
    points_b_px: ArrayLike,
    *,
    sigma_px: float,
    two_sided: bool = False,
    huber: float | None = None,
    max_steps: int = 20,
) -> HomographyFit:
    """Maximum likelihood H_b_a of matches (m, 2), noise sigma_px in b (or in both views: Sampson weights).

    huber: threshold in sigmas, None for plain least squares. The covariance is for the stated sigma_px.
    Raises ValueError for shapes; data that leave H open give NaN and converged False.
    """
    a, b = np.asarray(points_a_px, float), np.asarray(points_b_px, float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2:
        raise ValueError(f"points must be two (m, 2) arrays, got {a.shape} and {b.shape}")
    H = dlt(a, b)
    nothing = HomographyFit(
        H=np.full((3, 3), np.nan), cov=np.full((9, 9), np.nan), chi2=np.nan, dof=2 * len(a) - 8,
        weights=np.zeros(len(a)), n_steps=0, converged=False,
    )  # fmt: skip
    if not np.isfinite(H).all():
        return nothing
    ones = np.ones(len(a))
    Ta, x = normalisation(a, ones)
    Tb, u = normalisation(b, ones)
    h = np.ravel(Tb @ H @ np.linalg.inv(Ta))
    h = h / np.linalg.norm(h)
    weights, step, normal, basis, chi2 = ones, 0, np.eye(8), np.zeros((9, 8)), np.nan
    converged = False
    for step in range(1, max_steps + 1):  # noqa: B007
        Hn = h.reshape(3, 3)
        J9 = homography.point_jacobian(Hn, x)
        y = np.concatenate([x, ones[:, None]], 1) @ Hn.T
        q = y[:, :2] / y[:, 2:]
        V = np.broadcast_to((sigma_px * Tb[0, 0]) ** 2 * np.eye(2), (len(a), 2, 2))
        if two_sided:
            Jp = (Hn[None, :2, :2] - q[:, :, None] * Hn[None, 2:, :2]) / y[:, 2:, None]
            V = V + (sigma_px * Ta[0, 0]) ** 2 * Jp @ np.swapaxes(Jp, 1, 2)
        L = np.linalg.inv(np.linalg.cholesky(V))
        residual = (L @ (u - q)[..., None])[..., 0]
        e = np.linalg.norm(residual, axis=1)
        weights = ones if huber is None else np.minimum(1.0, huber / np.maximum(e, 1e-12))
        basis = np.linalg.svd(h[None])[2][1:].T
        J = (L @ J9 @ basis) * np.sqrt(weights)[:, None, None]
        J, r = J.reshape(-1, 8), (residual * np.sqrt(weights)[:, None]).ravel()
        normal = J.T @ J
        chi2 = float(r @ r)
        try:
            delta = np.linalg.solve(normal, J.T @ r)
        except np.linalg.LinAlgError:
            return nothing
        h = h + basis @ delta
        h = h / np.linalg.norm(h)
        # Newton decrement: the step measured in its own standard deviations.
        if delta @ normal @ delta < 1e-10:
            converged = True
            break
    H, cov = to_pixels(h, basis @ np.linalg.inv(normal) @ basis.T, Ta, Tb)
    return HomographyFit(
        H=H, cov=cov, chi2=chi2, dof=2 * len(a) - 8, weights=weights, n_steps=step, converged=converged
    )


def to_pixels(h: Array, cov: Array, T_a: Array, T_b: Array) -> tuple[Array, Array]:
    """H (3, 3), det 1, in px and its covariance (9, 9) from the unit 9-vector h of normalised points and its own.

    T_a, T_b (3, 3): px to normalised coordinates of either view. First order.
    """
    raw = np.linalg.inv(T_b) @ h.reshape(3, 3) @ T_a
    map9 = np.kron(np.linalg.inv(T_b), T_a.T)
    scale = 1 / np.cbrt(np.linalg.det(raw))
    # det-1 gauge: the component of an error along H itself is removed.
    gradient = scale * map9
    inverse_t = np.linalg.inv(raw).T.ravel()
    gauge = np.eye(9) - np.outer(raw.ravel(), inverse_t) / 3
    full = gauge @ gradient
    return raw * scale, full @ cov @ full.T
