"""A warp family with four freedoms more, held by a pull: what a camera model lacks may show itself, but has to pay.

Rotation and zoom leave four of a homography's eight parameters out. Set free, they run away where texture is scarce;
left out, what they would explain (a lens, a principal point, parallax) goes into the pose. Here each costs as much as
a measurement of `std_px` at the side of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mosaic.records import FloatArray
from mosaic.warp import WarpFamily

N_WEAK = 4


class PulledWarp(WarpFamily, Protocol):
    """A family that knows something of its own parameters before it sees a picture."""

    def pull(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """(P (p, p), g (p,)): information of the prior on the increments, and its gradient at a state; px^-2 scale."""
        ...


@dataclass(frozen=True, slots=True)
class PulledState:
    """State of the base family and the weak parameters (4,): aspect, skew, and two of perspective; no unit."""

    base: Any
    weak: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PulledFamily:
    """`base` followed by T(x) = C (I + M(weak)) C^-1 x: anisotropy, skew and keystone about the centre of the picture.

    C scales by half the width; M = [[a, s, 0], [s, -a, 0], [p, q, 0]]. std_px: how far the side of the picture moves at
    one standard deviation of each.
    """

    base: WarpFamily
    size_px: tuple[int, int]
    std_px: float = 0.5

    @property
    def n_parameters(self) -> int:
        """Those of the base, then four."""
        return self.base.n_parameters + N_WEAK

    def prepare(self, src_px: FloatArray) -> Any:
        """As the base does."""
        return self.base.prepare(src_px)

    def start(self, base_state: Any) -> PulledState:
        """A state of the base with the weak parameters at rest."""
        return PulledState(base_state, np.zeros(N_WEAK))

    def warp(self, state: PulledState, prepared: Any) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """See WarpFamily.warp: J (n, 2, p), the base's increments first."""
        where, J, A = self.base.warp(state.base, prepared)
        w, h = self.size_px
        half = w / 2.0
        centre = np.array([(w - 1) / 2.0, (h - 1) / 2.0])
        u, v = ((where - centre) / half).T
        a, s, p, q = state.weak
        depth = 1.0 + p * u + q * v
        x, y = ((1 + a) * u + s * v) / depth, (s * u + (1 - a) * v) / depth
        # d (x, y) / d (u, v), and d (x, y) / d weak.
        D = np.empty((len(u), 2, 2))
        D[:, 0, 0], D[:, 0, 1] = (1 + a - p * x) / depth, (s - q * x) / depth
        D[:, 1, 0], D[:, 1, 1] = (s - p * y) / depth, (1 - a - q * y) / depth
        weak = np.empty((len(u), 2, N_WEAK))
        weak[:, 0] = np.stack([u, v, -x * u, -x * v], axis=-1) / depth[:, None]
        weak[:, 1] = np.stack([-v, u, -y * u, -y * v], axis=-1) / depth[:, None]
        together = np.concatenate([D @ J.astype(np.float64), half * np.nan_to_num(weak)], axis=2)
        return (
            centre + half * np.stack([x, y], axis=-1),
            np.ascontiguousarray(np.nan_to_num(together), np.float32),
            np.where(np.isfinite(D), D, np.eye(2)) @ A,
        )

    def update(self, state: PulledState, step: FloatArray) -> PulledState:
        """The base by its share of the step, the weak parameters by the rest."""
        n = self.base.n_parameters
        return PulledState(self.base.update(state.base, step[:n]), state.weak + step[n:])

    def pull(self, state: PulledState) -> tuple[FloatArray, FloatArray]:
        """See PulledWarp.pull."""
        n = self.base.n_parameters
        information = (self.size_px[0] / 2.0 / self.std_px) ** 2
        P = np.zeros((n + N_WEAK, n + N_WEAK))
        P[n:, n:] = information * np.eye(N_WEAK)
        return P, np.concatenate([np.zeros(n), information * state.weak])
