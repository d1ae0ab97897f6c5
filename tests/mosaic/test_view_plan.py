"""The plan of a panorama where its surface is odd: a few pixels high, closed to a full turn, running to infinity."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.surface import choose_surface
from mosaic.views import _draw_outline, plan_views
from tests.mosaic.pinhole import Pinhole

TURN = [Pinhole(frame=k, f_px=300.0, pan_deg=6.0 * k) for k in range(60)]


@pytest.mark.parametrize("height_px", [12, 20, 30])
def test_a_panorama_a_few_pixels_high_has_views(height_px: int) -> None:
    frames = [Pinhole(frame=k, f_px=400.0, size_px=(320, height_px), pan_deg=0.5 * k) for k in range(20)]
    surface = choose_surface(frames, "planar")
    assert surface.height <= height_px + 4
    assert plan_views(frames, surface).frames


@pytest.mark.parametrize("height_px", [4, 7])
def test_where_no_frame_is_believed_in_the_plan_is_empty(height_px: int) -> None:
    """All of a picture seven pixels high lies within the border of three that does not count."""
    frames = [Pinhole(frame=k, f_px=400.0, size_px=(320, height_px)) for k in range(20)]
    assert plan_views(frames, choose_surface(frames, "planar")).frames == ()


@pytest.mark.parametrize("kind", ["equirectangular", "cylindrical", "pannini"])
def test_a_frame_across_the_seam_of_a_turn_covers_its_two_ends_and_no_more(kind: str) -> None:
    surface = choose_surface(TURN, kind, max_pixels=2e6)
    step = max(surface.width, surface.height) / 600
    shape = (int(np.ceil(surface.height / step)), int(np.ceil(surface.width / step)))
    y, x = np.mgrid[: shape[0], : shape[1]]
    rays = surface.pixel_to_ray((np.stack([x, y], axis=-1) + 0.5) * step)
    for frame in TURN:
        cells = np.zeros(shape, np.uint8)
        _draw_outline(cells, frame, surface, step)
        at = frame.ray_to_pixel(rays)
        with np.errstate(invalid="ignore"):
            true = (np.abs(at - frame.centre) <= frame.centre).all(axis=-1)
        # A cell's width along the outline, four where a seam is.
        assert (cells.astype(bool) != true).sum() <= 4 * 2 * (true.shape[0] + 40)
        assert true.sum() == 0 or (cells.astype(bool) & true).sum() > 0.8 * true.sum()


def test_a_full_turn_is_planned_on_every_surface_without_a_warning() -> None:
    for kind in ("equirectangular", "cylindrical", "pannini"):
        assert len(plan_views(TURN, choose_surface(TURN, kind)).frames) > 10  # warnings are failures
