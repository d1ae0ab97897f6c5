"""A homography from matches by the method of one's choice, each with the covariance that simulation confirms.

'dlt': algebraic least squares; 'renormalisation': Kanatani's, as Seo, Ahn, Hong 2000 used; 'ml': maximum likelihood
with Sampson's weights (`dlt.fit`); 'exact': maximum likelihood with the true points as unknowns (the gold standard of
Hartley and Zisserman 4.2.5). On well spread points all four agree to 1 %; 'ml' is the one to take. calibration.md 3.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography
from calib.dlt import HomographyFit, dlt, fit, normalisation, to_pixels

Array = NDArray[np.float64]
METHODS = ("dlt", "renormalisation", "ml", "exact")
# The three equations of x' x (H x) = 0 have rank two; the third eigenvalue of their covariance is rounding.
RANK_TWO = 1e-9


def fit_homography(
    points_a_px: ArrayLike,
    points_b_px: ArrayLike,
    *,
    sigma_px: float,
    two_sided: bool = False,
    method: str = "ml",
) -> HomographyFit:
    """H_b_a of matches (m, 2) px with its covariance (9, 9) for independent noise sigma_px a coordinate.

    two_sided: noise in both views, else in b only. Returns a HomographyFit, det H = 1; data that leave H open (fewer
    than four points, collinear) give NaN and converged False. Raises ValueError: shapes, or a method not in METHODS.
    Source: calibration.md 3.1 to 3.4.
    """
    a, b = np.asarray(points_a_px, float), np.asarray(points_b_px, float)
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if method == "ml":
        return fit(a, b, sigma_px=sigma_px, two_sided=two_sided)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2:
        raise ValueError(f"points must be two (m, 2) arrays, got {a.shape} and {b.shape}")
    H = dlt(a, b)
    if not np.isfinite(H).all():
        return fit(a, b, sigma_px=sigma_px)  # its NaN result
    if method == "exact":
        return _exact(a, b, sigma_px, two_sided)
    return _algebraic(a, b, sigma_px, two_sided, renormalise=method == "renormalisation")


def _equations(x: Array, u: Array) -> tuple[Array, Array]:
    """Rows xi (m, 3, 9) of x' x (H x) = 0 at homogeneous x, x' (m, 3), and their derivatives (m, 3, 9, 4).

    The derivatives are by (x1, x2, x'1, x'2).
    """
    m = len(x)
    one, zero = np.ones(m), np.zeros(m)
    # The rows are cross[k, block] times x^T in the three blocks of row-major h: u2 y3 - y2, y1 - u1 y3, u1 y2 - u2 y1.
    cross = np.stack(
        [
            np.stack([zero, -one, u[:, 1]], 1),
            np.stack([one, zero, -u[:, 0]], 1),
            np.stack([-u[:, 1], u[:, 0], zero], 1),
        ],
        1,
    )
    by_u = np.zeros((2, 3, 3))
    by_u[0, 1, 2], by_u[0, 2, 1], by_u[1, 0, 2], by_u[1, 2, 0] = -1.0, 1.0, 1.0, -1.0
    xi = (cross[..., None] * x[:, None, None, :]).reshape(m, 3, 9)
    T = np.zeros((m, 3, 9, 4))
    for j in range(2):
        T[:, :, j::3, j] = cross
        T[..., 2 + j] = (by_u[j][None, :, :, None] * x[:, None, None, :]).reshape(m, 3, 9)
    return xi, T


def _algebraic(a: Array, b: Array, sigma_px: float, two_sided: bool, *, renormalise: bool) -> HomographyFit:
    """DLT or Kanatani's renormalisation, and the covariance of the smallest eigenvector by propagation of the noise."""
    ones = np.ones(len(a))
    if renormalise:
        # Kanatani's coordinates (u / f0, v / f0, 1), about the centre of the points: f0 of the order of the picture.
        scale = 1 / max(float(np.ptp(a, axis=0).max()), float(np.ptp(b, axis=0).max()))
        Ta, Tb = (
            np.array([[scale, 0, -scale * c[0]], [0, scale, -scale * c[1]], [0, 0, 1]])
            for c in (a.mean(0), b.mean(0))
        )
        x, u = (a - a.mean(0)) * scale, (b - b.mean(0)) * scale
    else:
        Ta, x = normalisation(a, ones)
        Tb, u = normalisation(b, ones)
    xi, T = _equations(np.concatenate([x, ones[:, None]], 1), np.concatenate([u, ones[:, None]], 1))
    sigma = np.array([Ta[0, 0] * two_sided] * 2 + [Tb[0, 0]] * 2)
    noise = T * sigma  # times sigma_px: standard deviations of the four coordinates
    V = np.einsum("mkid,mljd->mklij", noise, noise)
    W = np.broadcast_to(np.diag([1.0, 1.0, 0.0]), (len(a), 3, 3))  # the two equations of the DLT
    h, c, steps, converged = np.zeros(9), 0.0, 0, not renormalise
    for steps in range(1, 51 if renormalise else 2):
        M = np.einsum("mkl,mki,mlj->ij", W, xi, xi) / len(a)
        N = np.einsum("mkl,mklij->ij", W, V) / len(a)
        values, vectors = np.linalg.eigh(M - c * N)
        k = int(np.argmin(np.abs(values))) if renormalise else 0
        h = vectors[:, k]
        if not renormalise:
            break
        if steps > 2 and abs(values[k]) < 1e-9 * abs(values[-1]) * max(float(np.min(sigma[2:])), 1e-12):
            converged = True
            break
        c += values[k] / float(h @ N @ h)
        S = np.einsum("i,mklij,j->mkl", h, V, h)
        eigen, basis = np.linalg.eigh(S)
        inverse = np.where(eigen > RANK_TWO * eigen[:, -1:], 1 / np.maximum(eigen, 1e-300), 0.0)
        inverse[:, 0] = 0.0  # rank two, by construction
        W = (basis * inverse[:, None, :]) @ np.swapaxes(basis, 1, 2)
    # First order: dh = -M^+ sum W xi (d xi . h); its covariance, noise of the matches independent.
    M = np.einsum("mkl,mki,mlj->ij", W, xi, xi)
    S = np.einsum("i,mklij,j->mkl", h, V, h) * sigma_px**2
    basis = np.linalg.svd(h[None])[2][1:].T
    pinv = basis @ np.linalg.inv(basis.T @ M @ basis) @ basis.T
    A = W @ xi
    cov = pinv @ np.einsum("mki,mkl,mlj->ij", A, S, A) @ pinv
    H, cov9 = to_pixels(h, cov, Ta, Tb)
    # Mahalanobis misfit of the equations, two a match.
    inverse_S = np.linalg.pinv(S, rcond=RANK_TWO * 10, hermitian=True)
    e = xi @ h
    return HomographyFit(
        H=H, cov=cov9, chi2=float(np.einsum("mk,mkl,ml->", e, inverse_S, e)), dof=2 * len(a) - 8, weights=ones,
        n_steps=steps, converged=converged,
    )  # fmt: skip


def _exact(a: Array, b: Array, sigma_px: float, two_sided: bool) -> HomographyFit:
    """Reprojection error over h and the true points of view a; the points are eliminated match by match (Schur)."""
    start = fit(a, b, sigma_px=sigma_px, two_sided=two_sided)
    if not two_sided or not start.converged:
        return start  # noise in b only: the transfer error is the exact likelihood already
    ones = np.ones(len(a))
    Ta, x = normalisation(a, ones)
    Tb, u = normalisation(b, ones)
    sa, sb = sigma_px * Ta[0, 0], sigma_px * Tb[0, 0]
    h = np.ravel(Tb @ start.H @ np.linalg.inv(Ta))
    h, true = h / np.linalg.norm(h), x.copy()
    basis, schur, cost, damping, converged, steps = np.zeros((9, 8)), np.eye(8), np.inf, 1e-6, False, 0

    def residuals(h9: Array, points: Array) -> tuple[Array, Array, float]:
        r_a = (x - points) / sa
        r_b = (u - homography.apply(h9.reshape(3, 3), points)) / sb
        value = float(np.sum(r_a**2) + np.sum(r_b**2))
        return r_a, r_b, value if np.isfinite(value) else np.inf

    h = h if np.isfinite(residuals(h, true)[2]) else -h  # points in front: third coordinate positive
    r_a, r_b, cost = residuals(h, true)
    for steps in range(1, 51):  # noqa: B007
        Hn = h.reshape(3, 3)
        y = np.concatenate([true, ones[:, None]], 1) @ Hn.T
        q = y[:, :2] / y[:, 2:]
        B = (Hn[None, :2, :2] - q[:, :, None] * Hn[None, 2:, :2]) / y[:, 2:, None] / sb
        basis = np.linalg.svd(h[None])[2][1:].T
        C = homography.point_jacobian(Hn, true) @ basis / sb
        Bt = np.swapaxes(B, 1, 2)
        V = np.eye(2) / sa**2 + Bt @ B
        W = np.swapaxes(C, 1, 2) @ B
        g_x = r_a / sa + (Bt @ r_b[..., None])[..., 0]
        gain = W @ np.linalg.inv(V)
        schur = np.einsum("mki,mkj->ij", C, C) - (gain @ np.swapaxes(W, 1, 2)).sum(0)
        g = np.einsum("mki,mk->i", C, r_b) - (gain @ g_x[..., None])[..., 0].sum(0)
        step = np.linalg.solve(schur * (1 + damping * np.eye(8)), g)
        move = np.linalg.solve(V, (g_x - step @ W)[..., None])[..., 0]
        trial = h + basis @ step
        trial /= np.linalg.norm(trial)
        ra, rb, new = residuals(trial, true + move)
        if new <= cost * (1 + 1e-14):
            h, true, r_a, r_b = trial, true + move, ra, rb
            done, cost, damping = cost - new < 1e-9, new, damping * 0.1
            if done:
                converged = True
                break
        else:
            damping = max(damping, 1e-6) * 10
    H, cov = to_pixels(h, basis @ np.linalg.inv(schur) @ basis.T, Ta, Tb)
    return replace(start, H=H, cov=cov, chi2=cost, n_steps=steps, converged=converged)
