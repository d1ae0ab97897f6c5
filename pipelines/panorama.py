"""From cameras and stored frames to a panorama as the configuration asks for it: of one shot, or of several merged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.composite import Panorama, composite
from mosaic.cropping import crop_inside
from mosaic.framestore import COARSE, FrameStore
from mosaic.glances import shown_ground
from mosaic.surface import Surface, choose_surface
from mosaic.views import CompositeOptions, ViewPlan, plan_views
from pipelines.bridge import CameraPlacement
from pipelines.config import Config
from pipelines.keyframe_graph import KeyframeImages
from pipelines.moments import Trail, choose_moments, trail

MAX_PLACEMENTS_FOR_SURFACE = 400
# Small pictures that are compared: 20 ms of a processor each. Of fewer than the least a median says nothing.
MOST_GLANCES, LEAST_GLANCES = 100, 7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanoramaPlan:
    """The surface, the frames that shall be stored for it, and how they are put together."""

    surface: Surface
    views: ViewPlan
    options: CompositeOptions


def plan_panorama(
    placements: Sequence[CameraPlacement],
    config: Config,
    *,
    stored: FrameStore | None = None,
    glances: FrameStore | None = None,
) -> PanoramaPlan:
    """Surface and frames for these placements. stored: plan among the frames that it holds; None: among all.
    glances: small pictures of some of them, in which bodies are looked for.

    views.frames is empty where the panorama would be too small for any frame to be believed in it."""
    options = CompositeOptions(views=config.panorama.views, detail=config.panorama.detail)
    stride = max(1, len(placements) // MAX_PLACEMENTS_FOR_SURFACE)
    surface = choose_surface(
        placements[::stride], config.panorama.projection, max_pixels=config.panorama.max_megapixels * 1e6
    )
    shown = None if glances is None else shown_ground(glances, placements, surface, options)
    candidates = [p for p in placements if stored is None or p.frame in stored]
    views = plan_views(candidates, surface, options, shown)
    return PanoramaPlan(surface=surface, views=views, options=options)


def glances_of(
    images: KeyframeImages, frames: set[int], mask: Callable[[int], NDArray[np.bool_] | None], scratch: Path
) -> FrameStore | None:
    """A shot's small pictures as what `plan_panorama` asks for, of MOST_GLANCES frames at most; the caller closes it.

    frames: those that have a camera. mask: of a frame, (h, w) bool, True = scene, None = all of it. None: too few
    pictures to compare, or too small ones."""
    known = [k for k in images.glances if k in frames]
    if len(known) < LEAST_GLANCES:
        return None
    rows = np.linspace(0, len(known) - 1, min(len(known), MOST_GLANCES)).round().astype(int)
    height, width = images.glance(known[0]).shape
    if min(width, height) < COARSE:
        return None
    store = FrameStore(scratch, (width, height), mask_margin_px=1)
    for frame in (known[row] for row in rows):
        usable = mask(frame)
        if usable is not None:
            share = cv2.resize(usable.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_AREA)
            usable = share == 255
        store.put(frame, cv2.cvtColor(images.glance(frame), cv2.COLOR_GRAY2RGB), usable)
    return store


def compose(
    plan: PanoramaPlan,
    store: FrameStore,
    placements: Sequence[CameraPlacement],
    config: Config,
    scratch: Path,
    progress: Callable[[float], None],
) -> Panorama:
    """The stored frames on the plan's surface under their final placements, cropped where that is asked for.

    progress: called with 0..1. Raises ValueError: no stored frame has a placement.
    """
    panorama = composite(
        plan.views, store, placements, plan.surface, plan.options, scratch=scratch, progress=progress
    )
    return crop_inside(panorama) if config.panorama.crop == "inside" else panorama


def moments_of(
    panorama: Panorama, store: FrameStore, plan: PanoramaPlan, config: Config, scratch: Path
) -> Trail | None:
    """The panorama with the players of the moments that the configuration asks for; None: it asks for none here."""
    options = config.panorama
    stored = [k for k in plan.views.frames if k in store and k in panorama.placements]
    wanted = [k for k in options.moment_frames if stored and stored[0] <= k <= stored[-1]]
    if options.moment_frames and not wanted:
        return None  # of another shot
    if not (wanted or options.moments):
        return None
    return trail(panorama, store, choose_moments(stored, options.moments, wanted), str(scratch))
