"""What moves in the frames of a panorama: found by comparing each frame with the composite itself, in rounds.

A median cannot know who is the ground where a player covers it in half of the views. But he is wider than the place
where he covers it so often: elsewhere he stands before ground that most views agree on, and there he is seen to
differ from it. Where he covers it in most views, his outline tells: it is there in the composite, and not in the few
frames that show the ground (contest.py). What these agree on is taken for the ground, all other views of the place
are distrusted, and the next round's composite is free of more of him. All of it happens at a fraction of the
resolution: cost is a few per cent of the final composite per round.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.canvas import Canvas
from mosaic.contest import GHOST, SAME_GREY, Correction, GroundVote, apart, verdict
from mosaic.motion import expand_map, local_contrast
from mosaic.surface import Placement, Surface
from mosaic.tile_maps import GRID_PX, Scene
from mosaic.tiles import Layers, paint
from mosaic.views import CompositeOptions, Lattice
from mosaic.vignetting import log_falloff, radius_squared

SMALL_WIDTH_PX = 320  # frames are compared at about this width
# Of the composite that they are compared with: some 65 bytes a pixel are held at a time (measured: 950 MiB for the 14.7
# million of a 59-megapixel panorama of 640x360 frames). A larger one is compared at a smaller scale.
MOST_SMALL_PX = 5_000_000
DISTRUSTED = 2  # of 255: what seems to move still counts where nothing else is there
DIFFERENT_GREY = (
    14.0  # a difference beyond this and 2 x the spread of the views is one; codec noise of a mean is 2..4
)
CERTAIN = 0.7 * 255  # share of the votes near the value: there the composite is taken for the ground
MIN_SEED = (
    0.2  # share of certain pixels in a region that differs, below which the composite itself may be wrong
)
STRANGE = (
    2.0  # times the usual distance from the ground round about, beyond which a colour does not belong there
)
GROUND_PX, GROUND_SHRINK = (
    100,
    4,
)  # small px: side of the neighbourhood, and the reduction at which it is looked at
PLAIN_GREY = 16.0  # usual distance from the ground round about, above which that is no plain ground
HALO, LIFTED = 8, 150  # trust close round what moves; and there where the colour is that of the plain ground
NEAR, NEAR_AREA_PX = 100, 30  # trust about a body, and small px of the least piece taken for one
AGREE = 0.8 * 255  # support from which views are taken to agree
STEP_PX = 16  # spacing of exact map points in the small frame


Planes = list[NDArray[np.uint8]]


def find_still(scene: Scene) -> tuple[tuple[NDArray[np.uint8], ...], NDArray[np.uint8]]:
    """A plane (h / m, w / m) uint8 per view, m about w / 320, more in a huge panorama: 255 at rest, DISTRUSTED where
    something moves. And a plane over the surface at the same scale: 1 where all views agree.

    scene.still, when given, is where the rounds start, and what is low there stays low. Raises ValueError for no
    round."""
    if scene.options.motion_rounds < 1:
        raise ValueError(f"{scene.options.motion_rounds} rounds find nothing")
    width = scene.views[0].size_px[0]
    area = scene.surface.width * scene.surface.height
    shrink = max(1, round(width / SMALL_WIDTH_PX), int(np.ceil(np.sqrt(area / MOST_SMALL_PX))))
    small = _small_scene(scene, shrink)
    nodes = [_map_nodes(placement, small.surface, shrink) for placement in scene.views]
    everywhere = np.full((1, 1), 255, np.uint8)
    known: Planes = [everywhere] * len(scene.views) if scene.still is None else list(scene.still)
    still = scene.still
    with ThreadPoolExecutor(scene.options.threads) as pool:
        for _ in range(scene.options.motion_rounds):
            layers = paint(replace(small, still=still), Canvas(tempfile.gettempdir(), 1 << 30))

            ground = _surroundings(layers)

            def compare(
                index: int, layers: Layers = layers, ground: Ground = ground, known: Planes = known
            ) -> _Compared:
                return _compare(small, index, layers, ground, nodes[index], shrink, known[index])

            compared = list(pool.map(compare, range(len(scene.views))))
            correction = _correction(scene, compared, nodes, layers)

            def judge(
                index: int,
                compared: list[_Compared] = compared,
                correction: Correction = correction,
                known: Planes = known,
            ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
                return _still_plane(compared[index], nodes[index], correction, known[index])

            planes = list(pool.map(judge, range(len(scene.views))))
            still, known = tuple(plane for plane, _ in planes), [corrected for _, corrected in planes]
    assert still is not None
    return still, _quiet(layers, scene.options, shrink)


def _quiet(layers: Layers, options: CompositeOptions, shrink: int) -> NDArray[np.uint8]:
    """1 where enough views see the same and few of them something else, and so for half a cell of the full tiles' maps
    round about: the nearest grid point stands for the pixels between."""
    agree = (
        (layers.spread <= 2 * options.doubt)
        & (layers.support >= AGREE)
        & (layers.n_seen >= options.quiet_views)
    )
    side = 2 * -(-GRID_PX // (2 * shrink)) + 1
    return np.asarray(
        cv2.erode(agree.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1), np.uint8
    )


def _small_scene(scene: Scene, shrink: int) -> Scene:
    """The same scene on a surface whose pixels are `shrink` times larger."""
    full = scene.surface
    surface = Surface(
        kind=full.kind, scale_px=full.scale_px / shrink, cx=(full.cx + 0.5) / shrink - 0.5,
        cy=(full.cy + 0.5) / shrink - 0.5, width=-(-full.width // shrink), height=-(-full.height // shrink),
    )  # fmt: skip
    lattice = Lattice(
        x_px=scene.lattice.x_px / shrink, y_px=scene.lattice.y_px / shrink, rays=scene.lattice.rays
    )
    # Painted in every round: the maps are kept, and need not be finer than the comparison.
    return replace(
        scene, surface=surface, lattice=lattice, options=replace(scene.options, tile_px=256, cubic=False),
        map_error_px=0.1 * shrink, maps={}, fillers={},
    )  # fmt: skip


Ground = tuple[NDArray[np.uint8], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """One small frame against the composite: picture (h, w, 3), levelled; (h, w) bool: moves, where it shows an object
    before the composite's ground; ghost, where the composite shows one and the frame ground; plain, where the frame
    shows just what the plain ground round about is."""

    picture: NDArray[np.uint8]
    moves: NDArray[np.bool_]
    ghost: NDArray[np.bool_]
    plain: NDArray[np.bool_]


def _compare(
    scene: Scene,
    index: int,
    layers: Layers,
    ground: Ground,
    nodes: NDArray[np.float64],
    shrink: int,
    known: NDArray[np.uint8],
) -> _Compared:
    stored = scene.store.get(scene.views[index].frame, shrink)
    height, width = stored.rgb.shape[:2]
    at = expand_map(nodes, STEP_PX, (width, height))
    truth = np.asarray(cv2.remap(layers.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.uint8)
    facts = np.stack([layers.support, layers.n_seen], axis=-1)
    support, n_seen = np.moveaxis(cv2.remap(facts, at[..., 0], at[..., 1], cv2.INTER_NEAREST), -1, 0)
    frame = _levelled(stored.rgb, scene.gains[index], scene.falloff)
    # Fine detail that lies a fraction of a pixel off differs without moving: allow for what a neighbour would explain.
    detail = local_contrast(truth)
    seen = (n_seen > 1) & (cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST) > 0)
    if stored.trust is not None:
        seen &= stored.trust > 0
    differs = (apart(frame, truth) > DIFFERENT_GREY + 0.25 * detail) & seen
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    n, found = cv2.connectedComponents(opened, connectivity=8)
    labels = np.asarray(found, np.int32)
    area = np.bincount(labels.ravel(), minlength=n)
    certain = np.bincount(labels.ravel(), weights=(support.ravel() > CERTAIN), minlength=n)
    seed = certain > MIN_SEED * area
    seed[0] = False
    outline = verdict(frame, truth, labels, area)
    around, usual = (cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR) for picture in ground)
    here, there = apart(frame, around), apart(truth, around)
    strange, on_plain = STRANGE * usual + DIFFERENT_GREY, usual < PLAIN_GREY
    fits = on_plain & (0.5 * there > here) & (there > strange)
    misfits = on_plain & (0.5 * here > there) & (here > strange)
    differs = opened > 0
    ghost = differs & (fits | (outline < GHOST)) & ~misfits
    return _Compared(
        picture=frame,
        moves=differs & ~ghost & (misfits | seed[labels] & (outline > 0)),
        ghost=ghost,
        plain=on_plain & (here < 1.5 * usual + 0.5 * DIFFERENT_GREY),
    )


def _levelled(
    rgb: NDArray[np.uint8], gain: NDArray[np.float32], falloff: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """rgb (h, w, 3) times gain (3,), the lens's falloff divided out."""
    table = np.minimum(np.arange(256)[:, None] * gain, 255).astype(np.uint8)
    levelled = np.asarray(cv2.LUT(rgb, np.ascontiguousarray(table[None])), np.uint8)
    if not falloff.any():
        return levelled
    height, width = rgb.shape[:2]
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    light = np.exp(-log_falloff(falloff, radius_squared(xy, (width, height)))).astype(np.float32)
    return np.asarray(np.minimum(levelled * light[..., None], 255).astype(np.uint8))


def _surroundings(layers: Layers) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour (h, w, 3) of the ground round about each pixel, and how far pixels there usually are from it (h, w).

    Medians over a neighbourhood wider than a body: on a pitch that is grass, in a crowd the spread says that it means
    nothing."""
    height, width = layers.n_seen.shape
    size = (max(1, width // GROUND_SHRINK), max(1, height // GROUND_SHRINK))
    side = 2 * (GROUND_PX // (2 * GROUND_SHRINK)) + 1
    tiny = np.asarray(cv2.resize(layers.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    colour = cv2.resize(cv2.medianBlur(tiny, side), (width, height), interpolation=cv2.INTER_LINEAR)
    away = cv2.resize(
        apart(layers.image, np.asarray(colour, np.uint8)), size, interpolation=cv2.INTER_NEAREST
    )
    usual = cv2.medianBlur(np.clip(np.rint(away), 0, 255).astype(np.uint8), side).astype(np.float32)
    return np.asarray(colour, np.uint8), np.asarray(
        cv2.resize(usual, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _correction(
    scene: Scene, compared: list[_Compared], nodes: list[NDArray[np.float64]], layers: Layers
) -> Correction:
    """Where the frames that show ground agree that the composite shows an object, and on what is there instead."""
    height, width = layers.n_seen.shape
    vote = GroundVote((height, width))
    for view, one, corners in zip(scene.views, compared, nodes, strict=True):
        if one.ghost.any():
            at = expand_map(corners, STEP_PX, (one.ghost.shape[1], one.ghost.shape[0]))
            vote.add(view.frame, one.picture, one.ghost, at)
    return vote.correct(layers.image, DIFFERENT_GREY)


def _still_plane(
    one: _Compared, nodes: NDArray[np.float64], correction: Correction, known: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """What moves in a frame, closed to whole bodies; and `known` for the next round.

    known: a plane of before, at any resolution; what is low there stays low, but for a halo that is plain ground.
    Where the composite was corrected the frame is trusted when it shows the ground that was voted for, else not."""
    height, width = one.moves.shape
    side = 2 * max(2, round(width / 40)) + 1  # bridges a gap of a twentieth of the width
    if known.shape != (height, width):  # finer planes keep outlines that the comparison does not see
        known = np.asarray(cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
    core = one.moves.astype(np.uint8)
    shows = np.zeros((height, width), bool)
    if correction.accepted.any():
        at = expand_map(nodes, STEP_PX, (width, height))
        wrong = cv2.remap(correction.accepted, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0
        ground = np.asarray(cv2.remap(correction.ground, at[..., 0], at[..., 1], cv2.INTER_NEAREST), np.uint8)
        agrees = apart(one.picture, ground) < SAME_GREY
        shows, hides = wrong & agrees, wrong & ~agrees
        core |= hides.astype(np.uint8)
        known = np.where(_resized(hides, known) & (known > DISTRUSTED), np.uint8(DISTRUSTED), known)
        known[_resized(shows, known) & (known > 0)] = 255
    body = cv2.dilate(cv2.morphologyEx(core, cv2.MORPH_CLOSE, _disc(side), borderValue=0), _disc(5))
    # Who was seen moving stands as close by.
    moving = cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST) <= DISTRUSTED
    plane = _near_bodies(np.maximum(body, moving.astype(np.uint8)))
    plane[body > 0] = HALO
    plane[core > 0] = DISTRUSTED
    size = (known.shape[1], known.shape[0])
    plane = np.minimum(cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST), known)
    plain = _resized(one.plain, known)
    plane[plain & (plane == NEAR)] = 255
    plane[plain & (plane == HALO)] = LIFTED
    plane[_resized(shows, known) & (known > 0)] = 255
    return np.asarray(plane, np.uint8), np.asarray(known, np.uint8)


def _resized(flags: NDArray[np.bool_], like: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Flags (h, w) at the resolution of another plane, nearest."""
    size = (like.shape[1], like.shape[0])
    return np.asarray(cv2.resize(flags.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0, np.bool_)


def _near_bodies(found: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """255, but NEAR about each piece of `found` (h, w, 1 = moves): its own height upwards and a third to the sides.

    Legs before grass are found for certain, the shoulders before a crowd or a hoarding are not. Views in which nobody
    is near have the say there; where all have somebody, nothing changes between them."""
    height, width = found.shape
    plane = np.full((height, width), 255, np.uint8)
    n, _, stats, _ = cv2.connectedComponentsWithStats(found, connectivity=8)
    for x, y, w, h, area in stats[1:n]:
        if area < NEAR_AREA_PX:
            continue
        high = min(h, height // 3)
        side = max(high // 3, 2)
        plane[max(y - high, 0) : y + h + side, max(x - side, 0) : x + w + side] = NEAR
    return plane


def _disc(width: int, height: int | None = None) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, height or width)), dtype=np.uint8)


def _map_nodes(placement: Placement, surface: Surface, shrink: int) -> NDArray[np.float64]:
    """Surface pixels (rows, columns, 2) of every STEP_PX-th pixel of a reduced frame, a little beyond it."""
    columns, rows = (STEP_PX * np.arange(-(-n // (shrink * STEP_PX)) + 1) for n in placement.size_px)
    exact = np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64) * shrink + (shrink - 1) / 2
    nodes = surface.ray_to_pixel(placement.pixel_to_ray(exact))
    # A node that no ray reaches goes far outside, and what is mixed with it too: there nothing is compared.
    return np.where(np.isfinite(nodes), nodes, -1e6)
