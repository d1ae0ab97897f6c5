"""The scene between people (and hoardings) who hold most of the picture: found pair by pair, and kept as a mask.

Neighbours of a clip are aligned to what most of the strong pixels say. Where that is players, the scene is looked for
as a minority (minority.py: seconds, where an alignment takes milliseconds), and what does not go with it is masked in
both pictures. A mask that is carried on to the next frame keeps the ordinary alignment on the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.coords import level_matrix, transfer
from mosaic.estimator import align
from mosaic.minority import best_minority
from mosaic.pair import PairOptions
from mosaic.pyramid import Pyramid, with_scene
from mosaic.records import FloatArray, PairFit
from mosaic.rescue import small_gray, weak_feature_starts
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily

# px; the finest level at most this wide is compared: a player's step of a pixel still shows on it.
LEVEL_WIDTH = 960
FEATURES_PX = 1280  # width of the pictures in which weak features are looked for
# Between people there is grass: with gradients of 3 grey levels and more 11 of 13 pairs of a clip whose players fill
# half to two thirds of the picture come within .9 px of the truth, 9 of them within .4; with 6 and more 5 and 3.
WEAK_GREY = 3.0
ROUNDS, SETTLED_PX = 4, 0.05  # of masking and aligning again, until it moves by less
# A pixel differs by more than what noise (grey levels) and a third of a pixel of misplaced texture explain.
NOISE_GREY, MISPLACED = 5.0, 0.3
TOLD_GREY = 12.0  # of range within 3 x 3 px, from which a pixel can tell
WINDOW_PX = 15  # px of that level over which votes are counted
LEAST_VOTES = 4.0  # pixels that differ within a window: fewer are the codec's
# Share of the pixels that can tell from which a window moves: by itself, and where the frame before was masked there.
MOVES, STILL_MOVES = 0.35, 0.12
FILLED_PX = 16  # half the width of a hole, px of that level, that is taken to be a part of who is round about
WIDER_PX = 5  # px of that level by which what moves is made wider


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenePair:
    """Of two pictures the parts that show one scene: (h, w) uint8 at the size of `Pyramid.mask`, 1 = scene."""

    source: NDArray[np.uint8]
    target: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneFound:
    """fit: the pair of two pictures of one scene (src 0, dst 1); scene: where they show it."""

    fit: PairFit
    scene: ScenePair

    @property
    def share(self) -> float:
        """Of the target that goes with the pair."""
        return float(self.scene.target.mean())


def find_scene(
    source: Pyramid, target: Pyramid, before: FloatArray | None, options: PairOptions | None = None
) -> SceneFound | None:
    """The homography of a scene that a minority of the pixels shows, and where it shows; None: nothing speaks for one.

    before: H_dst_src (3, 3) of the alignment that there is, tried too. One second of a processor at 720p."""
    options = options or PairOptions()
    prepared = prepare(
        build_template(source, 0, options=options.selection, levels=(0, 1)),
        HomographyFamily(size_px=target.size_px),
    )
    starts = weak_feature_starts(
        small_gray(source, FEATURES_PX), small_gray(target, FEATURES_PX), source.size_px, target.size_px
    )
    answer = best_minority(prepared, target, starts, before, levels=(1, 0), options=options.estimator)
    if answer is None or not answer[0].usable:
        return None
    return settle_scene(source, target, answer[0], options=options)


def settle_scene(
    source: Pyramid,
    target: Pyramid,
    fit: PairFit,
    known: NDArray[np.uint8] | None = None,
    *,
    options: PairOptions | None = None,
) -> SceneFound | None:
    """A pair aligned by weak texture too, without what does not go with it, and again until that does not change.

    known: see scene_of_pair. Some 20 ms a round at 720p. None: too little is left between people, or it does not
    agree."""
    options = options or PairOptions()
    weak = replace(options.selection, threshold_grey=WEAK_GREY)
    scene = scene_of_pair(source, target, fit, known)
    for _ in range(ROUNDS):
        before = fit.H_dst_src
        template = build_template(with_scene(source, scene.source), 0, options=weak, levels=(0, 1))
        fit, _ = align(
            prepare(template, StiffHomographyFamily(size_px=target.size_px)), with_scene(target, scene.target),
            before, dst=1, levels=(1, 0), options=options.estimator, route="minority",
        )  # fmt: skip
        if not fit.usable:
            return None
        scene = scene_of_pair(source, target, fit, known)
        moved = transfer(fit.H_dst_src, fit.anchors_px) - transfer(before, fit.anchors_px)
        if np.abs(moved).max() < SETTLED_PX:
            break
    return SceneFound(fit=fit, scene=scene)


def scene_of_pair(
    source: Pyramid, target: Pyramid, fit: PairFit, known: NDArray[np.uint8] | None = None
) -> ScenePair:
    """What of two neighbours goes with the homography between them.

    known: scene of `source` as it was found with the frame before it: what moved there is doubted longer. What only one
    of the two pictures sees counts as scene."""
    index = next(
        (i for i, level in enumerate(source.levels) if level.shape[1] <= LEVEL_WIDTH), len(source.levels) - 1
    )
    a, b = (p.levels[index].astype(np.float32) for p in (source, target))
    height, width = a.shape
    to_full = level_matrix(source.scales[index])
    H = np.linalg.inv(level_matrix(target.scales[index])) @ fit.H_dst_src @ to_full
    seen = cv2.warpPerspective(
        b, H, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=np.nan
    )
    inside = np.isfinite(seen)
    seen = np.where(inside, fit.gain * seen + fit.offset, a).astype(np.float32)
    texture = np.maximum(_range(a), _range(seen))
    differs = (np.abs(a - seen) > NOISE_GREY + MISPLACED * texture) & inside
    tells = (texture > TOLD_GREY) & inside
    window = (WINDOW_PX, WINDOW_PX)
    votes, told = (
        cv2.boxFilter(plane.astype(np.float32), -1, window, normalize=False) for plane in (differs, tells)
    )
    share = np.where(votes >= LEAST_VOTES, votes / np.maximum(told, votes + 1e-3), 0.0)
    moves = share > MOVES
    if known is not None:
        before = cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST) == 0
        moves |= before & (share > STILL_MOVES)
    wide = np.asarray(cv2.dilate(_filled(moves.astype(np.uint8)), _disc(WIDER_PX)), np.uint8)
    there = np.asarray(cv2.warpPerspective(wide, H, b.shape[::-1], flags=cv2.INTER_NEAREST), np.uint8)
    return ScenePair(source=_quarter(wide, source.size_px), target=_quarter(there, target.size_px))


def _disc(radius_px: int) -> NDArray[np.uint8]:
    side = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _filled(moves: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Without the holes that a plain shirt, or one that hardly moves, leaves in who wears it."""
    border = 2 * FILLED_PX
    wider = cv2.copyMakeBorder(moves, border, border, border, border, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(wider, cv2.MORPH_CLOSE, _disc(FILLED_PX))
    return np.asarray(closed[border:-border, border:-border], np.uint8)


def _range(plane: NDArray[Any]) -> NDArray[np.float32]:
    """Largest less smallest value within 3 x 3 px."""
    square = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(cast(Any, plane), square) - cv2.erode(cast(Any, plane), square), np.float32)


def _quarter(moves: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """1 where nothing of a level's plane moves, at a quarter of the picture's size."""
    size = (-(-size_px[0] // 4), -(-size_px[1] // 4))
    share = cv2.resize(moves.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return (share == 0).astype(np.uint8)
