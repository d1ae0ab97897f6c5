"""Cropping: the rectangle against brute force, and rays that stay where they were."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mosaic.cropping import crop_inside, largest_rectangle
from mosaic.surface import KINDS, choose_surface
from tests.mosaic.pinhole import sweep
from tests.mosaic.scenes import composite_of


def area_by_trying(cells):
    h, w = cells.shape
    return max(
        (
            (b - a) * (d - c)
            for a, b in itertools.combinations(range(h + 1), 2)
            for c, d in itertools.combinations(range(w + 1), 2)
            if cells[a:b, c:d].all()
        ),
        default=0,
    )


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8, 0.95, 1.0])
def test_no_rectangle_is_larger(share):
    rng = np.random.default_rng(3)
    for _ in range(10):
        cells = rng.random((7, 9)) < share
        top, left, rows, columns = largest_rectangle(cells)
        assert rows * columns == area_by_trying(cells)
        assert cells[top : top + rows, left : left + columns].all()


@pytest.mark.parametrize("kind", KINDS)
def test_cropped_picture_has_no_gap_and_keeps_its_rays(tmp_path, kind):
    frames = sweep((-8, 8), n=8, f_px=400.0, tilt_deg=3.0, roll_deg=4.0, size_px=(240, 136))
    whole = composite_of(tmp_path, frames, choose_surface(frames, kind))
    inside = crop_inside(whole)
    assert (whole.alpha == 0).any() and (inside.alpha > 0).all()
    assert inside.alpha.size > 0.5 * (whole.alpha > 0).sum()
    assert inside.image.shape[:2] == (inside.surface.height, inside.surface.width)
    xy = np.array([[10.0, 20.0], [100.0, 60.0]])
    at = whole.ray_to_pixel(inside.pixel_to_ray(xy))
    for (x, y), (u, v) in zip(xy.astype(int), np.rint(at).astype(int), strict=True):
        np.testing.assert_array_equal(inside.image[y, x], whole.image[v, u])
    np.testing.assert_allclose(at, np.rint(at), atol=1e-6)
    back = inside.pixel_to_frame(3, inside.frame_to_pixel(3, np.array([[120.0, 70.0]])))
    np.testing.assert_allclose(back, [[120.0, 70.0]], atol=1e-6)
