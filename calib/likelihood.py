"""Maximum likelihood over homographies with covariance: any graph of views, three camera models, Gaussian priors.

Unknowns: per view log fx, log fy, cx, cy (tied by the model) and a rotation (left increments, view 0 = identity). Data:
where four anchors of view a land in view b, 8 numbers an edge, weighted by the homography's covariance; no distortion
(refine.py has it, from points). Closed-form Jacobians, dense normal equations: for tens of views. calibration.md 4.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography, rotation

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
MODELS = ("square", "shared_aspect", "fixed_pp", "zero_skew")
PER_VIEW = 7  # log fx, log fy, cx, cy, rotation (3)
MAX_STEP = 0.3  # of log f and rad: one common factor shortens the whole step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Measured homographies as the likelihood takes them.

    a, b (E,) view rows; anchors (E, 4, 2) px of a; landed (E, 4, 2) px of b; root (E, 8, 8) with root^T root the
    information of the eight numbers, px^-2.
    """

    a: IntArray
    b: IntArray
    anchors: Array
    landed: Array
    root: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """theta (n, 4) = log fx, log fy, cx, cy (px); R (n, 3, 3) = R_k_0, identity at view 0."""

    theta: Array
    R: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianPriors:
    """A theta.ravel() ~ N(mean, std^2): rows A (q, 4 n), mean (q,), std (q,)."""

    A: Array
    mean: Array
    std: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Optimum: views; cov (7 n, 7 n) of (log fx, log fy, cx, cy, rotation increment) per view, inf / NaN if singular;

    chi2 of the homographies, dof (priors counted as measurements); cost with priors; converged; stop; n_steps.
    """

    views: Views
    cov: Array
    chi2: float
    dof: int
    cost: float
    converged: bool
    stop: str
    n_steps: int


def anchors_in_overlap(H_b_a: Array, size_px: tuple[int, int]) -> Array:
    """Four corners (4, 2) px in a of the box of points of a that b sees, shrunk by 10 %; the whole picture if none."""
    W, H = size_px
    x, y = np.meshgrid(np.linspace(0, W - 1, 17), np.linspace(0, H - 1, 10))
    points = np.stack([x.ravel(), y.ravel()], 1)
    seen = homography.apply(H_b_a, points)
    inside = ((seen >= 0) & (seen <= np.array(size_px) - 1)).all(1)
    chosen = points[inside] if inside.sum() >= 4 else points[np.isfinite(seen).all(1)]
    low, high = (chosen.min(0), chosen.max(0)) if len(chosen) else (points.min(0), points.max(0))
    # A strip of one column must still span a box.
    middle, half = (low + high) / 2, np.maximum((high - low) * 0.45, np.array(size_px) * 0.05)
    return middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def observe(
    homographies: ArrayLike, covariances: ArrayLike, a: ArrayLike, b: ArrayLike, size_px: tuple[int, int]
) -> Observations:
    """Observations of H_b_a (E, 3, 3), ideal px, covariances (E, 9, 9) of the row-major entries in the det-1 gauge.

    Raises ValueError: shapes, or a covariance that leaves the homography open (fewer than 8 directions known).
    """
    H, cov = homography.normalise(np.asarray(homographies, float)), np.asarray(covariances, float)
    if H.ndim != 3 or H.shape[1:] != (3, 3) or cov.shape != (len(H), 9, 9):
        raise ValueError(f"expected (E, 3, 3) and (E, 9, 9), got {H.shape} and {cov.shape}")
    anchors = np.array([anchors_in_overlap(one, size_px) for one in H]).reshape(-1, 4, 2)
    J = homography.point_jacobian(H, anchors).reshape(len(H), 8, 9)
    C = J @ cov @ np.swapaxes(J, 1, 2)
    values, vectors = np.linalg.eigh(C)
    if not np.isfinite(values).all() or (values[:, 0] <= 1e-14 * values[:, -1]).any():
        raise ValueError("a covariance must let the eight numbers of its homography vary: rank 8")
    root = np.swapaxes(vectors, 1, 2) / np.sqrt(values)[..., None]
    return Observations(
        a=np.asarray(a, int),
        b=np.asarray(b, int),
        anchors=anchors,
        landed=homography.apply(H, anchors),
        root=root,
    )


def ties(model: str, n: int, aspect: float) -> tuple[Array, Array]:
    """theta.ravel() = base + T p: base (4 n,), T (4 n, m) of a model over n views. Raises ValueError: unknown model.

    'square': fx / fy = aspect, known; f per view, one principal point. 'shared_aspect': the ratio is one unknown more.
    'fixed_pp': fx and fy free in every view. 'zero_skew': all four free in every view.
    """
    if model not in MODELS:
        raise ValueError(f"model must be one of {MODELS}, got {model!r}")
    base, rows = np.zeros((n, 4)), np.arange(n)
    if model == "zero_skew":
        return base.ravel(), np.eye(4 * n)
    columns = {"square": n + 2, "shared_aspect": n + 3, "fixed_pp": 2 * n + 2}[model]
    T = np.zeros((n, 4, columns))
    T[rows, 0, rows] = 1.0
    if model == "fixed_pp":
        T[rows, 1, n + rows] = 1.0
    else:
        T[rows, 1, rows] = 1.0
        if model == "square":
            base[:, 1] = -np.log(aspect)
        else:
            T[:, 1, n + 2] = -1.0
    pp = 2 * n if model == "fixed_pp" else n
    T[:, 2, pp], T[:, 3, pp + 1] = 1.0, 1.0
    return base.ravel(), T.reshape(4 * n, -1)


def predict(views: Views, data: Observations) -> tuple[Array, Array]:
    """Where the anchors land (E, 4, 2) px, NaN behind the camera, and the derivatives (E, 4, 2, 14).

    The derivatives are by theta_a, left increment of R_a, theta_b, left increment of R_b.
    """
    ta, tb = views.theta[data.a][:, None], views.theta[data.b][:, None]
    R = (views.R[data.b] @ np.swapaxes(views.R[data.a], 1, 2))[:, None]
    f_a, f_b = np.exp(ta[..., :2]), np.exp(tb[..., :2])
    v = (data.anchors - ta[..., 2:]) / f_a
    m = np.concatenate([v, np.ones((*v.shape[:-1], 1))], -1)
    w = (R @ m[..., None])[..., 0]
    with np.errstate(all="ignore"):
        depth = np.where(w[..., 2:] > 1e-6, w[..., 2:], np.nan)
    q = w[..., :2] / depth
    G = np.zeros((*v.shape[:-1], 2, 3))
    G[..., 0, 0], G[..., 1, 1] = f_b[..., 0] / depth[..., 0], f_b[..., 1] / depth[..., 0]
    G[..., 2] = -f_b * q / depth
    GR = G @ R
    J = np.zeros((*v.shape[:-1], 2, 14))
    J[..., 0:2] = -GR[..., :2] * v[..., None, :]
    J[..., 2:4] = -GR[..., :2] / f_a[..., None, :]
    J[..., 4:7] = GR @ rotation.skew(m)
    J[..., 0, 7], J[..., 1, 8] = f_b[..., 0] * q[..., 0], f_b[..., 1] * q[..., 1]
    J[..., 0, 9], J[..., 1, 10] = 1.0, 1.0
    J[..., 11:14] = -G @ rotation.skew(w)
    return tb[..., 2:] + f_b * q, J


def _whitened(views: Views, data: Observations) -> tuple[Array, Array]:
    landed, J = predict(views, data)
    e = (data.landed - landed).reshape(len(data.a), 8, 1)
    return (data.root @ e)[..., 0], data.root @ J.reshape(len(data.a), 8, 14)


def _design(J: Array, data: Observations, n: int, T: Array) -> Array:
    """Whitened Jacobian (8 E, m + 3 (n - 1)) by the tied parameters and the rotations of views 1 .. n - 1."""
    E = len(data.a)
    theta, rot = np.zeros((E, 8, n, 4)), np.zeros((E, 8, n, 3))
    e = np.arange(E)
    theta[e, :, data.a], rot[e, :, data.a] = J[..., 0:4], J[..., 4:7]
    theta[e, :, data.b] += J[..., 7:11]
    rot[e, :, data.b] += J[..., 11:14]
    return np.concatenate([theta.reshape(8 * E, 4 * n) @ T, rot[:, :, 1:].reshape(8 * E, 3 * (n - 1))], 1)


def fisher(
    views: Views, data: Observations, model: str, *, aspect: float = 1.0, priors: GaussianPriors | None = None
) -> tuple[Array, Array]:
    """Information of (p, rotations) and the map (7 n, k) of those to the per-view parameters; its inverse is the bound.

    At the true cameras with the homographies' true covariance: the Cramer-Rao bound is map information^-1 map^T.
    """
    n = len(views.theta)
    _, T = ties(model, n, aspect)
    _, J = _whitened(views, data)
    D = _design(J, data, n, T)
    information = D.T @ D
    if priors is not None:
        P = (priors.A @ T) / priors.std[:, None]
        information[: T.shape[1], : T.shape[1]] += P.T @ P
    m = T.shape[1]
    full = np.zeros((n, PER_VIEW, information.shape[0]))
    full[:, :4, :m] = T.reshape(n, 4, m)
    for k in range(1, n):
        full[k, 4:, m + 3 * (k - 1) : m + 3 * k] = np.eye(3)
    return information, full.reshape(PER_VIEW * n, -1)


def covariance(information: Array, to_views: Array) -> Array:
    """map information^-1 map^T (7 n, 7 n); NaN rows and columns for what a singular direction moves."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    if not np.isfinite(values).all():
        return np.full((len(to_views),) * 2, np.nan)
    free = values <= 1e-13 * values[-1]
    scaled = to_views * scale
    half = scaled @ (vectors[:, ~free] / np.sqrt(values[~free]))
    out = np.asarray(half @ half.T)
    moved = np.linalg.norm(scaled @ vectors[:, free], axis=1) > 1e-6 * np.linalg.norm(scaled, axis=1)
    out[moved], out[:, moved] = np.nan, np.nan
    return out


def maximise(
    start: Views,
    data: Observations,
    model: str,
    *,
    aspect: float = 1.0,
    priors: GaussianPriors | None = None,
    max_steps: int = 100,
) -> Estimate:
    """Levenberg-Marquardt from `start`; stops when the Newton decrement is below 1e-6 (a thousandth of a sigma).

    A rejected step leaves the estimate untouched; only an accepted one declares convergence. Never raises on singular
    systems: stop says 'singular', 'impossible_start' or 'max_steps'. Raises ValueError: unknown model.
    """
    n = len(start.theta)
    base, T = ties(model, n, aspect)
    m = T.shape[1]
    p: Array = np.linalg.lstsq(T, start.theta.ravel() - base, rcond=None)[0].astype(float)
    R = start.R @ start.R[0].T
    P = np.zeros((0, m)) if priors is None else (priors.A @ T) / priors.std[:, None]
    target = np.zeros(0) if priors is None else (priors.mean - priors.A @ base) / priors.std
    P_all = np.concatenate([P, np.zeros((len(P), 3 * (n - 1)))], 1)
    log_f = np.flatnonzero(np.abs(T.reshape(n, 4, m)[:, :2]).sum((0, 1)) > 0)

    def at(p: Array, R: Array) -> tuple[Views, Array, Array, float]:
        views = Views(theta=(base + T @ p).reshape(n, 4), R=R)
        with np.errstate(all="ignore"):
            e, J = _whitened(views, data)
            value = float(np.sum(e**2) + np.sum((target - P @ p) ** 2))
        return views, e, J, value if np.isfinite(value) else np.inf

    views, e, J, cost = at(p, R)
    damping, stop, steps, converged = 1e-4, "max_steps", 0, False
    if not np.isfinite(cost):
        stop, max_steps = "impossible_start", 0
    for steps in range(1, max_steps + 1):  # noqa: B007
        D = np.concatenate([_design(J, data, n, T), P_all])
        r = np.concatenate([e.ravel(), target - P @ p])
        A, g = D.T @ D, D.T @ r
        diagonal = np.maximum(np.diagonal(A), 1e-12 * np.diagonal(A).max())
        step = np.linalg.lstsq(A + damping * np.diag(diagonal), g, rcond=1e-15)[0]
        longest = max(np.abs(step[log_f]).max(initial=0.0), np.abs(step[m:]).max(initial=0.0)) / MAX_STEP
        step = step / max(longest, 1.0)
        turned = np.concatenate([np.eye(3)[None], rotation.exp(step[m:].reshape(-1, 3)) @ R[1:]])
        new = at(p + step[:m], rotation.orthonormalise(turned))
        if new[3] <= cost:
            decrement = float(step @ g)
            p, R = p + step[:m], new[0].R
            views, e, J, cost = new
            if decrement < 1e-6 and longest <= 1 and damping < 1e-2:
                stop, converged = "converged", True
                break
            damping = max(damping * 0.1, 1e-12)
        else:
            if abs(float(step @ g)) < 1e-12 * max(cost, 1.0):
                stop, converged = "rounding", True
                break
            damping = max(damping, 1e-8) * 10
            if damping > 1e10:
                stop = "singular"
                break
    cov = np.full((PER_VIEW * n,) * 2, np.nan)
    if np.isfinite(cost):
        cov = covariance(*fisher(views, data, model, aspect=aspect, priors=priors))
    chi2 = float(np.sum(e**2)) if np.isfinite(cost) else float("nan")
    prior_part = float(np.sum((target - P @ p) ** 2))
    dof = 8 * len(data.a) + len(target) - m - 3 * (n - 1)
    return Estimate(
        views=views,
        cov=cov,
        chi2=chi2 + prior_part,
        dof=dof,
        cost=cost,
        converged=converged,
        stop=stop,
        n_steps=steps,
    )
