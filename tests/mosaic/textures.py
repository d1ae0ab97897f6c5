"""Irregular smooth textures that can be looked at from anywhere: pairs of pictures whose homography is known exactly.

Sampled with cubic splines (scipy, float64): cv2.remap and cv2.warpPerspective round coordinates to 1/32 px, which is
what is being measured here.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from mosaic.coords import transfer

SIZE = (480, 270)  # w, h of the pictures
BORDER = 260  # px of texture around them


@cache
def _texture(seed: int, finest_px: float, contrast: float) -> np.ndarray:
    """Spline coefficients of a texture of blobs from `finest_px` up, mean 120, deviation `contrast` grey levels."""
    w, h = SIZE[0] + 2 * BORDER, SIZE[1] + 2 * BORDER
    rng = np.random.default_rng(seed)
    total = np.zeros((h, w))
    for sigma in finest_px * np.array([1.0, 3.0, 10.0]):
        layer = gaussian_filter(rng.normal(size=(h, w)), sigma, mode="wrap")
        total += layer / layer.std()
    return spline_filter(120.0 + contrast * total / total.std(), order=3)


def look(seed: int, xy: np.ndarray, *, finest_px: float = 1.5, contrast: float = 40.0) -> np.ndarray:
    """The texture at points xy (..., 2) of the first picture's frame, float64 grey; clamped outside."""
    rows, columns = xy[..., 1] + BORDER, xy[..., 0] + BORDER
    return map_coordinates(
        _texture(seed, finest_px, contrast), [rows, columns], order=3, mode="nearest", prefilter=False
    )


def grid(size_px: tuple[int, int] = SIZE) -> np.ndarray:
    """Pixel centres (h, w, 2)."""
    return np.stack(np.meshgrid(*(np.arange(float(n)) for n in size_px)), axis=-1)


def picture(seed: int, H_b_a=None, *, size_px=SIZE, **texture) -> np.ndarray:
    """What a camera displaced by H_b_a sees of the texture, float64 (h, w); without H the first picture itself."""
    xy = grid(size_px)
    return look(seed, xy if H_b_a is None else transfer(np.linalg.inv(H_b_a), xy), **texture)


def as_uint8(gray: np.ndarray, *, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Quantised, with normal noise of that many grey levels."""
    noisy = gray + np.random.default_rng(seed).normal(0, noise, gray.shape) if noise else gray
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def homography(dx=0.0, dy=0.0, zoom=1.0, roll_deg=0.0, px=0.0, py=0.0, size_px=SIZE) -> np.ndarray:
    """About the centre of the picture: zoom, roll, perspective px, py (per half width), then the translation in px."""
    w, h = size_px
    C = np.array([[w / 2, 0, (w - 1) / 2], [0, w / 2, (h - 1) / 2], [0, 0, 1.0]])
    angle = np.deg2rad(roll_deg)
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    M = np.array([[c, -s, 2 * dx / w], [s, c, 2 * dy / w], [px, py, 1.0]])
    H = C @ M @ np.linalg.inv(C)
    return H / np.cbrt(np.linalg.det(H))


def corner_error_px(H: np.ndarray, truth: np.ndarray, size_px=SIZE) -> float:
    """Largest distance between the four transferred corners."""
    w, h = size_px
    corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1.0]])
    return float(np.linalg.norm(transfer(H, corners) - transfer(truth, corners), axis=1).max())


def blocks(gray: np.ndarray, share: float, seed: int) -> np.ndarray:
    """A copy with noisy rectangles over about `share` of it: things that have nothing to do with the camera."""
    out, rng = gray.copy(), np.random.default_rng(seed)
    h, w = gray.shape
    covered = np.zeros((h, w), bool)
    while covered.mean() < share:
        x, y = int(rng.integers(0, w - 20)), int(rng.integers(0, h - 40))
        patch = cv2.resize(rng.uniform(0, 255, (8, 4)), (20, 40), interpolation=cv2.INTER_CUBIC)
        out[y : y + 40, x : x + 20] = patch[: h - y, : w - x]
        covered[y : y + 40, x : x + 20] = True
    return out
