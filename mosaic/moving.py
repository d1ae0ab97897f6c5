"""What moves in the frames of a panorama: found by comparing each frame with the ground behind it.

A median cannot know who is the ground where a player covers it in half of the views. But he is wider than the place
where he covers it so often: elsewhere he stands before ground that most views agree on, and there he is seen to
differ from it. That is how bodies look in this shot (appearance.py), and with it the ground is told from them where the
views disagree (ground.py); what was decided tells the looks once more, in rounds. All of it happens at a fraction of
the resolution; in the end every frame gets a plane that says where it shows the ground.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.appearance import Appearance, classes_of, count_classes, learn
from mosaic.boards import other_text
from mosaic.canvas import Canvas
from mosaic.ground import Witness, apart, decide, evidence
from mosaic.motion import expand_map, local_contrast
from mosaic.states import SAME_GREY
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
BODY_GREY = 30.0  # what differs by more from ground that is certain tells how bodies look
HALO = 8  # trust close round what moves
NEAR, NEAR_AREA_PX = 100, 30  # trust about a body, and small px of the least piece taken for one
AGREE = 0.8 * 255  # support from which views are taken to agree
STEP_PX = 16  # spacing of exact map points in the small frame


@dataclass(frozen=True, slots=True, eq=False)
class _Small:
    """A view at the small scale: picture (h, w, 3), levelled; known (h, w) uint8: its plane of before, 0 = not the
    scene; trust (h, w) uint8: as it was stored; nodes of the map to the small surface; shrink: frame px per px."""

    placement: Placement
    picture: NDArray[np.uint8]
    known: NDArray[np.uint8]
    trust: NDArray[np.uint8]
    nodes: NDArray[np.float64]
    shrink: int

    def at(self) -> NDArray[np.float32]:
        """Where on the surface its pixels lie (h, w, 2)."""
        return expand_map(self.nodes, STEP_PX, (self.picture.shape[1], self.picture.shape[0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Ground:
    """On the small surface: image (h, w, 3); sure (h, w) uint8, 1 where it is taken for the ground; contested (h, w)
    uint8, 1 where the views disagree; boards (h, w) uint8, 1 where they change their text."""

    image: NDArray[np.uint8]
    sure: NDArray[np.uint8]
    contested: NDArray[np.uint8]
    boards: NDArray[np.uint8]


def find_still(scene: Scene) -> tuple[tuple[NDArray[np.uint8], ...], NDArray[np.uint8]]:
    """A plane (h / m, w / m) uint8 per view, m about w / 320, more in a huge panorama: 255 at rest, DISTRUSTED where
    something moves. And a plane over the surface at the same scale: 1 where all views agree.

    scene.still, when given, is where it starts, and what is low there stays low, unless it shows the very ground that
    was decided for. Raises ValueError for no round."""
    if scene.options.motion_rounds < 1:
        raise ValueError(f"{scene.options.motion_rounds} rounds find nothing")
    width = scene.views[0].size_px[0]
    area = scene.surface.width * scene.surface.height
    shrink = max(1, round(width / SMALL_WIDTH_PX), int(np.ceil(np.sqrt(area / MOST_SMALL_PX))))
    small = _small_scene(scene, shrink)
    layers = paint(small, Canvas(tempfile.gettempdir(), 1 << 30))
    quiet = _quiet(layers, scene.options, shrink)
    contested = quiet == 0
    sure = (layers.support > CERTAIN) & (layers.spread <= 2 * scene.options.doubt)
    ground = _Ground(layers.image, sure.astype(np.uint8), contested.astype(np.uint8), np.zeros_like(quiet))
    with ThreadPoolExecutor(scene.options.threads) as pool:
        views = list(pool.map(partial(_small_view, small, shrink=shrink), range(len(scene.views))))
        for _ in range(scene.options.motion_rounds):
            moving = np.sum(list(pool.map(partial(_bodies, ground=ground), views)), axis=0)
            look = learn(ground.image, layers.n_seen > 0, ground.sure > 0, moving)
            witnesses = list(pool.map(partial(_witness, look=look), views))
            image, moments, boards = decide(
                witnesses, layers.image, contested, small.surface, scene.options.threads,
                together=scene.options.together,
            )  # fmt: skip
            known = np.where(contested, moments > 1, sure)
            ground = replace(ground, image=image, sure=known.astype(np.uint8), boards=boards.astype(np.uint8))
        before = scene.still or (None,) * len(views)
        planes = list(pool.map(partial(_still_plane, ground=ground, look=look), views, before))
    return tuple(planes), quiet


def shown_clear(
    still: Sequence[NDArray[np.uint8]], views: Sequence[Placement], lattice: Lattice, surface: Surface
) -> NDArray[np.float32]:
    """Share 0..1 of the ground that each view shows round each lattice point, to the next points, (n, p).

    still: as find_still gives it."""
    spacing = max(np.diff(lattice.x_px).max(), np.diff(lattice.y_px).max())
    shown = np.zeros((len(views), len(lattice.rays)), np.float32)
    for row, (plane, placement) in enumerate(zip(still, views, strict=True)):
        height, width = plane.shape
        per_px = width / placement.size_px[0]
        side = 2 * int(spacing / surface.scale_px * placement.px_per_rad * per_px / 2) + 1
        mean = cv2.blur(plane, (side, side))
        at = np.nan_to_num((placement.ray_to_pixel(lattice.rays) + 0.5) * per_px - 0.5, nan=-1e6)
        x, y = np.clip(np.rint(at), 0, [width - 1, height - 1]).astype(np.intp).T
        shown[row] = mean[y, x] / np.float32(255)
    return shown


def _small_view(scene: Scene, index: int, shrink: int) -> _Small:
    placement = scene.views[index]
    stored = scene.store.get(placement.frame, shrink)
    height, width = stored.rgb.shape[:2]
    known = np.full((height, width), 255, np.uint8)
    if scene.still is not None:
        known = np.asarray(cv2.resize(scene.still[index], (width, height), interpolation=cv2.INTER_NEAREST))
    trust = np.full((height, width), 255, np.uint8) if stored.trust is None else stored.trust
    known = np.where(trust > 0, known, np.uint8(0))
    return _Small(
        placement=placement, picture=_levelled(stored.rgb, scene.gains[index], scene.falloff),
        known=np.asarray(known, np.uint8), trust=trust, nodes=_map_nodes(placement, scene.surface, shrink),
        shrink=shrink,
    )  # fmt: skip


def _bodies(view: _Small, ground: _Ground) -> NDArray[np.int64]:
    """Counts of the classes (appearance.py) of what stands before ground that is certain."""
    at = view.at()
    behind = cv2.remap(ground.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    sure = cv2.remap(ground.sure, at[..., 0], at[..., 1], cv2.INTER_NEAREST)
    differs = (apart(view.picture, behind) > BODY_GREY) & (sure > 0) & (view.known > 0)
    inner = cv2.erode(differs.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return count_classes(classes_of(view.picture), np.asarray(inner))


def _witness(view: _Small, look: Appearance) -> Witness:
    says = look.ratio(view.picture, view.at())
    # Not `known`: round what moved it distrusts ground, which may be seen in few frames.
    says += np.log(np.maximum(view.trust, 1) / np.float32(255))
    where = view.nodes[(view.nodes > -1e5).all(axis=-1)]
    box = (*where.min(axis=0), *where.max(axis=0)) if len(where) else (0.0, 0.0, 0.0, 0.0)
    return Witness(
        placement=view.placement, picture=np.dstack([view.picture, evidence(says)]),
        usable=(view.known > 0).astype(np.uint8), shrink=view.shrink, box=(box[0], box[1], box[2], box[3]),
    )  # fmt: skip


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
    lattice = Lattice(
        x_px=scene.lattice.x_px / shrink, y_px=scene.lattice.y_px / shrink, rays=scene.lattice.rays
    )
    # The maps need not be finer than the comparison.
    options = replace(scene.options, tile_px=256, cubic=False)
    return replace(
        scene,
        surface=scene.surface.reduced(shrink),
        lattice=lattice,
        options=options,
        map_error_px=0.1 * shrink,
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


def _still_plane(
    view: _Small, before: NDArray[np.uint8] | None, ground: _Ground, look: Appearance
) -> NDArray[np.uint8]:
    """Where a frame shows the ground, closed to whole bodies. before: its plane of before, at any resolution."""
    width = view.known.shape[1]
    at = view.at()
    behind = np.asarray(cv2.remap(ground.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.uint8)
    contested = cv2.remap(ground.contested, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0
    off = apart(view.picture, behind)
    # Fine detail that lies a fraction of a pixel off differs without moving: allow for what a neighbour would explain.
    differs = (off > DIFFERENT_GREY + 0.25 * local_contrast(behind)) & (view.known > 0)
    # A sharp frame differs from smeared ones that outvote it: smeared it would be like them, and it looks like ground.
    square = np.ones((5, 5), np.uint8)
    smeared = np.clip(behind, cv2.erode(view.picture, square), cv2.dilate(view.picture, square))
    spared = contested & (apart(smeared, behind) < SAME_GREY) & (look.ratio(view.picture, at) > 0)
    differs &= ~spared
    other = other_text(differs, cv2.remap(ground.boards, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0)
    core = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    shows = contested & (off < SAME_GREY) & (view.known > 0) & ~other
    side = 2 * max(2, round(width / 40)) + 1  # bridges a gap of a twentieth of the width
    body = cv2.dilate(cv2.morphologyEx(core, cv2.MORPH_CLOSE, _disc(side), borderValue=0), _disc(5))
    # Who was seen moving stands as close by.
    plane = _near_bodies(np.maximum(body, (view.known <= DISTRUSTED).astype(np.uint8)))
    plane[body > 0] = HALO
    plane[(core > 0) | other] = DISTRUSTED
    known = view.known if before is None or before.size == 1 else before  # finer planes keep their outlines
    size = (known.shape[1], known.shape[0])
    plane = np.minimum(cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST), known)
    plane[_resized(shows, known) & (known > 0)] = 255
    return np.asarray(plane, np.uint8)


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
