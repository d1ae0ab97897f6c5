"""What moves in the frames of a panorama: found by comparing each frame with the composite itself, in rounds.

A median cannot know who is the ground where a player covers it in half of the views. But he is wider than the place
where he covers it so often: elsewhere he stands before ground that most views agree on, and there he is seen to
differ from it. Where he covers it in most views, the grass round about tells: of two colours the one that fits there
is the ground, and the views that agree with the other one show him. The whole of him is distrusted in those frames,
and the next round's composite is free of more of him. All of it happens at a fraction of the resolution: cost is a
few per cent of the final composite per round.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from mosaic.canvas import Canvas
from mosaic.motion import expand_map, local_contrast
from mosaic.surface import Placement, Surface
from mosaic.tile_maps import GRID_PX, Scene
from mosaic.tiles import Layers, paint
from mosaic.views import CompositeOptions, Lattice

SMALL_WIDTH_PX = 320  # frames are compared at about this width
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
MOMENT_FRAMES = 6  # views nearer than this say the same about a place
AGREE = 0.8 * 255  # support from which views are taken to agree
STEP_PX = 16  # spacing of exact map points in the small frame


def find_still(scene: Scene) -> tuple[tuple[NDArray[np.uint8], ...], NDArray[np.uint8]]:
    """A plane (h / m, w / m) uint8 per view, m about w / 320: 255 at rest, DISTRUSTED where something moves. And a
    plane over the surface at the same scale: 1 where all views agree.

    scene.still, when given, is where the rounds start, and what is low there stays low. Raises ValueError for no
    round."""
    if scene.options.motion_rounds < 1:
        raise ValueError(f"{scene.options.motion_rounds} rounds find nothing")
    width = scene.views[0].size_px[0]
    shrink = max(1, round(width / SMALL_WIDTH_PX))
    small = _small_scene(scene, shrink)
    nodes = [_map_nodes(placement, small.surface, shrink) for placement in scene.views]
    known = scene.still
    still = known
    with ThreadPoolExecutor(scene.options.threads) as pool:
        for _ in range(scene.options.motion_rounds):
            layers = paint(replace(small, still=still), Canvas(tempfile.gettempdir(), 1 << 30))

            ground = _surroundings(layers)

            def compare(index: int, layers: Layers = layers, ground: Ground = ground) -> _Compared:
                return _compare(small, index, layers, ground, nodes[index], shrink)

            compared = list(pool.map(compare, range(len(scene.views))))
            wrong = _where_composite_is_wrong(scene, compared, nodes, layers.n_seen.shape)

            def judge(
                index: int, compared: list[_Compared] = compared, wrong: NDArray[np.uint8] = wrong
            ) -> NDArray[np.uint8]:
                return _still_plane(
                    compared[index], nodes[index], wrong, None if known is None else known[index]
                )

            still = tuple(pool.map(judge, range(len(scene.views))))
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
    """One small frame against the composite, (h, w) bool: moves, where the frame shows an object before the composite's
    ground; ghost, where the composite shows one and the frame ground; foreign, where the frame shows what does not fit
    the ground round about; plain, where it shows just that."""

    moves: NDArray[np.bool_]
    ghost: NDArray[np.bool_]
    foreign: NDArray[np.bool_]
    plain: NDArray[np.bool_]


def _compare(
    scene: Scene, index: int, layers: Layers, ground: Ground, nodes: NDArray[np.float64], shrink: int
) -> _Compared:
    stored = scene.store.get(scene.views[index].frame, shrink)
    height, width = stored.rgb.shape[:2]
    at = expand_map(nodes, STEP_PX, (width, height))
    truth = np.asarray(cv2.remap(layers.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.uint8)
    facts = np.stack([layers.spread, layers.support, layers.n_seen], axis=-1)
    spread, support, n_seen = np.moveaxis(cv2.remap(facts, at[..., 0], at[..., 1], cv2.INTER_NEAREST), -1, 0)
    frame = _levelled(stored.rgb, scene.gains[index])
    apart = _apart(frame, truth)
    # Fine detail that lies a fraction of a pixel off differs without moving: allow for what a neighbour would explain.
    detail = local_contrast(truth)
    seen = n_seen > 1
    if stored.trust is not None:
        seen &= stored.trust > 0
    if (
        scene.still is not None
    ):  # what is known to move is left out: then the rest shows the composite's faults
        plane = cv2.resize(scene.still[index], (width, height), interpolation=cv2.INTER_NEAREST)
        seen &= plane > DISTRUSTED
    differs = (apart > DIFFERENT_GREY + 2.0 * np.minimum(spread, 20) + 0.25 * detail) & seen
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    n, labels = cv2.connectedComponents(opened, connectivity=8)
    area = np.bincount(labels.ravel(), minlength=n)
    certain = np.bincount(labels.ravel(), weights=(support.ravel() > CERTAIN), minlength=n)
    seed = certain > MIN_SEED * area
    seed[0] = False
    around, usual = (cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR) for picture in ground)
    here, there = _apart(frame, around), _apart(truth, around)
    strange = STRANGE * usual + DIFFERENT_GREY
    fits, misfits = (0.5 * there > here) & (there > strange), (0.5 * here > there) & (here > strange)
    differs = opened > 0
    plain = (usual < PLAIN_GREY) & (here < 1.5 * usual + 0.5 * DIFFERENT_GREY)
    return _Compared(
        moves=differs & (misfits | seed[labels] & ~fits),
        ghost=differs & fits,
        foreign=seen & (here > strange) & (~differs | (usual < PLAIN_GREY)),
        plain=plain,
    )


@numba.njit(cache=True, nogil=True)
def _apart(a, b):  # type: ignore[no-untyped-def]
    """Mean difference (h, w) float32 of the channels of two pictures, green twice."""
    out = np.empty(a.shape[:2], np.float32)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            red = abs(np.int32(a[i, j, 0]) - np.int32(b[i, j, 0]))
            green = abs(np.int32(a[i, j, 1]) - np.int32(b[i, j, 1]))
            blue = abs(np.int32(a[i, j, 2]) - np.int32(b[i, j, 2]))
            out[i, j] = np.float32(0.25) * np.float32(red + 2 * green + blue)
    return out


def _levelled(rgb: NDArray[np.uint8], gain: NDArray[np.float32]) -> NDArray[np.uint8]:
    """rgb (h, w, 3) times gain (3,)."""
    table = np.minimum(np.arange(256)[:, None] * gain, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(rgb, np.ascontiguousarray(table[None])), np.uint8)


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
        _apart(layers.image, np.asarray(colour, np.uint8)), size, interpolation=cv2.INTER_NEAREST
    )
    usual = cv2.medianBlur(np.clip(np.rint(away), 0, 255).astype(np.uint8), side).astype(np.float32)
    return np.asarray(colour, np.uint8), np.asarray(
        cv2.resize(usual, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _where_composite_is_wrong(
    scene: Scene, compared: list[_Compared], nodes: list[NDArray[np.float64]], shape: tuple[int, ...]
) -> NDArray[np.uint8]:
    """(h, w) uint8 over the small surface: 1 where frames of more than one moment say that an object was painted."""
    count = np.zeros(shape, np.uint8)
    last: NDArray[np.int32] = np.full(shape, -(10**6), np.int32)
    for view, one, corners in zip(scene.views, compared, nodes, strict=True):
        if not one.ghost.any():
            continue
        height, width = one.ghost.shape
        at = np.rint(expand_map(corners, STEP_PX, (width, height))[one.ghost]).astype(np.intp)
        at = at[((at >= 0) & (at < [shape[1], shape[0]])).all(axis=-1)]
        hit = np.zeros(shape, np.uint8)
        hit[at[:, 1], at[:, 0]] = 1
        new = (cv2.dilate(hit, np.ones((3, 3), np.uint8)) > 0) & (view.frame - last >= MOMENT_FRAMES)
        count[new] += 1
        last[new] = view.frame
    return np.asarray(count >= 2, np.uint8)


def _still_plane(
    one: _Compared, nodes: NDArray[np.float64], wrong: NDArray[np.uint8], known: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    """What moves in a frame, closed to whole bodies; and what agrees with the composite where that shows an object.

    known: a plane of before, at any resolution; what is low there stays low, but for a halo that is plain ground."""
    height, width = one.moves.shape
    side = 2 * max(2, round(width / 40)) + 1  # bridges a gap of a twentieth of the width
    core = one.moves.astype(np.uint8)
    if wrong.any():
        at = expand_map(nodes, STEP_PX, (width, height))
        ghost = cv2.remap(wrong, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0
        core |= (ghost & one.foreign).astype(np.uint8)
    body = cv2.dilate(cv2.morphologyEx(core, cv2.MORPH_CLOSE, _disc(side), borderValue=0), _disc(5))
    closed = body
    if known is not None:  # who was seen moving stands as close by
        moving = cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST) <= DISTRUSTED
        closed = np.maximum(body, moving.astype(np.uint8))
    plane = _near_bodies(np.asarray(closed, np.uint8))
    plane[body > 0] = HALO
    plane[core > 0] = DISTRUSTED
    if known is None:
        plane[one.plain & (plane == NEAR)] = 255
        plane[one.plain & (plane == HALO)] = LIFTED
        return np.asarray(plane, np.uint8)
    size = (known.shape[1], known.shape[0])
    if known.size < plane.size:
        size = (width, height)
        known = np.asarray(cv2.resize(known, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    plane = np.minimum(cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST), known)
    plain = cv2.resize(one.plain.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    plane[plain & (plane == NEAR)] = 255
    plane[plain & (plane == HALO)] = LIFTED
    return np.asarray(plane, np.uint8)


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
