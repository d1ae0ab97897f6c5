"""What `calibrate` gives: cameras of a few views with covariance, and the verdict whether the focal may be claimed.

Gates as in calibration.md 7, for homographies between ideal pixels: never a guess, always a reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from calib import paper, rotation
from calib.gates import SENTENCES as GATE_SENTENCES
from calib.likelihood import PER_VIEW, Estimate
from calib.observability import observability

Array = NDArray[np.float64]

MIN_MOTION_W = 0.02  # of the picture's centre, in widths, below which a shot "hardly turns"; as GateOptions

SENTENCES = {
    code: GATE_SENTENCES[code]
    for code in (
        "ok", "too_few_edges", "not_converged", "linear_invalid", "focal_unobservable", "no_rotation", "zoom_only",
        "roll_only", "perspective_signal_below_systematics", "model_misfit", "pp_at_border", "focal_out_of_range",
        "ambiguous",
    )
} | {
    "exceptional_axis_x": paper.SENTENCES["exceptional_axis_x"],
    "exceptional_axis_y": paper.SENTENCES["exceptional_axis_y"],
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateOptions:
    """Priors and limits of `calibrate`. Lengths are fractions of the width W, so that they scale with the picture.

    aspect: fx / fy, used by model 'square'; aspect_std: of log(fx / fy) about it, for the models that free it (None:
    no prior). pp_px: prior principal point (None: the centre), pp_std: its error (None: no prior; 'zero_skew' has 15 px
    at 1920 then, because without one the model is singular or nearly so); pp_views_px: one per view instead, for
    'zero_skew'. max_sigma: largest relative error worth a
    claim. systematic_px: error that all homographies may share (parallax, lens), at W = 1280; its effect is added as
    10 % x systematic_px / S10. max_chi2_dof: beyond it, and beyond chance (1e-4), the model does not fit. f_range_w: in
    widths. pp_limit: offset from the centre beyond which a principal point without prior is impossible.
    """

    aspect: float = 1.0
    aspect_std: float | None = None
    pp_px: tuple[float, float] | None = None
    pp_views_px: tuple[tuple[float, float], ...] = ()
    pp_std: float | None = None
    max_sigma: float = 0.1
    systematic_px: float = 0.05
    max_chi2_dof: float = 6.0
    f_range_w: tuple[float, float] = (0.3, 20.0)
    pp_limit: float = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Cameras of n views and what may be said about them.

    fx_px, fy_px (n,), pp_px (n, 2), R (n, 3, 3) = R_k_0 (axes of view 0 into view k). cov (7 n, 7 n): of log fx,
    log fy, cx, cy, rotation increment (left, rad), view by view; statistical, inflated by chi2 / dof where that is
    beyond chance. sigma_log_f: total relative error of the focal length, systematic part included. s10_px: px that
    10 % of focal move the best homography. claims_focal, reason, sentence: the verdict. known: the intrinsics that are
    known to max_sigma even where the focal is not claimed ('fx', 'fy'). needed: the motion that would help, '' if none.
    chi2, dof; converged; start_status: of the linear search; n_steps. Values are the optimum's even without a claim.
    """

    fx_px: Array
    fy_px: Array
    pp_px: Array
    R: Array
    cov: Array
    sigma_log_f: float
    s10_px: float
    chi2: float
    dof: int
    claims_focal: bool
    reason: str
    sentence: str
    known: tuple[str, ...]
    needed: str
    converged: bool
    start_status: str
    n_steps: int

    def _std(self, column: int) -> Array:
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diagonal(self.cov)).reshape(-1, PER_VIEW)[:, column]

    @property
    def fx_std_px(self) -> Array:
        """Statistical standard deviation of fx (n,) px."""
        return self.fx_px * self._std(0)

    @property
    def fy_std_px(self) -> Array:
        """Statistical standard deviation of fy (n,) px."""
        return self.fy_px * self._std(1)

    @property
    def pp_std_px(self) -> Array:
        """Statistical standard deviations of the principal point (n, 2) px."""
        return np.stack([self._std(2), self._std(3)], 1)

    def K(self) -> Array:
        """Calibration matrices (n, 3, 3) px."""
        out = np.zeros((len(self.fx_px), 3, 3))
        out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = self.fx_px, self.fy_px, 1.0
        out[:, :2, 2] = self.pp_px
        return out

    def cov_of(self, view: int, names: Sequence[str]) -> Array:
        """Covariance (k, k) px^2 of some of 'fx', 'fy', 'cx', 'cy' of a view. Raises ValueError: another name."""
        scale = {"fx": self.fx_px[view], "fy": self.fy_px[view], "cx": 1.0, "cy": 1.0}
        if set(names) - set(scale):
            raise ValueError(f"names must be of {tuple(scale)}, got {tuple(names)}")
        rows = PER_VIEW * view + np.array([tuple(scale).index(name) for name in names])
        s = np.array([scale[name] for name in names])
        return self.cov[np.ix_(rows, rows)] * s[:, None] * s[None, :]

    def ellipse(self, view: int, names: tuple[str, str], *, probability: float = 0.95, n: int = 72) -> Array:
        """Points (n, 2) px on the error ellipse of two intrinsics of a view that holds the truth with `probability`."""
        centre = dict(
            zip(
                ("fx", "fy", "cx", "cy"), (self.fx_px[view], self.fy_px[view], *self.pp_px[view]), strict=True
            )
        )
        values, vectors = np.linalg.eigh(self.cov_of(view, names))
        radius = np.sqrt(np.maximum(values, 0) * -2 * np.log1p(-probability))
        t = np.linspace(0, 2 * np.pi, n, endpoint=False)
        circle = np.stack([np.cos(t), np.sin(t)])
        return np.array([centre[name] for name in names]) + (vectors @ (radius[:, None] * circle)).T


def verdict(
    best: Estimate, others: list[Estimate], s10: tuple[float, float], status: str,
    moved_w: float, size_px: tuple[int, int], model: str, options: CalibrateOptions,
) -> Calibration:  # fmt: skip
    """The Calibration of the best optimum; others: the other starts' optima; status: of the linear search;

    moved_w: largest motion of the picture's centre, in widths."""
    theta, n = best.views.theta, len(best.views.theta)
    chance = float(gammaincc(best.dof / 2, best.chi2 / 2)) if best.dof > 0 and np.isfinite(best.chi2) else 1.0
    inflation = max(best.chi2 / best.dof, 1.0) if chance < 0.01 else 1.0
    cov = best.cov * inflation
    sigma = [sigma_mean(cov, n, column) for column in (0, 1)]
    systematic = [0.1 * options.systematic_px * size_px[0] / 1280 / s if s > 0 else np.inf for s in s10]
    total = [float(np.hypot(*pair)) for pair in zip(sigma, systematic, strict=True)]
    known = tuple(
        name
        for name, value in zip(("fx", "fy"), total, strict=True)
        if best.converged and value <= options.max_sigma
    )
    reason = _reason(best, others, known, max(systematic), chance, status, moved_w, size_px, model, options)
    with np.errstate(over="ignore"):
        f = np.exp(theta[:, :2])
    fine = np.isfinite(best.views.R).all()
    needed = ""
    if reason != "ok" and fine:
        # What moved less than the errors did not move, whatever the noisy rotations say.
        moved = best.views.R if reason not in ("no_rotation", "zoom_only") else best.views.R[:1]
        square = model in ("square", "shared_aspect") and not reason.startswith("exceptional")
        needed = observability(moved, square_pixels=square).needed
    return Calibration(
        fx_px=f[:, 0], fy_px=f[:, 1], pp_px=theta[:, 2:].copy(), R=best.views.R, cov=cov, sigma_log_f=max(total),
        s10_px=min(s10), chi2=best.chi2, dof=best.dof, claims_focal=reason == "ok", reason=reason,
        sentence=SENTENCES[reason], known=known, needed=needed, converged=best.converged, start_status=status,
        n_steps=best.n_steps,
    )  # fmt: skip


def sigma_mean(cov: Array, n: int, column: int) -> float:
    """Standard deviation of the mean over n views of a column of cov (7 n, 7 n); inf where it is not known."""
    rows = np.arange(n) * PER_VIEW + column
    value = float(cov[np.ix_(rows, rows)].mean())
    return float(np.sqrt(value)) if np.isfinite(value) and value >= 0 else float("inf")


def _reason(
    best: Estimate, others: list[Estimate], known: tuple[str, ...], systematic: float, chance: float, status: str,
    moved_w: float, size_px: tuple[int, int], model: str, options: CalibrateOptions,
) -> str:  # fmt: skip
    if best.stop == "too_few_edges":
        return best.stop
    W = size_px[0]
    views = best.views
    if best.dof > 0 and best.chi2 / best.dof > options.max_chi2_dof and chance < 1e-4:
        return "model_misfit"
    if len(known) < 2:
        return _unknown(best, systematic, model, moved_w)
    if status == "linear_invalid":
        return "linear_invalid"
    f_w = np.exp(views.theta[:, :2]) / W
    if (f_w < options.f_range_w[0]).any() or (f_w > options.f_range_w[1]).any():
        return "focal_out_of_range"
    centre = np.array(options.pp_px or ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2))
    if (np.abs(views.theta[:, 2:] - centre) > options.pp_limit * W).any():
        return "pp_at_border"
    sigma = max(sigma_mean(best.cov, len(views.theta), k) for k in (0, 1))
    for other in others:
        apart = abs(float(np.mean(other.views.theta[:, :2] - views.theta[:, :2])))
        if other.converged and apart > max(2 * sigma, 0.02) and other.cost - best.cost < 10:
            return "ambiguous"
    return "ok"


def _unknown(best: Estimate, systematic: float, model: str, moved_w: float) -> str:
    """Why the focal is not known: the motion, in the order that explains it best."""
    R, theta = best.views.R, best.views.theta
    # Where the focal is not known the estimated turns mean nothing; the picture's centre says whether it turned.
    if moved_w < MIN_MOTION_W:
        if float(np.ptp(theta[:, 0])) > 0.03:
            return "zoom_only"
        roll = rotation.to_pan_tilt_roll(R)[2]
        return (
            "roll_only"
            if np.isfinite(roll).all() and np.ptp(np.unwrap(roll)) > np.deg2rad(1.5)
            else "no_rotation"
        )
    if model in ("fixed_pp", "shared_aspect", "zero_skew"):
        # Turns about x alone never reveal fx, about y alone never fy, eq. (44)-(46).
        w = rotation.log(R[1:])
        w = w / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-12)
        for k, name in enumerate("xy"):
            if np.all(np.abs(w[:, k]) > np.cos(np.deg2rad(2 * paper.EXCEPTIONAL_DEG))):
                return f"exceptional_axis_{name}"
    if not best.converged:
        return "not_converged"
    return "perspective_signal_below_systematics" if systematic > 0.1 else "focal_unobservable"
