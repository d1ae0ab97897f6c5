"""How refine() works, and which parameters of the lens it frees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.records import Priors


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineOptions:
    """How refine() works.

    reference: frame with R = I (None: the first of the graph). distortion: False fixes k1 at the priors' mean (for
    comparison only: without it f is 40 % short on real pictures). free_pp: False holds the principal point at its
    prior. zoom_for_c1: log zoom range below which c1 stays at its prior mean. The wider lens (k2, a drifting principal
    point) is asked for by the priors. robust: 'huber' or 'tukey' (Tukey after Huber has converged).
    huber: threshold in sigmas times the robust scale. bad_edge: an edge whose median residual exceeds this many times
    the graph's is dropped. tolerance, max_steps: the keyframe graph's valley is flat, an early stop looks like many
    optima. hopeless_sigma: formal sigma of the leading start from which on only the three best starts are followed
    (nothing is observable, and the valley has no end). k1_trials, focal_trials_w, focal_k1: the starts. thin: points an
    edge in the first, coarse look at a start.
    """

    reference: int | None = None
    distortion: bool = True
    free_pp: bool = True
    zoom_for_c1: float = 0.05
    robust: str = "huber"
    huber: float = 3.0
    bad_edge: float = 5.0
    tolerance: float = 1e-10
    max_steps: int = 400
    k1_trials: tuple[float, ...] = tuple(np.round(np.arange(-0.06, 0.0601, 0.01), 3).tolist())
    focal_trials_w: tuple[float, ...] = (0.6, 0.9, 1.35, 2.0, 3.0, 4.5)
    focal_k1: tuple[float, ...] = (-0.03, 0.0, 0.03)
    thin: int = 10
    hopeless_sigma: float = 0.15


def free_columns(priors: Priors, options: RefineOptions, zoom_range: float) -> NDArray[np.bool_]:
    """Which of pp_x, pp_y, log aspect, c0, c1 move; where the priors ask for the wider lens also k2, drift (x, y)."""
    k1, pp = options.distortion, options.free_pp
    usual = [pp, pp, priors.aspect_std > 0, k1, k1 and zoom_range >= options.zoom_for_c1]
    drift = pp and priors.pp_drift_std > 0
    return np.array([*usual, k1 and priors.k2_std > 0, drift, drift] if priors.wide else usual)
