"""A homography that is pulled to what a camera that turns and zooms can do, before its focal length is known.

Between neighbours four of the eight parameters are small whatever the camera: aspect, skew, and the perspective beyond
the one that a turn by the measured shift brings. Set free they follow players where the ground has little texture
(measured on generator clips with 40 % players: rms errors of 2 to 6 px a frame). So each costs as much as a
measurement at the side of the picture; what the unknown focal length leaves open of the turn's perspective is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic.records import FloatArray
from mosaic.warp import HomographyFamily

# Focal length over half the width, of broadcast cameras 2 to 10. A turn that shifts the picture by t has the
# perspective t / FOCAL^2 and an anisotropy of t^2 / 4 FOCAL^2; OPEN times these is one standard deviation.
FOCAL = 4.0
OPEN_TURN, OPEN_ANISOTROPY = 2.0, 4.0
STD_PX = 0.3  # of the side of a picture 1280 wide
STEP = 1e-6  # of the differences that make the pull's slope


@dataclass(frozen=True, slots=True)
class StiffHomographyFamily:
    """HomographyFamily with a pull (see pulled.PulledWarp); the state is H_dst_src (3, 3), det 1."""

    size_px: tuple[int, int]
    n_parameters: int = 8

    @property
    def _free(self) -> HomographyFamily:
        return HomographyFamily(size_px=self.size_px)

    def prepare(self, src_px: FloatArray) -> FloatArray:
        """Source points as they are."""
        return self._free.prepare(src_px)

    def warp(
        self, state: FloatArray, prepared: FloatArray
    ) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """See WarpFamily.warp."""
        return self._free.warp(state, prepared)

    def update(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """As HomographyFamily."""
        return self._free.update(state, step)

    def homography(self, state: FloatArray) -> FloatArray:
        """The state itself."""
        return self._free.homography(state)

    def pull(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """See PulledWarp.pull."""
        here, std = self._weak(state)
        slope = np.empty((4, 8))
        for k in range(8):
            step = np.zeros(8)
            step[k] = STEP
            slope[:, k] = (self._weak(self.update(state, step))[0] - here) / STEP
        weighted = slope / std[:, None] ** 2
        return weighted.T @ slope, weighted.T @ here

    def _weak(self, H: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(aspect, skew, two of perspective) of H and their standard deviations (4,), in half widths at the side."""
        w, h = self.size_px
        C = np.array([[w / 2.0, 0, (w - 1) / 2.0], [0, w / 2.0, (h - 1) / 2.0], [0, 0, 1.0]])
        M = np.linalg.inv(C) @ H @ C
        M = M / M[2, 2]
        zoom = np.sqrt(abs(M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]))
        shift = M[:2, 2]
        turn = shift / FOCAL**2
        anisotropy = (M[0, 0] - M[1, 1]) / (2 * zoom)
        skew = (M[0, 1] + M[1, 0]) / (2 * zoom)
        weak = np.array([anisotropy, skew, M[2, 0] + turn[0], M[2, 1] + turn[1]])
        bent = OPEN_ANISOTROPY * float(shift @ shift) / (4 * FOCAL**2)
        return weak, np.hypot(STD_PX / 640.0, [bent, bent, OPEN_TURN * turn[0], OPEN_TURN * turn[1]])
