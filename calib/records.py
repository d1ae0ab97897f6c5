"""Records that calib takes and gives. Points are raw (distorted) pixels unless a name says otherwise; radians.

H_b_a maps pixels of a into b, R_cam_world world axes into camera axes, f is fx in pixels of the decoded width W and is
carried as log f: sigma(log f) is the relative error. Arrays inside a record are read-only: copies, but of what nobody
can write to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import distortion

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def _freeze(record: object, name: str, shape: tuple[int | None, ...], dtype: type = float) -> None:
    given = getattr(record, name)
    # What nobody can write to is shared: of a long shot's pairs there are several records each.
    held = isinstance(given, np.ndarray) and given.flags.owndata and not given.flags.writeable
    value: NDArray[Any] = (
        given if held and given.dtype == np.dtype(dtype) else np.array(given, dtype=dtype, copy=True)
    )
    if value.ndim != len(shape) or any(
        s is not None and s != n for s, n in zip(shape, value.shape, strict=True)
    ):
        raise ValueError(f"{type(record).__name__}.{name} must have shape {shape}, got {value.shape}")
    value.setflags(write=False)
    object.__setattr__(record, name, value)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HomographyEdge:
    """What was measured between frames a and b.

    H (3, 3): a's pixels into b, det 1 (a start value only; NaN is allowed, then it is fitted to the points).
    grid_a, grid_b (m, 2): where a cell's texture lies in a and where it was found in b, raw px.
    info (m, 2, 2): information of grid_b, px^-2, whitened (an unknown direction has about 0).
    kappa: variance inflation of the whole edge (errors shared by its cells), 1 = none.
    """

    a: int
    b: int
    H: Array
    grid_a: Array
    grid_b: Array
    info: Array
    kappa: float = 1.0

    def __post_init__(self) -> None:
        _freeze(self, "H", (3, 3))
        _freeze(self, "grid_a", (None, 2))
        m = len(self.grid_a)
        _freeze(self, "grid_b", (m, 2))
        _freeze(self, "info", (m, 2, 2))
        if self.a == self.b:
            raise ValueError(f"an edge links two different frames, got {self.a} twice")
        if not self.kappa > 0:
            raise ValueError(f"kappa must be positive, got {self.kappa}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HomographyGraph:
    """Frames (n,) by number and the edges between them; size_px (W, H) of every frame. ValueError: unknown frame."""

    frames: IntArray
    edges: tuple[HomographyEdge, ...]
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        _freeze(self, "frames", (None,), int)
        object.__setattr__(self, "edges", tuple(self.edges))
        known = set(self.frames.tolist())
        if len(known) != len(self.frames):
            raise ValueError("frames of a graph must differ")
        for edge in self.edges:
            if edge.a not in known or edge.b not in known:
                raise ValueError(f"edge {edge.a} -> {edge.b} names a frame that the graph does not have")

    def subgraph(self, frames: ArrayLike) -> HomographyGraph:
        """The graph of the given frames and the edges among them."""
        keep = set(np.asarray(frames).tolist())
        return HomographyGraph(
            frames=np.array([f for f in self.frames.tolist() if f in keep], int),
            edges=tuple(e for e in self.edges if e.a in keep and e.b in keep),
            size_px=self.size_px,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lens:
    """Principal point, aspect = fx / fy, and distortion k1_half(f) = c0 + c1 log(f / W) of a shot.

    The wider lens: k2, of the fourth power of the radius (half widths) at every focal; pp_drift_px (2,) px per unit of
    log f, by which the principal point moves from pp_px, where it is at log f = pp_log_f.
    """

    size_px: tuple[int, int]
    pp_px: Array
    aspect: float = 1.0
    c0: float = 0.0
    c1: float = 0.0
    k2: float = 0.0
    pp_drift_px: Array = field(default_factory=lambda: np.zeros(2))
    pp_log_f: float = 0.0

    def __post_init__(self) -> None:
        _freeze(self, "pp_px", (2,))
        _freeze(self, "pp_drift_px", (2,))

    def k1_half(self, log_f: ArrayLike) -> Array:
        """Half-width coefficient (...,) at log focal (...,)."""
        return self.c0 + self.c1 * (np.asarray(log_f, float) - np.log(self.size_px[0]))

    def k1_opencv(self, log_f: ArrayLike) -> Array:
        """OpenCV's coefficient k1 (...,) at log focal (...,): what files and the public API carry."""
        return distortion.k1_to_opencv(self.k1_half(log_f), np.exp(log_f), self.size_px[0])

    def K(self, log_f: ArrayLike) -> Array:
        """Calibration matrices (..., 3, 3), px."""
        f = np.exp(np.asarray(log_f, float))
        K = np.zeros((*f.shape, 3, 3))
        K[..., 0, 0], K[..., 1, 1], K[..., 2, 2] = f, f / self.aspect, 1.0
        K[..., :2, 2] = self.pp(log_f)
        return K

    @property
    def is_wide(self) -> bool:
        """Whether it has more than a fixed principal point and one coefficient of distortion."""
        return self.k2 != 0 or bool(self.pp_drift_px.any())

    def pp(self, log_f: ArrayLike) -> Array:
        """Principal point px at log focal (...,): (..., 2); (2,) where it does not drift."""
        if not self.pp_drift_px.any():
            return self.pp_px
        since = np.asarray(log_f, float) - self.pp_log_f
        return np.asarray(self.pp_px + self.pp_drift_px * since[..., None])

    def shared(self, log_f_pp: float, *, wide: bool | None = None) -> Array:
        """The unknowns of `camera.SHARED`, (5,) or (8,) for the wider lens; the principal point at log f = log_f_pp."""
        usual = np.array([*self.pp(log_f_pp), np.log(self.aspect), self.c0, self.c1])
        return (
            np.array([*usual, self.k2, *self.pp_drift_px])
            if (self.is_wide if wide is None else wide)
            else usual
        )

    def distort(self, ideal_px: ArrayLike, log_f: ArrayLike) -> Array:
        """Ideal pixels (..., 2) to raw pixels; log_f broadcasts against the leading axes. NaN where the model folds."""
        return distortion.distort(ideal_px, self.pp(log_f), self.k1_half(log_f), self.size_px[0], self.k2)

    def undistort(self, raw_px: ArrayLike, log_f: ArrayLike) -> Array:
        """Raw pixels (..., 2) to ideal pixels. NaN outside the model's range."""
        return distortion.undistort(raw_px, self.pp(log_f), self.k1_half(log_f), self.size_px[0], self.k2)


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownFocal:
    """The user's knowledge: the focal of one frame, px of the decoded width, with its standard deviation."""

    frame: int
    f_px: float
    std_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StraightLine:
    """Points (m, 2), m >= 3, raw px, along something straight in the scene as one frame shows it, in any order.

    sigma_px: how far a point may lie off the line as seen, across it. weight: times which it counts against edges whose
    errors are shared and so do not average out (`straightness.fit_lines` finds it); error bars take it out again.
    Raises ValueError: shape, not finite, sigma or weight not positive.
    """

    frame: int
    points_px: Array
    sigma_px: float = 0.5
    weight: float = 1.0

    def __post_init__(self) -> None:
        _freeze(self, "points_px", (None, 2))
        if len(self.points_px) < 3 or not np.isfinite(self.points_px).all():
            raise ValueError("a straight line needs at least three finite points")
        if not (self.sigma_px > 0 and self.weight > 0):
            raise ValueError(f"sigma_px and weight must be positive, got {self.sigma_px} and {self.weight}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Gaussian knowledge before any picture. Lengths are fractions of the width W, so that they scale with the picture.

    pp_std_x, pp_std_y: 10 and 25 px at W = 1280 about pp (None: the centre). Vertically the principal point soaks up
    the parallax of a pupil in front of the pan axis: an effective one (measured on a soccer and a basketball clip).
    c0_std, c1_std: of k1_half(f) = c0 + c1 log(f / W). log_f_mean, log_f_std: of mean log(f / W); weak, it only keeps
    unobservable shots finite. aspect: fx / fy, fixed while aspect_std is 0. known_focals: from the user.
    straight_lines: seen ones, of which only that they are straight is known; those of other frames do not count.
    k2_mean, k2_std: of the second coefficient of distortion, fixed while its std is 0 (.02 suits a lens that may have
    one). pp_drift_std: of the principal point's drift, per unit of log f (none while 0; 10 / 1920 suits a zoom whose
    centre is seen to move). pp_std_x, pp_std_y then hold at the mean log f of the frames. Take them where the cost of
    the solution falls by more than some 20 times its edge_kappa. Of calib alone: camera.csv has neither.
    """

    pp: tuple[float, float] | None = None  # px
    pp_std_x: float = 10 / 1280
    pp_std_y: float = 25 / 1280
    c0_mean: float = 0.0
    c0_std: float = 0.05
    c1_mean: float = 0.0
    c1_std: float = 0.05
    log_f_mean: float = float(np.log(1.3))
    log_f_std: float = 0.7
    aspect: float = 1.0
    aspect_std: float = 0.0
    known_focals: tuple[KnownFocal, ...] = ()
    straight_lines: tuple[StraightLine, ...] = ()
    k2_mean: float = 0.0
    k2_std: float = 0.0
    pp_drift_std: float = 0.0

    @property
    def wide(self) -> bool:
        """Whether they ask for more of the lens than a fixed principal point and one coefficient of distortion."""
        return self.k2_mean != 0 or self.k2_std > 0 or self.pp_drift_std > 0

    def pp_mean_px(self, size_px: tuple[int, int]) -> Array:
        """Prior principal point (2,) px."""
        if self.pp is not None:
            return np.array(self.pp, float)
        return np.array([(size_px[0] - 1) / 2, (size_px[1] - 1) / 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class StartResult:
    """Where one start of the multistart ended: mean of log(f / W) and c0, robust cost, whether it converged."""

    name: str
    mean_log_f_over_w: float
    c0: float
    cost: float
    converged: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """A calibrated set of frames. NaN rows: frames that no accepted edge links to the reference.

    frames (n,); log_f (n,) of px; R (n, 3, 3) = R_cam_world, I at `reference`; lens. sigma_log_f (n,): absolute,
    statistical (cluster-robust); sigma_log_zoom (n,): of log f - log f(reference); cov_rot (n, 3, 3) rad^2 of the
    left increment.
    sigma_mean_log_f and its formal value without the edges' common errors; lens_std: by the names of
    `camera.SHARED`: pp_x, pp_y px, log_aspect, c0, c1, and of the wider lens k2, pp_drift_x, pp_drift_y px.
    chi2_dof: robust, against the stated information. s10_px: px that 10 % of focal move the best edge.
    Per edge: edge_chi2 (mean square whitened residual per degree of freedom), edge_kappa, edge_ok.
    rms_px (n,): of a frame's residuals. cost, n_steps, converged, stop; starts: what the multistart found;
    linear_valid: share of the edges with a valid linear focal at the chosen start (NaN after a warm start).
    """

    frames: IntArray
    log_f: Array
    R: Array
    lens: Lens
    reference: int
    sigma_log_f: Array
    sigma_log_zoom: Array
    cov_rot: Array
    sigma_mean_log_f: float
    sigma_mean_formal: float
    lens_std: Mapping[str, float]
    chi2_dof: float
    s10_px: float
    edge_chi2: Array
    edge_kappa: Array
    edge_ok: BoolArray
    rms_px: Array
    converged: bool
    stop: str
    n_steps: int
    cost: float
    starts: tuple[StartResult, ...] = ()
    linear_valid: float = float("nan")
    priors: Priors = field(default_factory=Priors)

    def __post_init__(self) -> None:
        n = len(np.asarray(self.frames))
        _freeze(self, "frames", (n,), int)
        for name in ("log_f", "sigma_log_f", "sigma_log_zoom", "rms_px"):
            _freeze(self, name, (n,))
        for name in ("R", "cov_rot"):
            _freeze(self, name, (n, 3, 3))
        for name in ("edge_chi2", "edge_kappa"):
            _freeze(self, name, (None,))
        _freeze(self, "edge_ok", (None,), bool)

    @property
    def f_px(self) -> Array:
        """Focal lengths (n,) px."""
        return np.exp(self.log_f)

    def index(self, frame: int) -> int:
        """Row of a frame number. Raises KeyError."""
        found = np.flatnonzero(self.frames == frame)
        if not len(found):
            raise KeyError(frame)
        return int(found[0])

    def with_reference(self, frame: int) -> Solution:
        """The same cameras with world axes = axes of `frame`; rotation covariances stay as they are (approximate)."""
        return replace(self, R=self.R @ self.R[self.index(frame)].T, reference=frame)

    def H_reference_frame(self) -> Array:
        """Homographies (n, 3, 3), det 1, from each frame's undistorted px into the reference frame's undistorted px."""
        from calib.camera import infinite_homography

        k = self.index(self.reference)
        K = self.lens.K(self.log_f)
        return infinite_homography(K[k], K, self.R[k] @ np.swapaxes(self.R, -1, -2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Whether a focal length may be published. reason is 'ok' or a code of gates.SENTENCES, with its sentence.

    sigma_log_f_total: relative standard deviation of the common focal, systematic part included; sigma_parts: its
    parts. support_rows: rows of the 5-row grid that carry texture. flags: what is worth a line but is no veto.
    """

    claims_focal: bool
    reason: str
    sentence: str
    sigma_log_f_total: float
    sigma_parts: Mapping[str, float]
    s10_px: float
    chi2_dof: float
    support_rows: int
    rotation_deg: float
    zoom_range: float
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Level:
    """Axis of the pan-tilt head: tilt0_rad of the reference frame, rho_rad the camera's constant roll on the head.

    NaN where not observable. R_head_world (3, 3): world axes (of the reference camera) into head axes (y = pan axis,
    downwards); R_cam_world R_head_world^T gives absolute tilt. residual_ratio: rms of left-over roll over its sigma.
    """

    tilt0_rad: float
    rho_rad: float
    tilt0_std_rad: float
    rho_std_rad: float
    observable: bool
    reason: str
    sentence: str
    R_head_world: Array
    residual_ratio: float

    def __post_init__(self) -> None:
        _freeze(self, "R_head_world", (3, 3))
