"""Focal lengths from homographies in closed form, for many candidate principal points at once, and their search.

One reference view 0, homographies H_k = H_k_0 into the others. For each candidate principal point: the linear
equations (33) or (38) of Seo, Ahn, Hong 2000 over all homographies, the other views' focal lengths (34), (35), (39),
(40), the rotations (36) and the error E (41); the search of Fig. 1 and Fig. 3 takes the smallest E. Unweighted it is
the paper's algorithm; with the homographies' covariance the equations are whitened (calibration.md 4.4). Everything is
scaled by 1 / W first: in pixel units the equations are useless (calibration.md 4.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import homography
from calib.camera_matrix import nearest_rotation, orthogonality_error
from calib.observability import common_axis
from calib.rotation import project_so3

Array = NDArray[np.float64]
EQUATIONS = ((0, 1), (0, 2), (1, 2))  # b12, b13, b23
WEIGHT_PASSES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchOptions:
    """The search for the principal point, Fig. 1 and Fig. 3: lengths are fractions of the width W.

    centre_px: where it begins (None: the picture's centre). half_width: of the square window (.1 W about is 60 px at
    640). n_grid: candidates a side; n_levels: each about the best one with a quarter of the step. A best candidate on
    the window's edge at the first level doubles the window once.
    """

    centre_px: tuple[float, float] | None = None
    half_width: float = 60 / 640
    n_grid: int = 13
    n_levels: int = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearCameras:
    """Cameras of the n = N + 1 views by the linear equations: view 0 is the reference.

    alpha, beta (n,) = fx, fy px; pp_px (2,); R (n, 3, 3) = R_k_0, nearest rotations; error: E of eq. (41).
    status: 'ok', 'linear_invalid' (no candidate has real focal lengths: NaN) or 'pp_at_search_border'.
    valid_share: of the first level's candidates that have real focal lengths.
    """

    alpha: Array
    beta: Array
    pp_px: Array
    R: Array
    error: float
    status: str
    valid_share: float


def centred_at(H: Array, pp_px: Array, width_px: float, y_scale: float = 1.0) -> Array:
    """H (N, 3, 3) in ((x - pp_x), y_scale (y - pp_y)) / W of both views for candidates pp_px (C, 2): (C, N, 3, 3)."""
    T = np.zeros((len(pp_px), 1, 3, 3))
    T[..., 0, 0], T[..., 1, 1], T[..., 2, 2] = 1 / width_px, y_scale / width_px, 1.0
    T[:, 0, 0, 2], T[:, 0, 1, 2] = -pp_px[:, 0] / width_px, -y_scale * pp_px[:, 1] / width_px
    return homography.normalise(T @ H @ np.linalg.inv(T))


def _candidates(H: Array, squares_px: bool, weights: Array) -> tuple[Array, Array]:
    """alpha, beta (C, n) in widths of centred homographies (C, N, 3, 3), NaN where a square is not positive.

    squares_px: alpha = beta (coordinates squared up). weights: (N, 3, 3) whitening of the three equations.
    """
    left = np.stack([H[..., i, :2] * H[..., j, :2] for i, j in EQUATIONS], -2)  # (C, N, 3, 2)
    right = np.stack([-H[..., i, 2] * H[..., j, 2] for i, j in EQUATIONS], -1)
    left, right = weights @ left, (weights @ right[..., None])[..., 0]
    with np.errstate(all="ignore"):
        if squares_px:
            one = left.sum(-1)
            square = (np.sum(one * right, (-1, -2)) / np.sum(one * one, (-1, -2)))[:, None] * np.ones(2)
        else:
            A = np.einsum("cnei,cnej->cij", left, left)
            b = np.einsum("cnei,cne->ci", left, right)
            det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] ** 2
            square = np.stack([A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1],
                               A[:, 0, 0] * b[:, 1] - A[:, 0, 1] * b[:, 0]], -1) / det[:, None]  # fmt: skip
        g = np.concatenate([square, np.ones((len(square), 1))], -1)
        b_kk = np.einsum("cnij,cj->cni", H * H, g)
        ratio = b_kk[..., :2] / b_kk[..., 2:]
        if squares_px:
            ratio = ratio.mean(-1, keepdims=True) * np.ones(2)  # (39) and (40): the paper does not say which
        squares = np.concatenate([square[:, None], ratio], 1)  # (C, n, 2)
        valid = np.isfinite(squares).all((1, 2)) & (squares > 0).all((1, 2))
        focal = np.sqrt(np.where(valid[:, None, None], squares, np.nan))
    return focal[..., 0], focal[..., 1]


def _rotations(H: Array, alpha: Array, beta: Array) -> Array:
    """K_k^-1 H_k K_0 with det 1 (C, N, 3, 3), eq. (36), of centred homographies."""
    K = np.stack([alpha, beta, np.ones_like(alpha)], -1)  # (C, n, 3) diagonals
    return homography.normalise(H * K[:, :1, None, :] / K[:, 1:, :, None])


def _axis_weights(H: Array, square: bool) -> Array:
    """The paper's axis rules (Sect. 5.1): about x only b23 counts, about y only b13; (N, 3, 3) zero-one diagonals."""
    out = np.broadcast_to(np.eye(3), (len(H), 3, 3)).copy()
    if not square:
        return out
    for k, one in enumerate(H):
        # The axis hardly depends on the focal; 1.5 widths stands for it.
        K = np.diag([1.5, 1.5, 1.0])
        axis = np.abs(common_axis(np.stack([np.eye(3), nearest_rotation(one, K, K)])))
        if axis[0] > np.cos(np.deg2rad(5)):
            out[k] = np.diag([0.0, 0.0, 1.0])
        elif axis[1] > np.cos(np.deg2rad(5)):
            out[k] = np.diag([0.0, 1.0, 0.0])
    return out


def whitening(H: Array, cov: Array, g: Array) -> Array:
    """Square roots (N, 3, 3) of the inverse covariance of b12, b13, b23, eq. (27)-(32), calibration.md 4.4.

    H (N, 3, 3) centred, cov (N, 9, 9) of its row-major entries, g (3,) = (alpha0^2, beta0^2, 1).
    """
    J = np.zeros((len(H), 3, 9))
    for row, (i, j) in enumerate(EQUATIONS):
        J[:, row, 3 * i : 3 * i + 3] = g * H[:, j]
        J[:, row, 3 * j : 3 * j + 3] += g * H[:, i]
    V = J @ cov @ np.swapaxes(J, 1, 2)
    V = V + 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(V)), 1, 2)


def cov_centred(H: Array, cov: Array, pp_px: Array, width_px: float, y_scale: float) -> Array:
    """Covariance (N, 9, 9) of the centred homographies' entries, for one principal point (2,)."""
    T = np.array([[1, 0, -pp_px[0]], [0, y_scale, -y_scale * pp_px[1]], [0, 0, width_px]]) / width_px
    map9 = np.kron(T, np.linalg.inv(T).T)
    raw = T @ H @ np.linalg.inv(T)
    return map9 @ cov @ map9.T / np.cbrt(np.linalg.det(raw))[:, None, None] ** 2


def solve(
    homographies: ArrayLike,
    size_px: tuple[int, int],
    *,
    aspect: float | None = 1.0,
    covariances: ArrayLike | None = None,
    search: SearchOptions | None = None,
    axis_rule: bool = False,
) -> LinearCameras:
    """Cameras from homographies H_k_0 (N, 3, 3), ideal px, by linear equations and a search for the principal point.

    aspect: fx / fy of every view, or None: unknown and free in each view (then N >= 2). covariances (N, 9, 9) of the
    homographies' row-major entries, det-1 gauge: whitens the equations; None: the paper's unweighted ones. axis_rule:
    drop the equations that carry nothing about an axis, as the paper does. Raises ValueError: shapes, too few.
    Source: Seo, Ahn, Hong 2000, Sect. 5 and 6; calibration.md 4.1 to 4.5.
    """
    H = homography.normalise(np.asarray(homographies, float))
    if H.ndim != 3 or H.shape[1:] != (3, 3) or len(H) < (1 if aspect is not None else 2):
        raise ValueError(
            f"homographies must be (N, 3, 3), N >= {1 if aspect is not None else 2}, got {H.shape}"
        )
    search = search or SearchOptions()
    W, square = float(size_px[0]), aspect is not None
    y_scale = float(aspect) if aspect is not None else 1.0
    default = ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    centre = np.array(search.centre_px or default, float)
    weights = _axis_weights(centred_at(H, centre[None], W, y_scale)[0], axis_rule)
    if covariances is not None:
        weights = _weights(H, np.asarray(covariances, float), centre, W, y_scale, square, weights)

    def error(pp: Array) -> Array:
        Hc = centred_at(H, pp, W, y_scale)
        alpha, beta = _candidates(Hc, square, weights)
        E = orthogonality_error(_rotations(Hc, alpha, beta)).sum(-1)
        return np.where(np.isfinite(E), E, np.inf)

    best, share, border = _search(error, centre, search, W)
    Hc = centred_at(H, best[None], W, y_scale)
    alpha, beta = _candidates(Hc, square, weights)
    R = _rotations(Hc, alpha, beta)[0]
    valid = np.isfinite(R).all()
    R = np.concatenate([np.eye(3)[None], project_so3(R)]) if valid else np.full((len(H) + 1, 3, 3), np.nan)
    return LinearCameras(
        alpha=alpha[0] * W, beta=beta[0] * W / y_scale, pp_px=best if valid else np.full(2, np.nan), R=R,
        error=float(error(best[None])[0]),
        status="linear_invalid" if not valid else "pp_at_search_border" if border else "ok", valid_share=share,
    )  # fmt: skip


def _weights(
    H: Array, cov: Array, centre: Array, W: float, y_scale: float, square: bool, rule: Array
) -> Array:
    """Whitening at the centre candidate, reused for all (ten times faster, the same result)."""
    weights, Hc = rule, centred_at(H, centre[None], W, y_scale)
    C9 = cov_centred(H, cov, centre, W, y_scale)
    for _ in range(WEIGHT_PASSES):
        alpha, beta = _candidates(Hc, square, weights)
        if not np.isfinite(alpha).all():
            return weights if weights is not rule else rule
        weights = whitening(Hc[0], C9, np.array([alpha[0, 0] ** 2, beta[0, 0] ** 2, 1.0])) @ rule
    return weights


def _search(
    error: Callable[[Array], Array], centre: Array, search: SearchOptions, W: float
) -> tuple[Array, float, bool]:
    """Best candidate (2,), share of valid ones at the first level, whether it sits on the doubled window's edge."""
    offsets = np.linspace(-1, 1, search.n_grid)
    grid = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    half, best, share, border = search.half_width * W, centre, 0.0, False
    for attempt in range(2):
        E = error(centre + half * grid)
        share = float(np.isfinite(E).mean())
        k = int(np.argmin(E))
        best, border = centre + half * grid[k], bool(np.abs(grid[k]).max() > 1 - 1e-9)
        if not border or not np.isfinite(E[k]) or attempt:
            break
        half *= 2
    half_level = half
    for _ in range(search.n_levels - 1):
        # A quarter of the step: the window of the next level spans one and a half old steps to each side.
        half_level /= 4
        E = error(best + half_level * grid)
        best = best + half_level * grid[int(np.argmin(E))]
    return best, share, border
