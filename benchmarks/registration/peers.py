"""What a user could take instead: every method gets the same two pictures, the same masks and the same start, identity.

A method is a function (Pair) -> (H_b_a or None, accepted). accepted is the method's own word for "this is right": what
a careful user of it would check. Masks: those of graphics, where the method takes masks; `true masks` also get the
players' pixels, which nobody has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from benchmarks.registration.scenes import Pair
from mosaic.coords import normalise_homography
from mosaic.estimator import align
from mosaic.pair import register
from mosaic.pyramid import build_pyramid
from mosaic.records import PairStatus
from mosaic.template import PreparedTemplate, build_template, prepare
from mosaic.warp import HomographyFamily

Answer = tuple[np.ndarray | None, bool]
MIN_INLIERS, MIN_SHARE = 24, 0.25  # of a point method's matches, before its homography is believed
MIN_CORRELATION = 0.6


def ours(pair: Pair) -> Answer:
    """mosaic.register, all levels from identity, rescue when needed, checked the other way round."""
    fit = register(pair.a, pair.b, mask_a=pair.mask_a, mask_b=pair.mask_b)
    return (fit.H_dst_src if fit.usable else None), fit.status == PairStatus.OK


def keyframe_template(pair: Pair) -> PreparedTemplate:
    """What the video path has of the first picture: made once for a keyframe, not in the time of a pair."""
    template = build_template(build_pyramid(pair.a, mask=pair.mask_a), 0)
    return prepare(template, HomographyFamily(size_px=pair.a.shape[::-1]))


def video_path(pair: Pair, source: PreparedTemplate) -> Answer:
    """The second picture's pyramid, then two levels from a start that is 3 px off, as a prediction is."""
    target = build_pyramid(pair.b, mask=pair.mask_b)
    shift = np.array([[1.0, 0, 2.4], [0, 1.0, -1.8], [0, 0, 1.0]])
    fit, _ = align(source, target, shift @ pair.H_b_a, dst=1, levels=(1, 0))
    return (fit.H_dst_src if fit.usable else None), fit.status == PairStatus.OK


def _magsac(a: np.ndarray, b: np.ndarray, refit: bool) -> Answer:
    if len(a) < MIN_INLIERS:
        return None, False
    cv2.setRNGSeed(0)
    H, inliers = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 1.5, maxIters=3000, confidence=0.999)
    if H is None:
        return None, False
    chosen = inliers.ravel() > 0
    good = chosen.sum() >= max(MIN_INLIERS, MIN_SHARE * len(a))
    if refit and chosen.sum() >= 4:
        H, _ = cv2.findHomography(a[chosen], b[chosen], 0)
    return (None, False) if H is None else (normalise_homography(H), bool(good))


def _mask(usable: np.ndarray | None) -> np.ndarray | None:
    return None if usable is None else usable.astype(np.uint8) * 255


def _klt_points(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    corners = cv2.goodFeaturesToTrack(pair.a, 1500, 0.01, 8, mask=_mask(pair.mask_a))
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    moved, found, _ = cv2.calcOpticalFlowPyrLK(pair.a, pair.b, corners, None, winSize=(21, 21), maxLevel=4)  # type: ignore[call-overload]
    good = found.ravel() > 0
    return corners[good, 0].astype(np.float64), moved[good, 0].astype(np.float64)


def klt(pair: Pair) -> Answer:
    """1500 corners, pyramidal Lucas-Kanade, MAGSAC as returned."""
    return _magsac(*_klt_points(pair), refit=False)


def klt_refit(pair: Pair) -> Answer:
    """The same, then least squares on MAGSAC's inliers."""
    return _magsac(*_klt_points(pair), refit=True)


def sift(pair: Pair) -> Answer:
    """4000 SIFT features, ratio .8, MAGSAC, least squares on its inliers."""
    detector = cv2.SIFT.create(nfeatures=4000)
    key_a, words_a = detector.detectAndCompute(pair.a, _mask(pair.mask_a))
    key_b, words_b = detector.detectAndCompute(pair.b, _mask(pair.mask_b))
    if words_a is None or words_b is None or len(key_b) < 2:
        return None, False
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(words_a, words_b, k=2)
    good = [m[0] for m in matches if len(m) == 2 and m[0].distance < 0.8 * m[1].distance]
    a = np.array([key_a[m.queryIdx].pt for m in good], np.float64).reshape(-1, 2)
    b = np.array([key_b[m.trainIdx].pt for m in good], np.float64).reshape(-1, 2)
    return _magsac(a, b, refit=True)


def dis(pair: Pair) -> Answer:
    """DIS optical flow (medium) at every eighth pixel, MAGSAC, least squares on its inliers."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(pair.a, pair.b, None)  # type: ignore[call-overload]
    h, w = pair.a.shape
    x, y = np.meshgrid(np.arange(4, w, 8), np.arange(4, h, 8))
    a = np.stack([x, y], axis=-1).reshape(-1, 2)
    if pair.mask_a is not None:
        a = a[pair.mask_a[a[:, 1], a[:, 0]]]
    return _magsac(a.astype(np.float64), a + flow[a[:, 1], a[:, 0]].astype(np.float64), refit=True)


def ecc(pair: Pair) -> Answer:
    """cv2.findTransformECC at full size, 50 iterations; its mask is that of the second picture."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-5)
    try:
        score, H = cv2.findTransformECC(
            pair.a, pair.b, np.eye(3, dtype=np.float32), cv2.MOTION_HOMOGRAPHY, criteria,
            _mask(pair.mask_b), 5,
        )  # type: ignore[call-overload] # fmt: skip
    except cv2.error:  # it does not converge
        return None, False
    return normalise_homography(H), score > MIN_CORRELATION


def _multi_scale(pair: Pair, mask_a: Any, mask_b: Any) -> Answer:
    parameters = cv2.ECCParameters()  # type: ignore[attr-defined]
    parameters.motionType = cv2.MOTION_HOMOGRAPHY
    try:
        score, H = cv2.findTransformECCMultiScale(  # type: ignore[attr-defined]
            pair.a, pair.b, np.eye(3, dtype=np.float32), parameters, _mask(mask_a), _mask(mask_b)
        )
    except cv2.error:
        return None, False
    return normalise_homography(H), score > MIN_CORRELATION


def ecc_multi_scale(pair: Pair) -> Answer:
    """OpenCV 5's multi-scale ECC with its defaults, for homographies."""
    return _multi_scale(pair, pair.mask_a, pair.mask_b)


def ecc_true_masks(pair: Pair) -> Answer:
    """The same with the true masks of players and graphics in both pictures."""
    return _multi_scale(pair, pair.still_a, pair.still_b)


def kornia_registrator(pair: Pair) -> Answer:
    """kornia's ImageRegistrator at half size, 60 iterations a level; it has no verdict and takes no masks."""
    import torch
    from kornia.geometry import ImageRegistrator, denormalize_homography

    h, w = pair.a.shape
    size = (w // 2, h // 2)
    small = [
        torch.from_numpy(cv2.resize(p, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255)[
            None, None
        ]
        for p in (pair.a, pair.b)
    ]
    torch.manual_seed(0)
    model = ImageRegistrator("homography", num_iterations=60)
    found = model.register(small[0], small[1]).detach()
    H_a_b = denormalize_homography(found, size[::-1], size[::-1], align_corners=False)[0].double().numpy()
    S = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]])
    return normalise_homography(S @ np.linalg.inv(H_a_b) @ np.linalg.inv(S)), True


OURS = {"mosaic": ours}
FAST: dict[str, Callable[[Pair], Answer]] = {
    "KLT + MAGSAC": klt,
    "KLT + MAGSAC, refitted": klt_refit,
    "DIS + MAGSAC": dis,
}
SLOW: dict[str, Callable[[Pair], Answer]] = {
    "SIFT + MAGSAC": sift,
    "ECC multi-scale": ecc_multi_scale,
    "ECC multi-scale, true masks": ecc_true_masks,
}
SLOWEST: dict[str, Callable[[Pair], Answer]] = {"ECC": ecc, "kornia ImageRegistrator": kornia_registrator}
VIDEO = "mosaic, video path"
ALL = (*OURS, VIDEO, *FAST, *SLOW, *SLOWEST)
