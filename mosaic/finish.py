"""The last steps of a pair: on the finest level alone, both pictures smoothed more, and alike in the scene.

Pictures hold detail beyond half a cycle a pixel, which looks like other detail wherever it lies otherwise on the grid,
and interpolation is poor just below: where neighbours lie alike on the grid all over the picture that is their largest
error, three times what noise leaves. Smoothing takes it away, if it is equally wide in the scene: with equal widths in
px a zoom of 1.2 between the pictures costs .02 to .1 px, since few edges are symmetric. And gain and offset are better
found here: the coarsest levels, which are not smoothed alike either, have them wrong by up to .8 %.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from mosaic.coords import transfer
from mosaic.estimator import align
from mosaic.level import RegisterOptions, rough
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray, PairFit
from mosaic.template import SelectionOptions, build_template, prepare
from mosaic.warp import HomographyFamily

# Point spread that both pictures get, standard deviation in px; the second where neighbours lie alike on the grid. That
# is where the displacement varies by less than ALIKE_PX over the picture, standard deviation in x or in y, and in
# pictures of that width; small ones have not enough texture left (180 pairs at 360p to 1080p: docs/registration.md).
SPREAD_PX, ALIKE_SPREAD_PX = 1.4, 2.0
ALIKE_PX, ALIKE_WIDTH_PX = 1.0, 960
# Variance of the 3x3 blur that they come with, and what it leaves of white noise (a Gaussian 1 / (2 sqrt(pi) spread)).
OWN_PX2, OWN_NOISE = 0.5, 0.375
LEAST_PX2 = 0.1  # of what is added to it, where the zoom is large
# Mean blockiness from which on the stated error stays: what an encoder displaces is no smaller for being smoothed, but
# was stated by the residuals, which are. Pictures at 8 Mbit/s have .007 and more, uncoded ones .000 to .001 (1080p).
CODED = 0.005


def finished(
    fit: PairFit, source: Pyramid, target: Pyramid, selection: SelectionOptions, estimator: RegisterOptions
) -> PairFit:
    """The fit with homography, gain and information of pictures that are smoothed more; its verdict stays.

    source, target: smoothed as `build_pyramid` does. The fit itself where the smoothed pictures do not hold it.
    """
    spread = _spread_px(fit, source.size_px[0])
    zoom = _zoom(fit.H_dst_src, fit.flow.src_px.mean(axis=0))
    a, b = (_smoothed(p, spread**2 * share) for p, share in ((source, 1 / zoom), (target, zoom)))
    prepared = prepare(build_template(a, 0, options=selection), HomographyFamily(size_px=target.size_px))
    estimator = replace(rough(estimator), noise_ratio=OWN_NOISE * 2 * np.sqrt(np.pi) * spread)
    again, _ = align(prepared, b, fit.H_dst_src, dst=1, options=estimator)
    if not again.usable:
        return fit
    info = fit.info if (source.blocks + target.blocks) / 2 > CODED else again.info
    return replace(
        fit, H_dst_src=again.H_dst_src, info=info, gain=again.gain, offset=again.offset,
        n_steps=fit.n_steps + again.n_steps,
    )  # fmt: skip


def _spread_px(fit: PairFit, width_px: int) -> float:
    """Point spread for a pair: wider where the fraction of a pixel by which it is displaced hardly varies."""
    moved = transfer(fit.H_dst_src, fit.flow.src_px) - fit.flow.src_px
    alike = width_px >= ALIKE_WIDTH_PX and float(moved.std(axis=0).min()) < ALIKE_PX
    return ALIKE_SPREAD_PX if alike else SPREAD_PX


def _zoom(H: FloatArray, point: FloatArray) -> float:
    """How much larger things are in the second picture than in the first, about a point of the first; det H = 1."""
    return float(abs(H[2] @ (*point, 1.0)) ** -1.5)


def _smoothed(pyramid: Pyramid, variance_px2: float) -> Pyramid:
    """The finest level alone, with that point spread; floats, for its noise is finer than grey levels."""
    sigma = float(np.sqrt(max(variance_px2 - OWN_PX2, LEAST_PX2)))
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma)) + 1, sigma, cv2.CV_32F)
    finest: Any = pyramid.levels[0]
    smooth: Any = cv2.sepFilter2D(finest, cv2.CV_32F, kernel, kernel)
    return replace(pyramid, levels=(smooth,), scales=pyramid.scales[:1])
