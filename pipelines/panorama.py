"""From cameras and stored frames to a panorama as the configuration asks for it: of one shot, or of several merged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mosaic.composite import Panorama, composite
from mosaic.cropping import crop_inside
from mosaic.framestore import FrameStore
from mosaic.surface import Surface, choose_surface
from mosaic.views import CompositeOptions, ViewPlan, plan_views
from pipelines.bridge import CameraPlacement
from pipelines.config import Config
from pipelines.moments import Trail, choose_moments, trail

MAX_PLACEMENTS_FOR_SURFACE = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanoramaPlan:
    """The surface, the frames that shall be stored for it, and how they are put together."""

    surface: Surface
    views: ViewPlan
    options: CompositeOptions


def plan_panorama(
    placements: Sequence[CameraPlacement], config: Config, *, stored: FrameStore | None = None
) -> PanoramaPlan:
    """Surface and frames for these placements. stored: plan among the frames that it holds; None: among all.

    views.frames is empty where the panorama would be too small for any frame to be believed in it."""
    options = CompositeOptions(views=config.panorama.views)
    stride = max(1, len(placements) // MAX_PLACEMENTS_FOR_SURFACE)
    surface = choose_surface(
        placements[::stride], config.panorama.projection, max_pixels=config.panorama.max_megapixels * 1e6
    )
    views = plan_views([p for p in placements if stored is None or p.frame in stored], surface, options)
    return PanoramaPlan(surface=surface, views=views, options=options)


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
