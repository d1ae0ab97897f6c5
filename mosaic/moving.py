"""What moves in the frames of a panorama: found by comparing each frame with the composite itself, in rounds.

A median cannot know who is the ground where a player covers it in half of the views. But he is wider than the place
where he covers it so often: elsewhere he stands before ground that most views agree on, and there he is seen to
differ from it. From such certain pixels his outline is closed, the whole of him is distrusted in that frame, and the
next round's composite is free of more of him. All of it happens at a fraction of the resolution: cost is a few per
cent of the final composite per round.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.canvas import Canvas
from mosaic.surface import Placement, Surface
from mosaic.tiles import Layers, Scene, paint
from mosaic.views import Lattice

SMALL_WIDTH_PX = 320  # frames are compared at about this width
DISTRUSTED = 10  # of 255: what seems to move still counts where nothing else is there
DIFFERENT_GREY = (
    14.0  # a difference beyond this and 2 x the spread of the views is one; codec noise of a mean is 2..4
)
CERTAIN = 0.7 * 255  # share of the votes near the value: there the composite is taken for the ground
MIN_SEED = (
    0.2  # share of certain pixels in a region that differs, below which the composite itself may be wrong
)
STEP_PX = 16  # spacing of exact map points in the small frame


def find_still(scene: Scene) -> tuple[NDArray[np.uint8], ...]:
    """A plane (h / m, w / m) uint8 per view, m about w / 320: 255 at rest, DISTRUSTED where something moves."""
    width = scene.views[0].size_px[0]
    shrink = max(1, round(width / SMALL_WIDTH_PX))
    small = _small_scene(scene, shrink)
    nodes = [_map_nodes(placement, small.surface, shrink) for placement in scene.views]
    still: tuple[NDArray[np.uint8], ...] | None = None
    for _ in range(scene.options.motion_rounds):
        layers = paint(replace(small, still=still), Canvas(tempfile.gettempdir(), 1 << 30))

        def compare(index: int, layers: Layers = layers) -> NDArray[np.uint8]:
            return _still_plane(small, index, layers, nodes[index], shrink)

        with ThreadPoolExecutor(scene.options.threads) as pool:
            still = tuple(pool.map(compare, range(len(scene.views))))
    assert still is not None
    return still


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
    return replace(
        scene, surface=surface, lattice=lattice, options=replace(scene.options, tile_px=256, cubic=False)
    )


def _still_plane(
    scene: Scene, index: int, layers: Layers, nodes: NDArray[np.float64], shrink: int
) -> NDArray[np.uint8]:
    """One frame against the composite."""
    stored = scene.store.get(scene.views[index].frame, shrink)
    height, width = stored.rgb.shape[:2]
    across, down = _hat(width, nodes.shape[1]), _hat(height, nodes.shape[0])
    at = np.stack([down @ nodes[..., i] @ across.T for i in (0, 1)], axis=-1).astype(np.float32)
    truth = cv2.remap(layers.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    facts = np.stack([layers.spread, layers.support, layers.n_seen], axis=-1)
    spread, support, n_seen = np.moveaxis(cv2.remap(facts, at[..., 0], at[..., 1], cv2.INTER_NEAREST), -1, 0)
    frame = np.minimum(stored.rgb * scene.gains[index], 255)
    apart = np.abs(frame - truth) @ np.array([0.25, 0.5, 0.25], np.float32)
    # Fine detail that lies a fraction of a pixel off differs without moving: allow for what a neighbour would explain.
    detail = cv2.morphologyEx(truth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).mean(axis=-1)
    differs = (apart > DIFFERENT_GREY + 2.0 * np.minimum(spread, 20) + 0.25 * detail) & (n_seen > 2)
    if stored.trust is not None:
        differs &= stored.trust > 0
    differs = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    n, labels = cv2.connectedComponents(differs, connectivity=8)
    area = np.bincount(labels.ravel(), minlength=n)
    certain = np.bincount(labels.ravel(), weights=(support.ravel() > CERTAIN), minlength=n)
    moving = certain > MIN_SEED * area
    moving[0] = False
    side = 2 * max(2, round(width / 40)) + 1  # bridges a gap of a twentieth of the width
    mask = cv2.morphologyEx(moving[labels].astype(np.uint8), cv2.MORPH_CLOSE, _disc(side), borderValue=0)
    mask = cv2.dilate(mask, _disc(5))
    still = np.where(mask > 0, np.uint8(DISTRUSTED), np.uint8(255))
    return still


def _disc(width: int, height: int | None = None) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, height or width)), dtype=np.uint8)


def _map_nodes(placement: Placement, surface: Surface, shrink: int) -> NDArray[np.float64]:
    """Surface pixels (rows, columns, 2) of every STEP_PX-th pixel of a reduced frame, a little beyond it."""
    columns, rows = (STEP_PX * np.arange(-(-n // (shrink * STEP_PX)) + 1) for n in placement.size_px)
    exact = np.stack(np.meshgrid(columns, rows), axis=-1) * float(shrink) + (shrink - 1) / 2
    nodes = surface.ray_to_pixel(placement.pixel_to_ray(exact))
    # A node that no ray reaches goes far outside, and what is mixed with it too: there nothing is compared.
    return np.where(np.isfinite(nodes), nodes, -1e6)


def _hat(n: int, n_nodes: int) -> NDArray[np.float64]:
    """Weights (n, n_nodes) of linear interpolation between nodes STEP_PX apart."""
    return np.maximum(1 - np.abs(np.arange(n)[:, None] / STEP_PX - np.arange(n_nodes)), 0.0)
