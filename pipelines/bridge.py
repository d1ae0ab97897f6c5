"""Between images and calibration: the one place where mosaic's measurements and calib's cameras meet.

Makes the rotation + zoom + distortion warp family out of calib's camera (so that mosaic registers in four
parameters without knowing a focal length), edges out of pair fits, and placements out of solved cameras.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import rotation
from calib.distortion import fold_square
from calib.parallax import Parallax
from calib.records import HomographyEdge, HomographyGraph, Lens, Solution
from calib.rolling_shutter import frame_rates, row_delay
from mosaic.records import PairFit
from mosaic.template import PreparedTemplate

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPose:
    """One frame's camera in the shot world: log focal (px) and R_cam_world (3, 3)."""

    log_f: float
    R: FloatArray


@dataclass(frozen=True, slots=True)
class PairState:
    """State of the rotation + zoom family: the target's log focal and R_dst_src."""

    log_f: float
    R_dst_src: FloatArray


@nb.njit(cache=True, nogil=True)
def _source_rays(points, f, aspect, k, pp_x, pp_y, half_width):  # type: ignore[no-untyped-def]
    """Rays (n, 3) with z = 1 of raw points (n, 2), and d ray[:2] / d point (n, 2, 2); NaN outside the model.

    The compiled twin of calib.distortion.undistort (a test holds them together): eight calls of it a frame.
    """
    n = points.shape[0]
    rays = np.ones((n, 3))
    B = np.empty((n, 2, 2))
    for i in range(n):
        dx = points[i, 0] - pp_x
        dy = points[i, 1] - pp_y
        observed = np.sqrt(dx * dx + dy * dy) / half_width
        rho = observed
        for _ in range(8):
            slope = 1.0 + 3.0 * k * rho * rho
            rho -= (rho * (1.0 + k * rho * rho) - observed) / max(slope, 0.05)
        if 1.0 + 3.0 * k * rho * rho <= 0.0 or abs(rho * (1.0 + k * rho * rho) - observed) > 1e-9 * (
            1.0 + observed
        ):
            rho = np.nan
        ratio = rho / observed if observed > 1e-12 else 1.0
        ux = dx * ratio
        uy = dy * ratio
        rays[i, 0] = ux / f
        rays[i, 1] = uy * aspect / f
        g = 1.0 + k * rho * rho
        e = 2.0 * k / (half_width * half_width)
        d00 = g + e * ux * ux
        d01 = e * ux * uy
        d11 = g + e * uy * uy
        det = d00 * d11 - d01 * d01
        B[i, 0, 0] = d11 / det / f
        B[i, 0, 1] = -d01 / det / f
        B[i, 1, 0] = -d01 / det * aspect / f
        B[i, 1, 1] = d00 / det * aspect / f
    return rays, B


@nb.njit(cache=True, nogil=True)
def _projected(axes, fx, fy, k1, k2, pp_x, pp_y, half_width, fold2):  # type: ignore[no-untyped-def]
    """Camera axes (n, 3) to raw px (n, 2); NaN behind the camera and where the model folds, from fold2 on.

    The compiled twin of calib.distortion.distort (a test holds them together): the compositor asks for every tile.
    """
    out = np.empty((len(axes), 2))
    for i in range(len(axes)):
        depth = axes[i, 2]
        x, y = np.nan, np.nan
        if depth > 1e-6:
            x, y = fx * axes[i, 0] / depth, fy * axes[i, 1] / depth
        r2 = (x * x + y * y) / (half_width * half_width)
        bend = 1.0 + r2 * (k1 + k2 * r2) if r2 < fold2 else np.nan
        out[i, 0], out[i, 1] = pp_x + x * bend, pp_y + y * bend
    return out


@nb.njit(cache=True, nogil=True)
def _turned(R, turn):  # type: ignore[no-untyped-def]
    """Exp(turn) R made orthonormal again (two Newton steps; real-footage.md 7.3)."""
    angle2 = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
    angle = np.sqrt(angle2)
    sine = 1.0 - angle2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    cosine = 0.5 - angle2 / 24.0 if angle < 1e-4 else 2.0 * np.sin(angle / 2.0) ** 2 / angle2
    W = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    out = (np.eye(3) + sine * W + cosine * (W @ W)) @ R
    for _ in range(2):
        out = 1.5 * out - 0.5 * out @ (out.T @ out)
    return out


@nb.njit(cache=True, nogil=True)
def _rotation_zoom_warp(
    rays: Any,
    B: Any,
    R: Any,
    f: float,
    aspect: float,
    k: float,
    dk: float,
    pp_x: float,
    pp_y: float,
    half_width: float,
) -> Any:
    """Rays (n, 3) of the source to raw target px; J (n, 2, 4) of (d log f, left rotation); A (n, 2, 2).

    B (n, 2, 2) = d ray[:2] / d raw source px. calibration.md 6.3 with the source camera held.
    """
    n = rays.shape[0]
    dst = np.empty((n, 2))
    J = np.zeros((n, 2, 4), np.float32)
    A = np.empty((n, 2, 2))
    fy = f / aspect
    s2 = half_width * half_width
    for i in range(n):
        m0 = rays[i, 0]
        m1 = rays[i, 1]
        m2 = rays[i, 2]
        w0 = R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2
        w1 = R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2
        w2 = R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2
        A[i, 0, 0] = 1.0
        A[i, 0, 1] = 0.0
        A[i, 1, 0] = 0.0
        A[i, 1, 1] = 1.0
        if not w2 > 1e-6:
            dst[i, 0] = np.nan
            dst[i, 1] = np.nan
            continue
        q0 = w0 / w2
        q1 = w1 / w2
        dx = f * q0
        dy = fy * q1
        rho2 = (dx * dx + dy * dy) / s2
        if 1.0 + 3.0 * k * rho2 <= 0.05:
            dst[i, 0] = np.nan
            dst[i, 1] = np.nan
            continue
        g = 1.0 + k * rho2
        dst[i, 0] = pp_x + dx * g
        dst[i, 1] = pp_y + dy * g
        e = 2.0 * k / s2
        D00 = g + e * dx * dx
        D01 = e * dx * dy
        D11 = g + e * dy * dy
        J[i, 0, 0] = D00 * dx + D01 * dy + dx * rho2 * dk
        J[i, 1, 0] = D01 * dx + D11 * dy + dy * rho2 * dk
        # G = D diag(f, fy) d q / d w
        a0 = f / w2
        a1 = fy / w2
        g00 = D00 * a0
        g01 = D01 * a1
        g02 = -(D00 * a0 * q0 + D01 * a1 * q1)
        g10 = D01 * a0
        g11 = D11 * a1
        g12 = -(D01 * a0 * q0 + D11 * a1 * q1)
        # d w = delta x w
        J[i, 0, 1] = -g01 * w2 + g02 * w1
        J[i, 0, 2] = g00 * w2 - g02 * w0
        J[i, 0, 3] = -g00 * w1 + g01 * w0
        J[i, 1, 1] = -g11 * w2 + g12 * w1
        J[i, 1, 2] = g10 * w2 - g12 * w0
        J[i, 1, 3] = -g10 * w1 + g11 * w0
        h00 = g00 * R[0, 0] + g01 * R[1, 0] + g02 * R[2, 0]
        h01 = g00 * R[0, 1] + g01 * R[1, 1] + g02 * R[2, 1]
        h10 = g10 * R[0, 0] + g11 * R[1, 0] + g12 * R[2, 0]
        h11 = g10 * R[0, 1] + g11 * R[1, 1] + g12 * R[2, 1]
        A[i, 0, 0] = h00 * B[i, 0, 0] + h01 * B[i, 1, 0]
        A[i, 0, 1] = h00 * B[i, 0, 1] + h01 * B[i, 1, 1]
        A[i, 1, 0] = h10 * B[i, 0, 0] + h11 * B[i, 1, 0]
        A[i, 1, 1] = h10 * B[i, 0, 1] + h11 * B[i, 1, 1]
    return dst, J, A


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationZoomFamily:
    """Rotation + zoom from one source camera through a known lens: 4 parameters (a `mosaic.warp.WarpFamily`).

    The source's focal is held; the state carries the target's focal and R_dst_src. With a wrong focal it is still a
    good alignment over small angles; the residual-flow grid measures what it cannot express.
    """

    lens: Lens
    log_f_src: float
    n_parameters: int = 4

    def prepare(self, src_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rays (n, 3) with z = 1 of raw source pixels, and d ray[:2] / d raw px (n, 2, 2)."""
        lens = self.lens
        return _source_rays(
            np.ascontiguousarray(src_px, np.float64),
            float(np.exp(self.log_f_src)),
            float(lens.aspect),
            float(lens.k1_half(self.log_f_src)),
            float(lens.pp_px[0]),
            float(lens.pp_px[1]),
            lens.size_px[0] / 2.0,
        )

    def warp(self, state: PairState, prepared: Any) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """See mosaic.warp.WarpFamily.warp."""
        lens = self.lens
        rays, B = prepared
        return _rotation_zoom_warp(
            rays,
            B,
            np.ascontiguousarray(state.R_dst_src),
            float(np.exp(state.log_f)),
            float(lens.aspect),
            float(lens.k1_half(state.log_f)),
            float(lens.c1),
            float(lens.pp_px[0]),
            float(lens.pp_px[1]),
            lens.size_px[0] / 2.0,
        )

    def update(self, state: PairState, step: FloatArray) -> PairState:
        """Left increment of the rotation, re-orthonormalised (real-footage.md 7.3); clamped to a sane step."""
        return PairState(
            state.log_f + float(min(max(step[0], -0.3), 0.3)),
            _turned(np.ascontiguousarray(state.R_dst_src), np.ascontiguousarray(step[1:])),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RollingFamily:
    """Rotation + zoom of two cameras that turn while their rows are read, one after the other.

    A pair registered through a warp without that keeps a part of it as its own (real-footage.md 6.3: measurements are
    pulled to the model). share: of a frame's time, from the first row to the last; rate_src, rate_dst (4,): change of
    log f and left rotation increment a frame. States are the cameras of the middle rows. First order in the rates.
    """

    base: RotationZoomFamily
    share: float
    rate_src: FloatArray
    rate_dst: FloatArray
    n_parameters: int = 4

    def prepare(self, src_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """RotationZoomFamily.prepare of where the points would be if all rows were read with the middle one."""
        itself = PairState(self.base.log_f_src, np.eye(3))
        _, J, _ = self.base.warp(itself, self.base.prepare(src_px))
        return self.base.prepare(src_px - self._moved(src_px, J, self.rate_src))

    def warp(self, state: PairState, prepared: Any) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """See mosaic.warp.WarpFamily.warp."""
        dst, J, A = self.base.warp(state, prepared)
        return dst + self._moved(dst, J, self.rate_dst), J, A

    def update(self, state: PairState, step: FloatArray) -> PairState:
        """See RotationZoomFamily.update."""
        return self.base.update(state, step)

    def _moved(self, at_px: FloatArray, J: NDArray[np.float32], rate: FloatArray) -> FloatArray:
        late = self.share * row_delay(at_px[:, 1:], self.base.lens.size_px[1])
        return np.asarray((J @ rate) * late, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rolling:
    """A shot's rolling shutter as registration wants it: share of a frame's time, and rates (4,) by frame number."""

    share: float
    rates: Mapping[int, FloatArray]

    def seen(self, source: PreparedTemplate, dst: int) -> PreparedTemplate:
        """A template bound to `family` as it is registered to frame dst."""
        family = source.family
        if not isinstance(family, RollingFamily) or dst not in self.rates:
            return source
        return replace(source, family=replace(family, rate_dst=self.rates[dst]))

    def family(self, base: RotationZoomFamily, src: int) -> RotationZoomFamily | RollingFamily:
        """The family of pairs from frame src; a frame without known motion is taken to stand still."""
        rate = self.rates.get(src, np.zeros(4))
        return RollingFamily(base=base, share=self.share, rate_src=rate, rate_dst=np.zeros(4))


def rolling_of(share: float | None, track: Solution) -> Rolling | None:
    """For registration, from the cameras of all frames; None for a shot without a rolling shutter (share None)."""
    if share is None:
        return None
    rates = frame_rates(track)
    known = np.isfinite(rates).all(axis=1)
    return Rolling(share=share, rates=dict(zip(track.frames[known].tolist(), rates[known], strict=True)))


def pair_state(src: CameraPose, dst: CameraPose) -> PairState:
    """The family's state between two cameras of one world."""
    return PairState(dst.log_f, rotation.orthonormalise(dst.R @ src.R.T))


def pose_from_state(src: CameraPose, state: PairState) -> CameraPose:
    """The target's camera in the source's world."""
    return CameraPose(log_f=state.log_f, R=rotation.orthonormalise(state.R_dst_src @ src.R))


def edge_from_fit(fit: PairFit) -> HomographyEdge:
    """calib's edge from a usable pair fit; a weak fit carries four times the variance."""
    return HomographyEdge(
        a=fit.src,
        b=fit.dst,
        H=fit.H_dst_src,
        grid_a=fit.flow.src_px,
        grid_b=fit.flow.dst_px,
        info=fit.flow.info,
        kappa=1.0 if fit.status == "ok" else 4.0,
    )


def homography_graph(frames: ArrayLike, fits: Iterable[PairFit], size_px: tuple[int, int]) -> HomographyGraph:
    """calib's graph of the usable pair fits between the given frames."""
    known = set(np.asarray(frames).tolist())
    edges = tuple(edge_from_fit(f) for f in fits if f.usable and f.src in known and f.dst in known)
    return HomographyGraph(frames=np.asarray(frames, np.int64), edges=edges, size_px=size_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPlacement:
    """A solved camera as the compositor sees it: rays of the shot world to raw pixels and back (mosaic's Placement).

    parallax, in the axes of the rays: of a pupil in front of the pan axis. Rays are those of the pan axis then.
    share, rate (4,): of a rolling shutter, time from the first row to the last over that between frames, and change of
    log f and left rotation vector a frame; pose is the middle row's camera.
    """

    frame: int
    size_px: tuple[int, int]
    lens: Lens
    pose: CameraPose
    blur_px: float = 0.0
    parallax: Parallax | None = None
    share: float = 0.0
    rate: FloatArray | None = None

    @property
    def px_per_rad(self) -> float:
        """Pixels per radian at the centre of the frame."""
        return float(np.exp(self.pose.log_f))

    def ray_to_pixel(self, rays: ArrayLike) -> FloatArray:
        """World rays (..., 3) to raw px (..., 2); NaN behind the camera or outside the distortion model."""
        directions = np.asarray(rays, np.float64)
        if self.parallax is not None:
            directions = self.parallax.from_pupil(directions, self.pose.R[2])
        axes = directions @ self.pose.R.T
        at = self._project(axes, np.exp(self.pose.log_f))
        if self.rate is None:
            return at
        # Where a point moves to within half the read-out, taken for a straight line: then which row meets it is known.
        span = self.share / 2
        later = axes @ rotation.exp(self.rate[1:] * span).T
        velocity = (self._project(later, np.exp(self.pose.log_f + self.rate[0] * span)) - at) / span
        late = self._late(at[..., 1]) / (1 - self.share * velocity[..., 1] / self.size_px[1])
        return np.asarray(at + velocity * late[..., None])

    def pixel_to_ray(self, xy: ArrayLike) -> FloatArray:
        """Raw px (..., 2) to unit world rays (..., 3)."""
        f = np.exp(self.pose.log_f)
        d = (self.lens.undistort(xy, self.pose.log_f) - self.lens.pp_px) / np.array([f, f / self.lens.aspect])
        ray = np.concatenate([d, np.ones((*d.shape[:-1], 1))], axis=-1)
        if self.rate is not None:
            late = self._late(np.asarray(xy, np.float64)[..., 1])
            ray[..., :2] *= np.exp(-self.rate[0] * late)[..., None]
            ray = rotation.turned(ray, -self.rate[1:] * late[..., None])
        directions = (ray / np.linalg.norm(ray, axis=-1, keepdims=True)) @ self.pose.R
        return directions if self.parallax is None else self.parallax.from_axis(directions, self.pose.R[2])

    def _project(self, axes: FloatArray, f: float) -> FloatArray:
        """Camera axes (..., 3) at focal f to raw px."""
        lens = self.lens
        k1 = float(lens.k1_half(self.pose.log_f))
        raw = _projected(
            np.ascontiguousarray(axes.reshape(-1, 3)), float(f), float(f / lens.aspect), k1, float(lens.k2),
            float(lens.pp_px[0]), float(lens.pp_px[1]), lens.size_px[0] / 2.0, float(fold_square(k1, lens.k2)),
        )  # fmt: skip
        return np.asarray(raw.reshape(*axes.shape[:-1], 2))

    def _late(self, y_px: FloatArray) -> FloatArray:
        """By how much of a frame's time (...) the row at y_px was read after the middle one; half a picture beyond the
        first and last row at most."""
        where = row_delay(np.nan_to_num(y_px), self.size_px[1])
        return np.asarray(self.share * np.clip(where, -1.0, 1.0))
