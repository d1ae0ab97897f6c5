"""One call: homographies with covariance in, cameras with covariance and a verdict out. No video, no distortion.

    from calib import calibrate
    found = calibrate(homographies, covariances, size_px=(1920, 1080))
    if found.claims_focal:
        print(found.fx_px, found.fx_std_px)
    else:
        print(found.reason, found.sentence, found.needed)

Homographies between ideal (undistorted) pixels; with distortion to be estimated, or hundreds of frames, use `refine`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography, linear_models, rotation
from calib.calibration import CalibrateOptions, Calibration, sigma_mean, verdict
from calib.likelihood import (
    PER_VIEW,
    Estimate,
    GaussianPriors,
    Observations,
    Views,
    covariance,
    fisher,
    maximise,
    observe,
    predict,
    ties,
)

Array = NDArray[np.float64]
LOOK_STEPS = 8
HOPELESS_SIGMA = 0.3  # of log f, at the best start so far
FOCAL_TRIALS_W = (0.6, 0.9, 1.35, 2.0, 3.0, 4.5)


def to_reference(
    homographies: ArrayLike, covariances: ArrayLike, a: ArrayLike, b: ArrayLike, n: int
) -> tuple[Array, Array]:
    """H_k_0 (n - 1, 3, 3) and covariances (n - 1, 9, 9) by the fewest edges from view 0; NaN where none leads there."""
    H, C = homography.normalise(np.asarray(homographies, float)), np.asarray(covariances, float)
    out, cov = np.full((n, 3, 3), np.nan), np.full((n, 9, 9), np.nan)
    out[0], cov[0] = np.eye(3), 0.0
    links = list(zip(np.asarray(a, int).tolist(), np.asarray(b, int).tolist(), range(len(H)), strict=True))
    front = [0]
    while front:
        reached = []
        for v in front:
            for i, j, k in links:
                if v not in (i, j) or np.isfinite(out[other := j if v == i else i]).all():
                    continue
                step, step_cov = H[k], C[k]
                if v == j:  # the edge runs inwards: d(H^-1) = -H^-1 dH H^-1
                    step = np.linalg.inv(step)
                    J = np.kron(step, step.T)
                    step_cov = J @ step_cov @ J.T
                left, right = np.kron(np.eye(3), out[v].T), np.kron(step, np.eye(3))
                out[other] = step @ out[v]
                cov[other] = left @ step_cov @ left.T + right @ cov[v] @ right.T
                reached.append(other)
        front = reached
    return out[1:], cov[1:]


def _priors(model: str, n: int, size_px: tuple[int, int], options: CalibrateOptions) -> GaussianPriors | None:
    rows, mean, std = [], [], []
    pp_std = 15 / 1920 if options.pp_std is None and model == "zero_skew" else options.pp_std
    pp = options.pp_px or ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    if options.pp_views_px and (model != "zero_skew" or len(options.pp_views_px) != n):
        raise ValueError(
            f"pp_views_px is for model 'zero_skew', one per view: {n}, got {len(options.pp_views_px)}"
        )
    each = options.pp_views_px or (pp,) * n
    views = range(n) if model == "zero_skew" else (0,)
    if pp_std is not None:
        for k in views:
            for column in (2, 3):
                row = np.zeros((n, 4))
                row[k, column] = 1.0
                rows.append(row.ravel())
                mean.append(each[k][column - 2])
                std.append(pp_std * size_px[0])
    if options.aspect_std is not None and model != "square":
        for k in range(n) if model != "shared_aspect" else (0,):
            row = np.zeros((n, 4))
            row[k, :2] = 1.0, -1.0
            rows.append(row.ravel())
            mean.append(float(np.log(options.aspect)))
            std.append(options.aspect_std)
    if not rows:
        return None
    return GaussianPriors(A=np.array(rows), mean=np.array(mean), std=np.array(std))


def _starts(
    H: Array, cov: Array, size_px: tuple[int, int], model: str, options: CalibrateOptions
) -> tuple[list[Views], str]:
    """The weighted linear solution, and a grid of focal lengths at the centre, where the linear one may have failed."""
    n, aspect = len(H) + 1, options.aspect if model == "square" or options.aspect_std is not None else 1.0
    centre = options.pp_px or ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    search = linear_models.SearchOptions(centre_px=centre)
    status, starts = "linear_invalid", []
    trials: list[float | None] = [aspect] if model == "square" else [None, aspect]
    for trial in trials:
        if trial is None and len(H) < 2:
            continue
        found = linear_models.solve(H, size_px, aspect=trial, covariances=cov, search=search)
        status = found.status if status == "linear_invalid" else status
        if found.status != "linear_invalid":
            theta = np.column_stack([np.log(found.alpha), np.log(found.beta), np.tile(found.pp_px, (n, 1))])
            starts.append(Views(theta=theta, R=found.R))
    W, pp = size_px[0], np.array(centre, float)
    Hc = linear_models.centred_at(H, pp[None], W, aspect)[0]
    for f in FOCAL_TRIALS_W:
        # Zoom along each homography at this focal, eq. (39), (40), and its rotation.
        scaled = Hc * np.array([f, f, 1.0])
        Q = scaled @ np.swapaxes(scaled, 1, 2)
        with np.errstate(all="ignore"):
            f_k = np.sqrt((Q[:, 0, 0] + Q[:, 1, 1]) / (2 * Q[:, 2, 2]))
        R = rotation.project_so3(
            homography.normalise(scaled / np.stack([f_k, f_k, np.ones_like(f_k)], -1)[..., None])
        )
        alpha = np.concatenate([[f], f_k]) * W
        theta = np.column_stack([np.log(alpha), np.log(alpha / aspect), np.tile(pp, (n, 1))])
        starts.append(Views(theta=theta, R=np.concatenate([np.eye(3)[None], R])))
    return starts, status


def _same(on_its_way: Estimate, optimum: Estimate) -> bool:
    """Whether an unfinished iteration is about to end at a known optimum: close by, and with little left to gain."""
    if not optimum.converged or on_its_way.cost - optimum.cost > 1.0:
        return False
    return bool(np.abs(on_its_way.views.theta[:, :2] - optimum.views.theta[:, :2]).max() < 0.01)


def perspective_signal_px(
    views: Views, data: Observations, model: str, aspect: float, priors: GaussianPriors | None
) -> tuple[float, float]:
    """S10 of fx and of fy: rms px that the best edge moves when the mean log is forced by .1, all else re-optimised."""
    n = len(views.theta)
    cov = covariance(*fisher(views, data, model, aspect=aspect, priors=priors))
    _, J = predict(views, data)
    out = []
    for column in (0, 1):
        rows = np.arange(n) * PER_VIEW + column
        direction = cov[:, rows].mean(1)
        variance = float(direction[rows].mean())
        if not np.isfinite(variance) or variance <= 0:
            out.append(0.0)
            continue
        move = (0.1 * np.nan_to_num(direction) / variance).reshape(n, PER_VIEW)
        px = np.einsum("epij,ej->epi", J, np.concatenate([move[data.a], move[data.b]], 1))
        out.append(float(np.sqrt(np.nanmax(np.mean(np.sum(px**2, -1), 1)))))
    return out[0], out[1]


def calibrate(
    homographies: ArrayLike,
    covariances: ArrayLike,
    *,
    size_px: tuple[int, int],
    pairs: ArrayLike | None = None,
    model: str = "square",
    options: CalibrateOptions | None = None,
) -> Calibration:
    """Cameras of a rotating and zooming camera from homographies with covariance; the verdict is part of the result.

    homographies (E, 3, 3): H_b_a, ideal px (pixel (0, 0) is the top-left pixel's centre), any scale. covariances
    (E, 9, 9) px units: of the row-major entries of det-1 homographies, as `fit_homography` gives them. size_px (W, H).
    pairs (E, 2): view numbers (a, b) from 0, any graph joined to view 0; None: (0, 1), (0, 2), ...
    model: 'square' (fx / fy known, one principal point: one homography suffices), 'shared_aspect' (fx / fy one unknown
    more), 'fixed_pp' (fx and fy free in every view: two homographies), 'zero_skew' (everything free, priors needed:
    four). Raises ValueError: shapes, an unknown model, views that no pair joins to view 0.
    Source: Seo, Ahn, Hong 2000 for the models; calibration.md 4.4 to 4.6 and 7 for estimator and gates.
    """
    options = options or CalibrateOptions()
    H = np.asarray(homographies, float)
    if H.ndim != 3 or H.shape[1:] != (3, 3) or not len(H):
        raise ValueError(f"homographies must be (E, 3, 3), got {H.shape}")
    edges = (
        np.column_stack([np.zeros(len(H), int), np.arange(1, len(H) + 1)])
        if pairs is None
        else np.asarray(pairs)
    )
    if edges.shape != (len(H), 2) or (edges < 0).any() or (edges[:, 0] == edges[:, 1]).any():
        raise ValueError(f"pairs must be (E, 2) different view numbers, got {edges.shape}")
    n = int(edges.max()) + 1
    ties(model, n, options.aspect)
    star, star_cov = to_reference(H, covariances, edges[:, 0], edges[:, 1], n)
    if not np.isfinite(star).all():
        raise ValueError("every view must be joined to view 0 by pairs")
    data = observe(H, covariances, edges[:, 0], edges[:, 1], size_px)
    priors = _priors(model, n, size_px, options)
    if model in ("fixed_pp", "zero_skew") and len(H) < {"fixed_pp": 2, "zero_skew": 4}[model]:
        nan = Views(theta=np.full((n, 4), np.nan), R=np.full((n, 3, 3), np.nan))
        nothing = Estimate(views=nan, cov=np.full((PER_VIEW * n,) * 2, np.nan), chi2=np.nan, dof=0, cost=np.nan,
                           converged=False, stop="too_few_edges", n_steps=0)  # fmt: skip
        return verdict(nothing, [], (0.0, 0.0), "too_few_edges", 0.0, size_px, model, options)
    starts, status = _starts(star, star_cov, size_px, model, options)
    # A few steps tell where a start is bound for; one that comes to a known optimum need not arrive.
    looks = [
        maximise(s, data, model, aspect=options.aspect, priors=priors, max_steps=LOOK_STEPS) for s in starts
    ]
    found = sorted((e for e in looks if np.isfinite(e.cost)), key=lambda e: e.cost) or looks[:1]
    # Where nothing is observable the valley has no end, and one start's way down it is enough.
    hopeless = not max(sigma_mean(found[0].cov, n, k) for k in (0, 1)) < HOPELESS_SIGMA
    for k, one in enumerate(found):
        new = np.isfinite(one.cost) and not one.converged and not any(_same(one, e) for e in found[:k])
        if new and (k == 0 or not hopeless):
            found[k] = maximise(one.views, data, model, aspect=options.aspect, priors=priors)
    found.sort(key=lambda e: (not e.converged, e.cost))
    best, s10 = found[0], (0.0, 0.0)
    if best.converged:
        s10 = perspective_signal_px(best.views, data, model, options.aspect, priors)
    centre = (np.array(size_px, float) - 1) / 2
    moved = homography.apply(np.concatenate([star, homography.invert(star)]), centre[None]) - centre
    moved_w = float(np.nan_to_num(np.linalg.norm(moved, axis=-1), nan=np.inf).max()) / size_px[0]
    return verdict(best, found[1:], s10, status, moved_w, size_px, model, options)
