"""One pyramid level of a pair: a template's pixels in the target at a state of the warp, linearised. No decisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaic import kernels
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray
from mosaic.template import PreparedTemplate, TemplateLevel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegisterOptions:
    """How a pair is aligned and judged.

    max_steps: Gauss-Newton steps per level from the finest on. stop_sigmas: a level ends when a step is below this
    share of its own standard deviation (the next one would be far smaller); stop_sigmas_coarse: of coarse levels, which
    only hand on. polish_steps: more on the finest level, where the scale is larger than that of the pixels that agree.
    min_overlap, min_inliers: shares of informative pixels. score_ok, score_weak: largest residual scale
    against that of shifted pictures. evidence, evidence_scored: what a minority of the pixels must show of
    verdict.regional_evidence to be weak and not failed, where the score refuses it and where it lies between the two.
    cell_floor_px: error of a cell's place that is not noise (crowd, codec;
    real-footage.md 6.3). cell_max_px: directions less certain are dropped. cell_linear_px: residual flow beyond which
    it is no measurement, found in flow_passes local steps. correlation: variance inflation of a cell, whose residuals
    are correlated between pixels. noise_ratio: how much more noise the 3x3 blur leaves than the pictures have,
    where they were smoothed more: what no residual shows is stated by the noise (verdict.py). kernel: see kernels.py.
    """

    max_steps: tuple[int, ...] = (4, 5, 6, 8, 10, 10)
    stop_sigmas: float = 0.3
    stop_sigmas_coarse: float = 1.0
    polish_steps: int = 4
    min_pixels: int = 60
    min_overlap: float = 0.2
    min_inliers: float = 0.25
    score_ok: float = 0.6
    score_weak: float = 0.8
    evidence: float = 5.5
    evidence_scored: float = 4.0
    cell_floor_px: float = 0.1
    cell_max_px: float = 1.0
    cell_linear_px: float = 4.0
    flow_passes: int = 4
    correlation: float = 4.0
    noise_ratio: float = 1.0
    kernel: kernels.KernelName = "numba"


def rough(options: RegisterOptions) -> RegisterOptions:
    """The same for a fit whose last tenth of a standard deviation and whose flow grid nobody looks at."""
    return replace(options, stop_sigmas=max(options.stop_sigmas, 0.3), flow_passes=1)


@dataclass(slots=True, eq=False)
class Linearised:
    """A level at a state: dst (n, 2) px, J (n, 2, p), A (n, 2, 2), residual (n,) grey, G (n, 2) grey per px.

    scale: robust deviation of the residuals, NaN without any; n_valid of them are finite. sigma: deviation of those
    that agree, smaller where many do not; the scale itself until it is asked for.
    """

    dst: FloatArray
    J: NDArray[np.float32]
    A: FloatArray
    residual: NDArray[np.float32]
    G: NDArray[np.float32]
    scale: float
    n_valid: int
    sigma: float


@dataclass(slots=True, eq=False)
class LevelPair:
    """A template's level and the target's, with gain, offset and masks as the kernel takes them.

    pull: what the family knows of its parameters (pulled.py).
    """

    source: PreparedTemplate
    target: Pyramid
    index: int
    gain: float
    offset: float
    masks: tuple[Any, ...]
    kernel: Any
    pull: Callable[[Any], tuple[FloatArray, FloatArray]] | None = None

    @property
    def pixels(self) -> TemplateLevel:
        """The template's pixels on this level; the caller chose one that was built."""
        level = self.source.template.levels[self.index]
        assert level is not None
        return level

    @property
    def picture(self) -> tuple[Any, float, float]:
        """The target's level and its scales, the first arguments of every kernel function."""
        return self.target.levels[self.index], *self.target.scales[self.index]

    def evaluate(self, state: Any) -> Linearised:
        """Residuals and gradients at a state."""
        level = self.pixels
        where, J, A = self.source.family.warp(state, self.source.prepared[self.index])
        residual, G = self.kernel.linearise(
            *self.picture, where, A, level.values, level.gradients, self.gain, self.offset, *self.masks
        )
        scale, n_valid = self.kernel.robust_scale(residual)
        return Linearised(
            dst=where, J=J, A=A, residual=residual, G=G, scale=scale, n_valid=n_valid, sigma=scale
        )
