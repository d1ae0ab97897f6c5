"""A homography that is bent between two motions: which of them does a camera make?

Hoardings run, and between neighbours their letters are a pixel from where the stand above has them: eight parameters
shear to suit both (measured: corners 3.5 px off, called ok with a score of .08; the truth has .06). No camera does
that, which `turning.contradiction` shows (305 and 358 there; 40 at most in 3,240 other pairs but one that was lost).
From there no other start leads on: the truth is a minimum of its own half a pixel wide, and only without the shear. So
the nearest turn of a camera is moved in steps of half a pixel over the finest pixels, and from where most of them agree
it settles first as a camera, then free.
"""

from __future__ import annotations

import numpy as np

from mosaic.estimator import RegisterOptions, align, costs_around, settle
from mosaic.minority import AGREE_GREY
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray, PairFit
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import PreparedTemplate, prepare

SWEPT_WIDTH = 960  # the finest level at most this wide is swept
STEP, REACH = 0.5, 4.0  # px of it
N_PIXELS = 2000
N_STARTS, APART = 4, 1.0  # minima, px of the level from one to the next


def other_motions(
    source: PreparedTemplate,
    target: Pyramid,
    turn: FloatArray,
    *,
    levels: tuple[int, ...],
    options: RegisterOptions,
) -> list[PairFit]:
    """Fits from the shifts of a camera's turn H_dst_src (3, 3) at which most pixels agree, the best shift first.

    levels: those that have pixels enough, the finest last.
    """
    level = next((i for i in levels[::-1] if target.levels[i].shape[1] <= SWEPT_WIDTH), levels[0])
    fine = tuple(i for i in levels if i <= level)
    stiff = prepare(source.template, StiffHomographyFamily(size_px=target.size_px))
    scale = target.scales[level]
    some = np.arange(-REACH, REACH + STEP / 2, STEP)
    shifts = np.stack(np.meshgrid(some, some), axis=-1).reshape(-1, 2)
    costs = costs_around(
        source, target, turn, shifts * scale, level=level, grey=AGREE_GREY, n_pixels=N_PIXELS, options=options
    )
    fits = []
    for _ in range(N_STARTS):
        best = int(np.argmin(costs))
        if not costs[best] < 1.0:
            break
        dx, dy = shifts[best] * scale
        state: FloatArray = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]]) @ turn
        steps = 0
        for bound, ladder in ((stiff, fine), (source, (0,))):
            state, more = settle(
                bound, target, state, levels=ladder, greys=(AGREE_GREY,) * len(ladder), options=options
            )
            steps += more
        fit, _ = align(source, target, state, dst=1, levels=(0,), options=options, route="other motion")
        fits.append(fit)
        costs[np.abs(shifts - shifts[best]).max(axis=1) <= APART] = np.inf
    return fits
