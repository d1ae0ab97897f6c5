"""Coarse starts for a lost pair: phase correlation, then features. They start the direct estimator, no more."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import normalise_homography
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray


def small_gray(pyramid: Pyramid, width_px: int = 640) -> NDArray[np.uint8]:
    """The finest level at most `width_px` wide as uint8: what a keyframe keeps for a rescue."""
    for level in pyramid.levels:
        if level.shape[1] <= width_px:
            return np.asarray(np.clip(level, 0, 255), np.uint8)
    level = pyramid.levels[-1]
    return np.asarray(np.clip(level, 0, 255), np.uint8)


def _level_to_full(size_px: tuple[int, int], small: NDArray[np.uint8]) -> FloatArray:
    sx, sy = size_px[0] / small.shape[1], size_px[1] / small.shape[0]
    return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])


def phase_correlation(
    src: NDArray[np.uint8], dst: NDArray[np.uint8], size_px: tuple[int, int]
) -> tuple[FloatArray, float]:
    """Translation between two small pictures of equal size as H_dst_src (full px) with the peak's response 0..1."""
    h, w = src.shape
    a = cv2.resize(src, (min(w, 256), min(h, 144)), interpolation=cv2.INTER_AREA).astype(np.float32)
    b = cv2.resize(dst, (a.shape[1], a.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    window = cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(a, b, window)
    H = np.eye(3)
    H[0, 2], H[1, 2] = dx * size_px[0] / a.shape[1], dy * size_px[1] / a.shape[0]
    return H, float(response)


def match_features(
    src: NDArray[np.uint8],
    dst: NDArray[np.uint8],
    size_px: tuple[int, int],
    *,
    min_matches: int = 24,
    n_features: int = 1500,
) -> FloatArray | None:
    """H_dst_src (full px, det 1) from SIFT and MAGSAC between two small pictures, or None when nothing convinces."""
    sift = cv2.SIFT.create(nfeatures=n_features)
    key_a, desc_a = sift.detectAndCompute(src, None)
    key_b, desc_b = sift.detectAndCompute(dst, None)
    if desc_a is None or desc_b is None or len(key_a) < min_matches or len(key_b) < min_matches:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(desc_a, desc_b, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(good) < min_matches:
        return None
    a = np.array([key_a[m.queryIdx].pt for m in good], np.float64)
    b = np.array([key_b[m.trainIdx].pt for m in good], np.float64)
    cv2.setRNGSeed(0)
    H, inliers = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 3.0, maxIters=3000, confidence=0.999)
    if H is None or int(inliers.sum()) < min_matches:
        return None
    S = _level_to_full(size_px, src)
    T = _level_to_full(size_px, dst)
    # MAGSAC's own answer rests on four points: least squares on its inliers is several times closer.
    chosen = inliers.ravel() > 0
    H, _ = cv2.findHomography(a[chosen], b[chosen], 0)
    if np.shape(H) != (3, 3):
        return None
    H_full = normalise_homography(T @ H @ np.linalg.inv(S))
    return H_full if np.all(np.isfinite(H_full)) else None
