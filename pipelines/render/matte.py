"""Who stands in front: where a frame differs from the clean plate by more than noise, light and registration explain.

Per pixel and colour the plate may be anything between the least and the largest value of its 3 x 3 neighbourhood, which
allows for a registration that is a pixel off and for a picture that is not as sharp; what is left counts in units of
the frame's own noise. Clear differences are kept with the weaker ones that hang together with them; specks go, holes
are closed. A player who stood still for most of the shot is part of the plate: he is then not seen in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.render.plate import Light

LEAST_NOISE = (
    3.0  # grey levels: what the encoders leave of a noiseless picture, their ringing beside edges included
)
N_NOISE = 20_000
# The noise is read off the quietest third of a picture, because players may cover more than half of it: 30 % of the
# values of a normal distribution are within .385 sigma.
QUIET, QUIET_SIGMAS = 0.3, 0.385
REFERENCE_WIDTH = 1280  # px; lengths and areas below are for this width


@dataclass(frozen=True, slots=True, kw_only=True)
class MatteOptions:
    """clear, weak: difference in sigmas that makes a core, and that belongs to one. least_px: area of the smallest
    thing, hole_px: of the largest hole that is closed, px at 1280. soft_px: width of the edge."""

    clear: float = 8.0
    weak: float = 4.5
    least_px: float = 40.0
    hole_px: float = 400.0
    soft_px: float = 0.7


def difference(
    frame: NDArray[np.uint8], plate: NDArray[np.uint8], known: NDArray[np.bool_], light: Light
) -> NDArray[np.float32]:
    """(h, w) how many sigmas of noise a frame (h, w, 3) is away from the plate in that light; 0 where it is not known.

    The noise is that of the picture handed in: that of its quietest third, at least 3 grey levels.
    """
    lit = light.applied(plate)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(lit, kernel), cv2.dilate(lit, kernel)
    image = frame.astype(np.float32)
    residual = np.abs(image - lit)
    stride = max(1, int(np.sqrt(known.size / N_NOISE)))
    sample = residual[::stride, ::stride][known[::stride, ::stride]]
    noise = np.full(3, LEAST_NOISE, np.float32)
    if len(sample):
        noise = np.maximum(np.quantile(sample, QUIET, axis=0) / QUIET_SIGMAS, noise).astype(np.float32)
    beyond = np.maximum(np.maximum(image - high, low - image), 0.0) / noise
    # Beside what was never seen the neighbourhood is half black: nothing can be said there.
    sure = cv2.erode(known.astype(np.uint8), kernel).astype(bool)
    return np.where(sure, beyond.max(axis=-1), 0.0).astype(np.float32)


def front_matte(sigmas: NDArray[np.float32], options: MatteOptions, frame_width: int) -> NDArray[np.float32]:
    """(h, w) 0 (background) to 1 (in front) from the differences of a picture, or of a part of one that is
    frame_width px wide in all."""
    scale = frame_width / REFERENCE_WIDTH
    candidate = (sigmas > options.weak).astype(np.uint8)
    core = sigmas > options.clear
    # A pixel's difference is noisy on cloth in the colour of the grass: neighbours within a limb's width count as one.
    reach = max(3, 2 * round(1.5 * scale) + 1)
    joined = cv2.morphologyEx(
        candidate, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    )
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    cores = np.bincount(labels[core], minlength=count)
    keep = (stats[:, cv2.CC_STAT_AREA] >= options.least_px * scale**2) & (
        cores >= 0.25 * options.least_px * scale**2
    )
    keep[0] = False
    front = keep[labels]
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~front).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= options.hole_px * scale**2
    small[0] = False
    front |= small[labels]
    return cv2.GaussianBlur(front.astype(np.float32), (0, 0), max(options.soft_px * scale, 0.3))
