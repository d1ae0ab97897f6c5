"""Warp families: what the estimator may vary. It asks a family only for points, Jacobian and update.

The homography (8 parameters) lives here. Others (rotation + zoom through a lens) are handed in by the caller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

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
        from mosaic.kernel_numba import homography_warp

        return homography_warp(np.asarray(state, np.float64), *self._chart, prepared)

    def update(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """H <- C (I + M(step)) C^-1 H with C the chart of the increments."""
        cx, cy, s = self._chart
        C = np.array([[s, 0, cx], [0, s, cy], [0, 0, 1.0]])
        M = np.eye(3) + np.append(step, 0.0).reshape(3, 3)
        return normalise_homography(C @ M @ np.linalg.inv(C) @ state)
