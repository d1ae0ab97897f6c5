"""What an unknown camera that turns and zooms says of a homography: a pull where the pixels leave it open.

For square pixels and a principal point in the middle, M diag(a, a, 1) M^T is diagonal with two equal elements, M the
homography in half widths about the middles and a the first picture's focal length squared: four equations in the one
unknown a, so three constraints whatever the camera. Which focal length it is stays open. Coded pictures show eight
parameters loosely (an encoder copies weak texture from elsewhere): of pairs at CRF 35 started from the truth one in
eight ended 2 px off, most of it against these constraints.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mosaic.coords import transfer
from mosaic.records import FloatArray, PairFit
from mosaic.warp import HomographyFamily

# Standard deviations of the constraints at the side of the picture. A lens of 3 % and a principal point 1 % of the
# width off bend the nearest homography of a pair by .1 to .3 px of 1280 for each tenth of the width that it shifts;
# by far most of the lens acts like another focal length, along the shift (LENS).
STD_PX, STD_SHARE, LENS = 0.3, 0.002, 0.03
OPEN = 1.0  # 1 / a, half widths^-2: any lens below 90 degrees
# 95 % of chi-square of the four. What is less likely than that was made by another camera: it is believed so much less.
LIKELY = 9.5
# 99.95 % of the same: below it what an encoder or a smear displaces may have made it.
IMPOSSIBLE = 20.0
NEAREST_PX = 10.0  # of an anchor, where only the constraints count
PASSES = 4
STEP = 1e-6  # of the differences that make the slope


def held(fit: PairFit, src_size_px: tuple[int, int], dst_size_px: tuple[int, int]) -> PairFit:
    """The fit with what a turning, zooming camera says of its homography and information, less where none explains it.

    The fit itself where it has no homography or its pixels do not determine one.
    """
    if not _determined(fit):
        return fit
    pulled = _pulled(fit.H_dst_src, fit.anchors_px, fit.info, src_size_px, dst_size_px, None)
    if pulled is None:
        return fit
    H, known = pulled
    return replace(fit, H_dst_src=H, info=fit.info + (known + known.T) / 2)


def contradiction(fit: PairFit, src_size_px: tuple[int, int], dst_size_px: tuple[int, int]) -> float:
    """Chi-square of the four constraints, by the fit's own information and what they leave open; 0: undetermined."""
    if not _determined(fit):
        return 0.0
    charts = np.linalg.inv(_chart(dst_size_px)), _chart(src_size_px)
    at = _linearised(fit.H_dst_src, fit.anchors_px, charts, HomographyFamily(size_px=dst_size_px))
    if at is None:
        return 0.0
    here, covariance, slope, J8, _ = at
    pixels = slope @ np.linalg.solve(J8.T @ fit.info @ J8, slope.T)
    return float(here @ np.linalg.solve(covariance + pixels, here))


def nearest_turn(
    fit: PairFit, src_size_px: tuple[int, int], dst_size_px: tuple[int, int]
) -> FloatArray | None:
    """The homography H_dst_src of a turning camera next to the fit's, all over the picture alike; None: undefined."""
    info = np.eye(8) / NEAREST_PX**2
    pulled = _pulled(fit.H_dst_src, fit.anchors_px, info, src_size_px, dst_size_px, 1.0)
    return None if pulled is None else pulled[0]


def _determined(fit: PairFit) -> bool:
    return bool(fit.usable and np.linalg.cond(fit.info) < 1e12)


def _pulled(
    H: FloatArray,
    anchors: FloatArray,
    info: FloatArray,
    src_size_px: tuple[int, int],
    dst_size_px: tuple[int, int],
    share: float | None,
) -> tuple[FloatArray, FloatArray] | None:
    """H with what cameras do against that information of its anchors, and what that knows of them (8, 8).

    share: how much the cameras are believed; None: as the homography lets them be."""
    family = HomographyFamily(size_px=dst_size_px)
    charts = np.linalg.inv(_chart(dst_size_px)), _chart(src_size_px)
    wanted = transfer(H, anchors)
    known = np.zeros((8, 8))
    for _ in range(PASSES):
        at = _linearised(H, anchors, charts, family)
        if at is None:
            return None
        here, covariance, slope, J8, where = at
        N = J8.T @ info @ J8
        if share is None:
            share = _believed(here, covariance, slope @ np.linalg.solve(N, slope.T))
        weighted = share * np.linalg.solve(covariance, np.column_stack([slope, here]))
        P, g = slope.T @ weighted[:, :8], slope.T @ weighted[:, 8]
        step = np.linalg.solve(N + P, J8.T @ info @ (wanted - where).ravel() - g)
        back = np.linalg.inv(J8)
        known = back.T @ P @ back
        H = family.update(H, np.asarray(step, np.float64))
    return (H, known) if np.isfinite(H).all() else None


def _linearised(
    H: FloatArray, anchors: FloatArray, charts: tuple[Any, Any], family: HomographyFamily
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """At H: the constraints (4,), their covariance (4, 4), their slope (4, 8) by the family's increments, and the
    anchors' (8, 8), with where they land (4, 2); None where that is undefined."""
    here, covariance = _constraints(charts[0] @ H @ charts[1])
    slope = np.empty((4, 8))
    for k in range(8):
        increment = np.zeros(8)
        increment[k] = STEP
        moved = family.update(H, increment)
        slope[:, k] = (_constraints(charts[0] @ moved @ charts[1])[0] - here) / STEP
    where, J, _ = family.warp(H, family.prepare(anchors))
    J8 = J.reshape(8, 8).astype(np.float64)
    if not np.isfinite(where).all() or not np.linalg.cond(J8) < 1e9:
        return None
    return here, covariance, slope, J8, where


def _believed(away: FloatArray, prior: FloatArray, pixels: FloatArray) -> float:
    """The largest share of the prior's information (4, 4 covariances) with which `away` is still LIKELY."""

    def unlikely(share: float) -> bool:
        return float(away @ np.linalg.solve(prior / share + pixels, away)) > LIKELY

    if not unlikely(1.0):
        return 1.0
    low, high = 1e-12, 1.0
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if unlikely(middle) else (middle, high)
    return low


def _chart(size_px: tuple[int, int]) -> FloatArray:
    """Half widths about the middle to px (3, 3)."""
    w, h = size_px
    return np.array([[w / 2.0, 0, (w - 1) / 2.0], [0, w / 2.0, (h - 1) / 2.0], [0, 0, 1.0]])


def _constraints(M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far M (3, 3; half widths) is from what cameras do at 1 / a = 0, and the covariance (4, 4) of that.

    Anisotropy, skew and two of perspective, each what a point at the side moves by, in half widths.
    """
    M = M / M[2, 2]
    A, t, v = M[:2, :2], M[:2, 2], M[2, :2]
    zoom2 = abs(float(np.linalg.det(A)))
    AA, tt = A @ A.T / zoom2, np.outer(t, t) / zoom2

    def four(S: FloatArray, p: FloatArray) -> FloatArray:
        return np.array([(S[0, 0] - S[1, 1]) / 4, S[0, 1] / 2, p[0], p[1]])

    zoom = np.sqrt(zoom2)
    by_focal = four(tt, t / zoom)
    by_lens = four(np.zeros((2, 2)), t / zoom)
    own = (STD_PX / 640.0) ** 2 + (STD_SHARE**2) * float(t @ t)
    covariance = (
        own * np.eye(4) + OPEN**2 * np.outer(by_focal, by_focal) + LENS**2 * np.outer(by_lens, by_lens)
    )
    return four(AA, A @ v / zoom), covariance
