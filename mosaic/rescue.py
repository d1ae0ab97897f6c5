"""Coarse starts for a lost pair: phase correlation, then features. They start the direct estimator, no more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import level_matrix, level_scale, normalise_homography, transfer
from mosaic.photometric import TUKEY
from mosaic.pyramid import Pyramid
from mosaic.records import FloatArray
from mosaic.solve import newton_step
from mosaic.stiff import StiffHomographyFamily

# Of a feature, SIFT's measure: its usual one, for grass, and for what 40 % players leave of grass.
CONTRAST, WEAK_CONTRAST, FAINT_CONTRAST = 0.04, 0.01, 0.003
WEAK_PX = 1.0  # of a match that agrees: scrolling hoardings move by 2 px a frame against the scene
LARGEST = 6.0  # zoom 1.6 is 2.6
REACH_PX = 4.0  # of a similarity, which is not quite what a turn does
AGREE_PX = 2.0  # of a match that supports a homography
TAKEN = 4  # times WEAK_PX: what so agrees is no evidence for another motion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureStart:
    """A start H_dst_src (3, 3) and the matches that agree with it to within_px: src_px, dst_px (n, 2) px."""

    H_dst_src: FloatArray
    src_px: FloatArray
    dst_px: FloatArray
    within_px: float

    def support(self, H_dst_src: FloatArray) -> int:
        """How many of the matches agree with another homography."""
        away = np.linalg.norm(transfer(H_dst_src, self.src_px) - self.dst_px, axis=1)
        return int(np.sum(away < self.within_px))


def small_gray(pyramid: Pyramid, width_px: int = 640) -> NDArray[np.uint8]:
    """The finest level at most `width_px` wide as uint8: what a keyframe keeps for a rescue."""
    for level in pyramid.levels:
        if level.shape[1] <= width_px:
            return np.asarray(np.clip(level, 0, 255), np.uint8)
    level = pyramid.levels[-1]
    return np.asarray(np.clip(level, 0, 255), np.uint8)


def _level_to_full(size_px: tuple[int, int], small: NDArray[np.uint8]) -> FloatArray:
    return level_matrix(level_scale(size_px, (small.shape[1], small.shape[0])))


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
    found = _matches(src, dst, n_features, CONTRAST, min_matches)
    if found is None:
        return None
    H = _homography(*found, 3.0, min_matches)
    if H is None:
        return None
    S, T = _level_to_full(size_px, src), _level_to_full(size_px, dst)
    H_full = normalise_homography(T @ H @ np.linalg.inv(S))
    return H_full if np.all(np.isfinite(H_full)) else None


def weak_feature_starts(
    src: NDArray[np.uint8],
    dst: NDArray[np.uint8],
    src_size_px: tuple[int, int],
    dst_size_px: tuple[int, int],
    *,
    min_matches: int = 12,
    n_features: int = 6000,
    n_starts: int = 4,
    contrast: float = WEAK_CONTRAST,
) -> Iterator[FeatureStart]:
    """Camera-like homographies H_dst_src (full px, det 1) from weak features too, each from the matches that are left.

    Strong features are of players, hoardings and lines; grass has weak ones. Whoever has most of either comes first,
    the scene perhaps second.
    """
    found = _matches(src, dst, n_features, contrast, min_matches)
    if found is None:
        return
    a, b = found
    S, T = _level_to_full(src_size_px, src), _level_to_full(dst_size_px, dst)
    for _ in range(n_starts):
        H = None if len(a) < min_matches else _camera_like(a, b, (src.shape[1], src.shape[0]))
        if H is None:
            return
        away = np.linalg.norm(transfer(H, a) - b, axis=1)
        agree = away < AGREE_PX
        if agree.sum() < min_matches:
            return
        start = normalise_homography(T @ H @ np.linalg.inv(S))
        if _keeps_area(start, src_size_px):
            yield FeatureStart(
                H_dst_src=start,
                src_px=transfer(S, a[agree]),
                dst_px=transfer(T, b[agree]),
                within_px=AGREE_PX * float(T[0, 0]),
            )
        left = ~(away < TAKEN * WEAK_PX)
        a, b = a[left], b[left]


def _camera_like(a: FloatArray, b: FloatArray, size_px: tuple[int, int]) -> FloatArray | None:
    """The homography H_b_a that most matches agree with, pulled to what cameras do (stiff.py); None: no consensus.

    A free one, of matches on a tenth of the picture, is 20 px off at its corners (measured: 40 % players, 87 of 222
    matches right). Consensus as a similarity, which two matches make; then all matches, weighted ever more strictly.
    """
    cv2.setRNGSeed(0)
    M, _ = cv2.estimateAffinePartial2D(
        a, b, method=cv2.RANSAC, ransacReprojThreshold=REACH_PX, maxIters=5000, confidence=0.999
    )
    if M is None or not np.isfinite(M).all():
        return None
    family = StiffHomographyFamily(size_px=size_px)
    H = normalise_homography(np.vstack([M, [0, 0, 1.0]]))
    for px in (REACH_PX, REACH_PX / 2, WEAK_PX, WEAK_PX, WEAK_PX, WEAK_PX):
        where, J, _ = family.warp(H, a)
        r = b - where
        u2 = np.sum(r**2, axis=1) / (TUKEY * px) ** 2
        weight = np.where(u2 < 1.0, (1.0 - np.minimum(u2, 1.0)) ** 2, 0.0) / px**2
        P, g = family.pull(H)
        N = np.einsum("n,nik,nil->kl", weight, J, J, dtype=np.float64) + P
        step = newton_step(N, np.einsum("n,nik,ni->k", weight, J, r, dtype=np.float64) - g, 0.0)
        if step is None:
            return None
        H = family.update(H, step)
        if not np.isfinite(H).all():
            return None
    return H


def _keeps_area(H: FloatArray, size_px: tuple[int, int]) -> bool:
    """False for what no zoom does, but a dozen chance matches do: areas LARGEST times larger or smaller anywhere."""
    w, h = size_px
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h], [w / 2, h / 2]])
    depth = corners @ H[2, :2] + H[2, 2]
    # The area's scale under a homography of det 1.
    return bool((depth > 0).all() and (depth**3 < LARGEST).all() and (depth**-3 < LARGEST).all())


def _matches(
    src: NDArray[np.uint8], dst: NDArray[np.uint8], n_features: int, contrast: float, least: int
) -> tuple[FloatArray, FloatArray] | None:
    """Points (n, 2) of src and dst whose SIFT descriptors match clearly best; None: fewer than least."""
    sift = cv2.SIFT.create(nfeatures=n_features, contrastThreshold=contrast)
    key_a, desc_a = sift.detectAndCompute(src, None)
    key_b, desc_b = sift.detectAndCompute(dst, None)
    if desc_a is None or desc_b is None or len(key_a) < least or len(key_b) < least:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(desc_a, desc_b, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(good) < least:
        return None
    a = np.array([key_a[m.queryIdx].pt for m in good], np.float64)
    b = np.array([key_b[m.trainIdx].pt for m in good], np.float64)
    return a, b


def _homography(a: FloatArray, b: FloatArray, px: float, least: int) -> FloatArray | None:
    """MAGSAC's homography if it has at least so many inliers."""
    cv2.setRNGSeed(0)
    H, inliers = cv2.findHomography(a, b, cv2.USAC_MAGSAC, px, maxIters=3000, confidence=0.999)
    if H is None or int(inliers.sum()) < least:
        return None
    # MAGSAC's own answer rests on four points: least squares on its inliers is several times closer.
    chosen = inliers.ravel() > 0
    H, _ = cv2.findHomography(a[chosen], b[chosen], 0)
    return np.asarray(H, np.float64) if np.shape(H) == (3, 3) else None
