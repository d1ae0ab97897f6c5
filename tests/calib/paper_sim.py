"""The simulation of Seo, Ahn, Hong 2000 (calibration.md 5.1): a unit cube of points in front of a turning camera.

Views and noise as goldens.json has them under 'simulation'; what the print leaves open is listed there.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.homography_fit import fit_homography
from calib.likelihood import PER_VIEW, GaussianPriors, Observations, Views, covariance, fisher, observe

Array = NDArray[np.float64]
SIZE_PX = (640, 480)
GOLDENS: dict[str, Any] = json.loads(Path(__file__).with_name("goldens.json").read_text(encoding="utf-8"))


def euler(rx_deg: float, ry_deg: float, rz_deg: float) -> Array:
    """R = Rz(rz) Ry(ry) Rx(rx), all right-handed, degrees: the order that the goldens assume."""
    x, y, z = np.deg2rad((rx_deg, ry_deg, rz_deg))
    Rx = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    Ry = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    Rz = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return Rz @ Ry @ Rx


def euler_angles(R: Array) -> Array:
    """(rx, ry, rz) degrees of R (3, 3): inverse of `euler`."""
    return np.rad2deg(
        [np.arctan2(R[2, 1], R[2, 2]), np.arcsin(np.clip(-R[2, 0], -1, 1)), np.arctan2(R[1, 0], R[0, 0])]
    )


def cameras(alpha: list[float], beta_over_alpha: float, rxyz: list[list[float]]) -> Views:
    """True cameras of view 0 (R = I) and those turned by rxyz degrees, principal point (330, 230)."""
    n = len(alpha)
    log_a = np.log(np.array(alpha, float))
    theta = np.column_stack([log_a, log_a + np.log(beta_over_alpha), np.full(n, 330.0), np.full(n, 230.0)])
    return Views(theta=theta, R=np.array([np.eye(3), *(euler(*angles) for angles in rxyz)]))


def table_cameras(table: str) -> Views:
    """The views of T2, T3, T9 or T10."""
    v = GOLDENS["simulation"]["views_ours"][table]
    return cameras(v["alpha"], v.get("beta_over_alpha", 1.0), v["rxyz"])


def K_of(theta: Array) -> Array:
    """Calibration matrices (n, 3, 3) px of theta (n, 4)."""
    K = np.zeros((len(theta), 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = np.exp(theta[:, 0]), np.exp(theta[:, 1]), 1.0
    K[:, :2, 2] = theta[:, 2:]
    return K


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One draw: homographies H_k_0 (N, 3, 3) and covariances (N, 9, 9)."""

    H: Array
    cov: Array


def draw(
    rng: np.random.Generator, views: Views, *, sigma_px: float, two_sided: bool, noisy: bool = True,
    n_matches: int = 100, method: str = "ml",
) -> Run:  # fmt: skip
    """Homographies from fresh points of the cube; noise on the view-k points, two_sided: on both, drawn per pair."""
    K = K_of(views.theta)
    X = rng.uniform(-0.5, 0.5, (n_matches, 3)) + np.array([0, 0, 4.5])
    first = X @ K[0].T
    first = first[:, :2] / first[:, 2:]
    H, cov = [], []
    for k in range(1, len(K)):
        seen = X @ (K[k] @ views.R[k]).T
        seen = seen[:, :2] / seen[:, 2:]
        noise_0, noise_k = rng.standard_normal((2, n_matches, 2)) * (sigma_px if noisy else 0.0)
        found = fit_homography(
            first + two_sided * noise_0, seen + noise_k, sigma_px=sigma_px, two_sided=two_sided, method=method
        )
        H.append(found.H)
        cov.append(found.cov)
    return Run(H=np.array(H), cov=np.array(cov))


def star(run: Run) -> Observations:
    """The homographies of a run as the likelihood takes them."""
    n = len(run.H) + 1
    return observe(run.H, run.cov, np.zeros(n - 1, int), np.arange(1, n), SIZE_PX)


def bound(
    rng: np.random.Generator, views: Views, model: str, *, sigma_px: float, two_sided: bool, n_draws: int = 100,
    priors: GaussianPriors | None = None,
) -> Array:  # fmt: skip
    """Cramer-Rao bound (n, 7): standard deviations of log fx, log fy, cx, cy, rotation; rms over draws of points."""
    variance = []
    for _ in range(n_draws):
        data = star(draw(rng, views, sigma_px=sigma_px, two_sided=two_sided, noisy=False))
        variance.append(np.diagonal(covariance(*fisher(views, data, model, priors=priors))))
    return np.sqrt(np.mean(variance, 0)).reshape(-1, PER_VIEW)
