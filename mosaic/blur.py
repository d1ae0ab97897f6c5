"""Two pictures of unequal sharpness made equal: how much wider one's point spread is than the other's, and the remedy.

A fast pan smears its frames, and not all alike. What the smear leaves as residual is no noise that averages out: it is
tied to the texture and pulls the alignment. Estimated at a quarter of the size, where even 12 px of smear is a small
change that second derivatives explain, and again at half of it where that is too small to be sure of; mended by a smear
of the missing covariance on whichever picture is sharper along each direction.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import level_matrix, transfer
from mosaic.photometric import TUKEY
from mosaic.pyramid import Pyramid, build_pyramid
from mosaic.records import FloatArray

COARSE, FINE = 2, 1  # levels: the first look's, and that of smears too small for it
_LEAST_CURVATURE = 2.0  # grey per px^2 of the level: flatter ground says nothing of sharpness
_LEAST_PIXELS = 500
# Along an axis less is taken for none. It is found to about 2 px^2 (measured on pairs with smears of 4 and 12 px and
# without); 12 px against 4 are 9. On the finer level to .7, where 6 px against 2 are 2.
LEAST_PX2 = {COARSE: 3.5, FINE: 1.0}
# A smear has a direction, noise and focus have none. Eigenvalues on the coarse level are so far apart in all of nine
# pairs with 6 px against 2 and in 1 of 30 without a smear: worth the finer look, which takes four times as long.
DIRECTED_PX2 = 1.2


def spread_difference(
    a: Pyramid,
    b: Pyramid,
    H_b_a: FloatArray,
    gain: float,
    offset: float,
    *,
    level: int = COARSE,
    most_px: int | None = None,
) -> FloatArray | None:
    """Covariance (2, 2) px^2 of b's point spread less that of a, in a's axes; None where too little shows it.

    H_b_a aligns them to a pixel or two of the level, a ~ gain b + offset. A picture is its twin blurred by S: b = a +
    tr(S Hessian) / 2, to third order when the Hessian is that of the mean of both. level: of the pyramids; it is found
    to about 2 px^2 at level 2 and, where it is that small, to a quarter of that on each finer one. most_px: side of
    the part that is looked at, px of the level, in the middle of what both see; None: all.
    """
    index = min(level, len(a.levels) - 1, len(b.levels) - 1)
    ax, ay = a.scales[index]
    up, down = level_matrix(a.scales[index]), np.linalg.inv(level_matrix(b.scales[index]))
    first: Any = np.asarray(a.levels[index], np.float32)
    second: Any = np.asarray(b.levels[index], np.float32) * np.float32(gain) + np.float32(offset)
    H = down @ H_b_a @ up
    usable: Any = a.mask
    if usable is not None:
        usable = cv2.resize(usable, first.shape[::-1], interpolation=cv2.INTER_NEAREST)
    if most_px is not None:
        x, y = _middle_of_both(first.shape, second.shape, H, most_px)
        box = np.s_[y : y + most_px, x : x + most_px]
        first, usable = first[box], None if usable is None else usable[box]
        H = H @ np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])
    h, w = first.shape
    # Linear sampling would itself blur, by 2.7 px^2 of the full size.
    flags = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(
        second, H, (w, h), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e4
    )
    mean = cv2.GaussianBlur(0.5 * (first + warped), (5, 5), 1.0)
    xx, yy, xy = (cv2.Sobel(mean, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    # Sobel's own weights: 4 for second derivatives of size 3, and 4 for the mixed one.
    rows = np.stack([xx / 4, xy / 2, yy / 4], axis=-1) / 2
    good = cv2.erode((warped > -1e3).astype(np.uint8), np.ones((7, 7), np.uint8), borderValue=0) > 0
    if usable is not None:
        good &= usable > 0
    good &= np.linalg.norm(rows, axis=-1) > _LEAST_CURVATURE / 2
    if good.sum() < _LEAST_PIXELS:
        return None
    # The same low-pass as the Hessian has: after the warp, where a zoom does not make it two different ones.
    residual = cv2.GaussianBlur(warped - first, (5, 5), 1.0)[good].astype(np.float64)
    M = rows[good].astype(np.float64)
    s = np.zeros(3)
    for _ in range(6):
        r = residual - M @ s
        scale = max(1.4826 * float(np.median(np.abs(r))), 0.5)
        weight = np.maximum(1 - (r / (TUKEY * scale)) ** 2, 0.0) ** 2
        N = (M * weight[:, None]).T @ M
        if not np.linalg.cond(N) < 1e8:
            return None
        s = np.linalg.solve(N, M.T @ (weight * residual))
    return np.array([[s[0] * ax * ax, s[1] * ax * ay], [s[1] * ax * ay, s[2] * ay * ay]])


def _middle_of_both(
    shape: tuple[int, int], other: tuple[int, int], H_other: FloatArray, side: int
) -> tuple[int, int]:
    """Corner x, y of a square about the middle of what a picture (h, w) and another one see, inside the first."""
    (h, w), (other_h, other_w) = shape, other
    own, its = np.array([w - 1.0, h - 1.0]) / 2, np.array([other_w - 1.0, other_h - 1.0]) / 2
    x, y = ((own + transfer(np.linalg.inv(H_other), its)) / 2 - side / 2).round().astype(int)
    return int(np.clip(x, 0, max(w - side, 0))), int(np.clip(y, 0, max(h - side, 0)))


def equally_sharp(
    a: Pyramid, b: Pyramid, H_b_a: FloatArray, gain: float, offset: float
) -> tuple[Pyramid, Pyramid] | None:
    """Both pyramids with equal point spread, as `spread_difference` finds it; None where it differs too little to care.

    A smear of a few px hides in what the coarse level's estimate scatters by; where there is a direction to it, the
    finer level is looked at (measured at 720p, 6 px against 2: .13 px left as they were, .04 made equal).
    """
    difference = spread_difference(a, b, H_b_a, gain, offset)
    if difference is None:
        return None
    equal = matched(a, b, difference, H_b_a)
    if equal is not None or not np.ptp(np.linalg.eigvalsh(difference)) > DIRECTED_PX2:
        return equal
    difference = spread_difference(a, b, H_b_a, gain, offset, level=FINE)
    return None if difference is None else matched(a, b, difference, H_b_a, LEAST_PX2[FINE])


def matched(
    a: Pyramid, b: Pyramid, difference: FloatArray, H_b_a: FloatArray, least_px2: float = LEAST_PX2[COARSE]
) -> tuple[Pyramid, Pyramid] | None:
    """Both pyramids with equal point spread, from `spread_difference`; None where they differ too little to care."""
    values, vectors = np.linalg.eigh(difference)
    values = np.where(np.abs(values) < least_px2, 0.0, values)
    if not values.any():
        return None
    parts = [(vectors * np.maximum(sign * values, 0.0)) @ vectors.T for sign in (1, -1)]
    # b's share is seen through the map at the centre of the picture.
    centre = np.array([(a.size_px[0] - 1) / 2, (a.size_px[1] - 1) / 2, 1.0])
    p = H_b_a @ centre
    A = (H_b_a[:2, :2] - np.outer(p[:2] / p[2], H_b_a[2, :2])) / p[2]
    return _blurred(a, parts[0]), _blurred(b, A @ parts[1] @ A.T)


def _blurred(pyramid: Pyramid, covariance: FloatArray) -> Pyramid:
    if np.linalg.eigvalsh(covariance).max() < 1e-3:
        return pyramid
    first: Any = pyramid.levels[0]
    picture: Any = cv2.filter2D(first, -1, _smear(covariance))
    blurred = build_pyramid(picture, n_levels=len(pyramid.levels), smooth=False)
    return replace(pyramid, levels=blurred.levels, scales=blurred.scales)


def _smear(covariance: FloatArray) -> NDArray[np.float32]:
    """Point spread (n, n) of straight motions along the axes of a covariance (2, 2) px^2, singular ones included.

    By its transform: a motion over length l is sinc(l f) with variance l^2 / 12. A Gaussian of that variance lacks the
    sign changes of a smear's spectrum, and what they turn round in the other picture is left over.
    """
    values, vectors = np.linalg.eigh(covariance)
    lengths = np.sqrt(12.0 * np.maximum(values, 0.0))
    n = 2 * int(np.ceil(lengths.max() / 2)) + 9
    f = np.fft.fftfreq(n)
    fx, fy = np.meshgrid(f, f)
    spectrum = np.ones((n, n))
    for length, (x, y) in zip(lengths, vectors.T, strict=True):
        spectrum *= np.sinc(length * (x * fx + y * fy))
    kernel = np.fft.fftshift(np.fft.ifft2(spectrum).real)
    return (kernel / kernel.sum()).astype(np.float32)
