"""Warp families: what the estimator may vary. It asks a family only for points, Jacobian and update.

The homography (8 parameters) lives here. Others (rotation + zoom through a lens) are handed in by the caller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import normalise_homography
from mosaic.records import FloatArray


class WarpFamily(Protocol):
    """A family of maps src -> dst in raw full-size pixels, with a state that the estimator only passes on."""

    @property
    def n_parameters(self) -> int:
        """Number of increments p."""
        ...

    def prepare(self, src_px: FloatArray) -> Any:
        """What can be computed once for fixed source points (n, 2)."""
        ...

    def warp(self, state: Any, prepared: Any) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """dst (n, 2) px, NaN where undefined; J (n, 2, p) of the increment; A (n, 2, 2) = d dst / d src."""
        ...

    def update(self, state: Any, step: FloatArray) -> Any:
        """The state moved by an increment (p,)."""
        ...


class ProjectiveFamily(WarpFamily, Protocol):
    """A family of homographies: what it aligned is the pair's homography, with the information of the pixels."""

    def homography(self, state: Any) -> FloatArray:
        """H_dst_src (3, 3) of a state, raw px, det 1."""
        ...


@dataclass(frozen=True, slots=True)
class HomographyFamily:
    """The full 8-parameter homography; the state is H_dst_src (3, 3), det 1. size_px scales the increments."""

    size_px: tuple[int, int]
    n_parameters: int = 8

    @property
    def _chart(self) -> tuple[float, float, float]:
        w, h = self.size_px
        return (w - 1) / 2.0, (h - 1) / 2.0, w / 2.0

    def prepare(self, src_px: FloatArray) -> FloatArray:
        """Source points as they are."""
        return np.ascontiguousarray(src_px, np.float64)

    def warp(
        self, state: FloatArray, prepared: FloatArray
    ) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """See WarpFamily.warp."""
        return _homography_warp(np.asarray(state, np.float64), *self._chart, prepared)

    def update(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """H <- C (I + M(step)) C^-1 H with C the chart of the increments."""
        return _homography_update(np.asarray(state, np.float64), *self._chart, np.asarray(step, np.float64))

    def homography(self, state: FloatArray) -> FloatArray:
        """The state itself."""
        return normalise_homography(state)


def nearest_state(family: WarpFamily, state: Any, prepared: Any, wanted_px: FloatArray) -> Any:
    """The state of a family, from one nearby, that moves prepared points nearest to where they are wanted (n, 2)."""
    for _ in range(4):
        now, J, _ = family.warp(state, prepared)
        away = wanted_px - now
        good = np.isfinite(away).all(axis=1)
        if good.sum() < 8:
            return state
        J_good = J[good].reshape(-1, J.shape[2]).astype(np.float64)
        step = np.linalg.lstsq(J_good, away[good].ravel(), rcond=None)[0]
        state = family.update(state, np.asarray(step, np.float64))
    return state


@nb.njit(cache=True, nogil=True)
def _homography_warp(H, centre_x, centre_y, scale, src):  # type: ignore[no-untyped-def]
    """Points of src (n, 2) through H with Jacobian (n, 2, 8) of a left increment and A = d dst / d src.

    The increment acts in coordinates u = (x - centre) / scale: I + [[d0, d1, d2], [d3, d4, d5], [d6, d7, 0]].
    """
    n = src.shape[0]
    dst = np.empty((n, 2))
    J = np.empty((n, 2, 8), np.float32)
    A = np.empty((n, 2, 2))
    for i in range(n):
        x = src[i, 0]
        y = src[i, 1]
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        if w <= 1e-12:
            dst[i, 0] = np.nan
            dst[i, 1] = np.nan
            for k in range(8):
                J[i, 0, k] = 0.0
                J[i, 1, k] = 0.0
            A[i, 0, 0] = 1.0
            A[i, 0, 1] = 0.0
            A[i, 1, 0] = 0.0
            A[i, 1, 1] = 1.0
            continue
        px = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
        py = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
        dst[i, 0] = px
        dst[i, 1] = py
        A[i, 0, 0] = (H[0, 0] - px * H[2, 0]) / w
        A[i, 0, 1] = (H[0, 1] - px * H[2, 1]) / w
        A[i, 1, 0] = (H[1, 0] - py * H[2, 0]) / w
        A[i, 1, 1] = (H[1, 1] - py * H[2, 1]) / w
        u = (px - centre_x) / scale
        v = (py - centre_y) / scale
        J[i, 0, 0] = scale * u
        J[i, 0, 1] = scale * v
        J[i, 0, 2] = scale
        J[i, 0, 3] = 0.0
        J[i, 0, 4] = 0.0
        J[i, 0, 5] = 0.0
        J[i, 0, 6] = -scale * u * u
        J[i, 0, 7] = -scale * u * v
        J[i, 1, 0] = 0.0
        J[i, 1, 1] = 0.0
        J[i, 1, 2] = 0.0
        J[i, 1, 3] = scale * u
        J[i, 1, 4] = scale * v
        J[i, 1, 5] = scale
        J[i, 1, 6] = -scale * u * v
        J[i, 1, 7] = -scale * v * v
    return dst, J, A


@nb.njit(cache=True, nogil=True)
def _homography_update(H, centre_x, centre_y, scale, step):  # type: ignore[no-untyped-def]
    """C (I + M(step)) C^-1 H of det 1, C the chart of the increments; NaN where it is singular."""
    C = np.array([[scale, 0.0, centre_x], [0.0, scale, centre_y], [0.0, 0.0, 1.0]])
    back = np.array(
        [[1.0 / scale, 0.0, -centre_x / scale], [0.0, 1.0 / scale, -centre_y / scale], [0.0, 0.0, 1.0]]
    )
    M = np.eye(3)
    for k in range(8):
        M[k // 3, k % 3] += step[k]
    moved = C @ (M @ (back @ H))
    det = (
        moved[0, 0] * (moved[1, 1] * moved[2, 2] - moved[1, 2] * moved[2, 1])
        - moved[0, 1] * (moved[1, 0] * moved[2, 2] - moved[1, 2] * moved[2, 0])
        + moved[0, 2] * (moved[1, 0] * moved[2, 1] - moved[1, 1] * moved[2, 0])
    )
    if not abs(det) > 1e-300:
        return np.full((3, 3), np.nan)
    return moved / (np.sign(det) * abs(det) ** (1.0 / 3.0))
