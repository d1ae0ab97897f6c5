"""The three models of Seo, Ahn, Hong 2000 as published; kept for comparison, `calibrate` is the estimator to use.

1. fixed principal point, known aspect (Sect. 5, Fig. 1): one homography or more.
2. fixed principal point, unknown aspect (Sect. 6, Fig. 3): two or more, not about the x or the y axis alone.
3. everything but the skew varies (Sect. 7): four or more; Levenberg-Marquardt on eq. (47), started from model 2.

What the print leaves open (calibration.md 4.1, 5.1): pixels are divided by W before squaring, f_k^2 is the mean of (39)
and (40), the search is 13 x 13 over +-60 px at 640, five levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import ArrayLike, NDArray

from calib import homography, rotation
from calib.camera_matrix import orthogonality_error
from calib.linear_models import LinearCameras, SearchOptions, solve
from calib.observability import common_axis

Array = NDArray[np.float64]
EXCEPTIONAL_DEG = 3.0

SENTENCES = {
    "ok": "Solved.",
    "linear_invalid": "No candidate principal point gives real focal lengths.",
    "pp_at_search_border": "The principal point lies at the edge of the searched area: the error is a shallow valley.",
    "exceptional_axis_x": "All rotations are about the x axis: alpha stays free, R_X = D(l,1,1) R_X D(1/l,1,1), (44).",
    "exceptional_axis_y": "All rotations are about the y axis: beta stays free, R_Y = D(1,l,1) R_Y D(1,1/l,1), (45).",
    "too_few_homographies": "Fewer homographies than the model's unknowns need.",
    "max_steps": "Levenberg-Marquardt ran out of steps.",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperCameras:
    """Cameras of n = N + 1 views, view 0 the reference; NaN where refused.

    alpha, beta (n,) = fx, fy px; pp_px (n, 2); R (n, 3, 3) = R_k_0; error: E of eq. (41), (43), (47), dimensionless,
    without statistical meaning. status: key of SENTENCES; reason: its sentence. error_start: E before model 3's steps.
    """

    alpha: Array
    beta: Array
    pp_px: Array
    R: Array
    error: float
    status: str
    reason: str
    error_start: float = float("nan")


def _refused(n: int, status: str) -> PaperCameras:
    nan = np.full(n, np.nan)
    return PaperCameras(
        alpha=nan, beta=nan.copy(), pp_px=np.full((n, 2), np.nan), R=np.full((n, 3, 3), np.nan), error=float("nan"),
        status=status, reason=SENTENCES[status],
    )  # fmt: skip


def _from_linear(found: LinearCameras) -> PaperCameras:
    n = len(found.alpha)
    return PaperCameras(
        alpha=found.alpha, beta=found.beta, pp_px=np.broadcast_to(found.pp_px, (n, 2)).copy(), R=found.R,
        error=found.error, status=found.status, reason=SENTENCES[found.status],
    )  # fmt: skip


def fixed_pp_known_aspect(
    homographies: ArrayLike,
    size_px: tuple[int, int],
    *,
    aspect: float = 1.0,
    search: SearchOptions | None = None,
    axis_rule: bool = True,
) -> PaperCameras:
    """Model 1, Sect. 5 and Fig. 1. homographies H_k_0 (N, 3, 3), N >= 1, ideal px; aspect = fx / fy.

    axis_rule: the paper's switching off of equations for rotations about x or y. Raises ValueError: shapes.
    """
    return _from_linear(solve(homographies, size_px, aspect=aspect, search=search, axis_rule=axis_rule))


def exceptional_axis(homographies: ArrayLike, size_px: tuple[int, int]) -> str:
    """'exceptional_axis_x' or '_y' when all rotations of H_k_0 (N, 3, 3) share that axis to 3 degrees, else ''.

    The axis is taken from square pixels of 1.5 W; it moves by less than the tolerance with either. Eq. (44)-(46).
    """
    H = np.asarray(homographies, float)
    K = np.array([[1.5 * size_px[0], 0, size_px[0] / 2], [0, 1.5 * size_px[0], size_px[1] / 2], [0, 0, 1.0]])
    scaled = homography.normalise(np.linalg.solve(K, H @ K))
    # Zoom out of the way: H in these coordinates is about diag(z, z, 1) R.
    zoom = np.sqrt(np.linalg.norm(scaled[:, 0], axis=-1) * np.linalg.norm(scaled[:, 1], axis=-1))
    zoom = zoom / np.linalg.norm(scaled[:, 2], axis=-1)
    R = rotation.project_so3(
        homography.normalise(scaled / np.stack([zoom, zoom, np.ones_like(zoom)], -1)[..., None])
    )
    axis = common_axis(np.concatenate([np.eye(3)[None], R]), tolerance_rad=np.deg2rad(EXCEPTIONAL_DEG))
    if np.isfinite(axis).all():
        for k, name in enumerate("xy"):
            if np.abs(axis[k]) > np.cos(np.deg2rad(EXCEPTIONAL_DEG)):
                return f"exceptional_axis_{name}"
    return ""


def fixed_pp_unknown_aspect(
    homographies: ArrayLike, size_px: tuple[int, int], *, search: SearchOptions | None = None
) -> PaperCameras:
    """Model 2, Sect. 6 and Fig. 3. homographies H_k_0 (N, 3, 3), N >= 2, ideal px; every view has its own aspect.

    Rotations about the x axis alone leave alpha free, about y beta: refused with the reason. Raises ValueError: shapes.
    """
    H = np.asarray(homographies, float)
    if H.ndim != 3 or H.shape[1:] != (3, 3):
        raise ValueError(f"homographies must be (N, 3, 3), got {H.shape}")
    if len(H) < 2:
        return _refused(len(H) + 1, "too_few_homographies")
    exceptional = exceptional_axis(H, size_px)
    if exceptional:
        return _refused(len(H) + 1, exceptional)
    return _from_linear(solve(H, size_px, aspect=None, search=search))


def _calibration(theta: Array) -> Array:
    """K (n, 3, 3) of theta (n, 4) = alpha, beta, x, y."""
    K = np.zeros((len(theta), 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = theta[:, 0], theta[:, 1], 1.0
    K[:, 0, 2], K[:, 1, 2] = theta[:, 2], theta[:, 3]
    return K


_DK = np.zeros((4, 3, 3))
_DK[0, 0, 0] = _DK[1, 1, 1] = _DK[2, 0, 2] = _DK[3, 1, 2] = 1.0


def orthogonality_residuals(theta: Array, H: Array) -> tuple[Array, Array, Array]:
    """R R^T - I (N, 3, 3) of eq. (36) and its derivatives by theta_0 and theta_k (N, 4, 3, 3).

    theta (n, 4) = alpha, beta, x, y px; H (N, 3, 3) = H_k_0.
    The sum of squares, twice, is E of eq. (47): R R^T - I and R^T R - I have the same eigenvalues.
    """
    K = _calibration(theta)
    R = homography.normalise(np.linalg.solve(K[1:], H @ K[0]))
    S = R @ np.swapaxes(R, 1, 2)

    def by(D: Array) -> Array:  # of dR = D (..., 3, 3)
        half = D @ np.swapaxes(R, 1, 2)[:, None]
        return half + np.swapaxes(half, -1, -2)

    own = np.linalg.inv(K[1:])[:, None] @ _DK  # K_k^-1 dK
    trace = np.trace(own, axis1=-1, axis2=-2)[..., None, None]
    d_k = -own @ R[:, None] + trace / 3 * R[:, None]
    first = np.linalg.inv(K[0]) @ _DK
    trace = np.trace(first, axis1=-1, axis2=-2)[..., None, None]
    d_0 = R[:, None] @ first - trace / 3 * R[:, None]
    return S - np.eye(3), by(d_0), by(d_k)


def all_vary(
    homographies: ArrayLike,
    size_px: tuple[int, int],
    *,
    start: PaperCameras | None = None,
    max_steps: int = 200,
) -> PaperCameras:
    """Model 3, Sect. 7: alpha, beta, x, y of every view by Levenberg-Marquardt on E of eq. (47).

    homographies H_k_0 (N, 3, 3), N >= 4, ideal px; start: cameras to begin from (None: model 2's). With four
    homographies E = 0 is reachable and says nothing (calibration.md 5.3). Raises ValueError: shapes.
    """
    H = np.asarray(homographies, float)
    if H.ndim != 3 or H.shape[1:] != (3, 3):
        raise ValueError(f"homographies must be (N, 3, 3), got {H.shape}")
    n = len(H) + 1
    if len(H) < 4:
        return _refused(n, "too_few_homographies")
    begin = start or fixed_pp_unknown_aspect(H, size_px)
    if not np.isfinite(begin.alpha).all():
        return begin
    unit = np.array([begin.alpha[0], begin.alpha[0], begin.alpha[0], begin.alpha[0]])
    x0 = np.column_stack([begin.alpha, begin.beta, begin.pp_px]) / unit

    def value(x: Array) -> Array:
        return orthogonality_residuals(x.reshape(n, 4) * unit, H)[0].ravel() * np.sqrt(2)

    def jacobian(x: Array) -> Array:
        _, d_0, d_k = orthogonality_residuals(x.reshape(n, 4) * unit, H)
        J = np.zeros((n - 1, 9, n, 4))
        J[:, :, 0] = np.swapaxes(d_0.reshape(n - 1, 4, 9), 1, 2)
        for k in range(n - 1):
            J[k, :, k + 1] = d_k[k].reshape(4, 9).T
        return (J * unit).reshape(9 * (n - 1), 4 * n) * np.sqrt(2)

    # A trust region with bounds only keeps alpha and beta positive; inside it is Levenberg-Marquardt.
    low = np.tile([1e-3, 1e-3, -np.inf, -np.inf], n)
    found = scipy.optimize.least_squares(
        value, x0.ravel(), jac=jacobian, bounds=(low, np.inf), method="trf", x_scale="jac", max_nfev=max_steps,
        xtol=1e-12, ftol=1e-12, gtol=1e-14,
    )  # fmt: skip
    theta = found.x.reshape(n, 4) * unit
    K = _calibration(theta)
    R = homography.normalise(np.linalg.solve(K[1:], H @ K[0]))
    status = "ok" if found.status > 0 else "max_steps"
    return PaperCameras(
        alpha=theta[:, 0], beta=theta[:, 1], pp_px=theta[:, 2:].copy(),
        R=np.concatenate([np.eye(3)[None], rotation.project_so3(R)]), error=float(orthogonality_error(R).sum()),
        status=status, reason=SENTENCES[status], error_start=float(np.sum(value(x0.ravel()) ** 2)),
    )  # fmt: skip
