"""The trail of players: whole bodies at their places, nothing round them, what was cut off left out."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.composite import FrameStore, composite
from mosaic.surface import choose_surface
from mosaic.views import CompositeOptions
from pipelines.moments import choose_moments, trail
from tests.mosaic.pinhole import sweep
from tests.mosaic.scenes import picture, plan_of

SIDE, WHITE = 30, 250


def test_moments_are_the_nearest_stored_frames():
    stored = [3, 10, 22, 40, 61]
    assert choose_moments(stored, 3) == (3, 40, 61)
    assert choose_moments(stored, 9, [12, 60, 59]) == (10, 61)
    assert choose_moments([], 4) == ()


@pytest.fixture
def scene(tmp_path):
    """Ten views of a pan; a white square walks across them, and in one a black one is cut off by the border."""
    frames = sweep((-6, 6), n=10, f_px=400.0, size_px=(320, 180))
    surface = choose_surface(frames, "cylindrical")
    places = {}
    with FrameStore(tmp_path, (320, 180)) as store:
        for i, placement in enumerate(frames):
            rgb = picture(placement, height=15.0, gain=0.8 if i == 7 else 1.0)
            x, y = 60 + 20 * i, 70
            rgb[y : y + SIDE, x : x + SIDE] = WHITE if i != 7 else int(0.8 * WHITE)
            if i == 4:
                rgb[120:150, :25] = 5
            places[placement.frame] = (x, y)
            store.put(placement.frame, rgb)
        panorama = composite(
            plan_of(frames), store, frames, surface, CompositeOptions(tile_px=128), scratch=tmp_path
        )
        yield panorama, store, places, tmp_path


def test_bodies_of_the_moments_stand_whole_and_without_a_halo(scene):
    panorama, store, places, folder = scene
    frames = sorted(places)
    moments = (frames[1], frames[4], frames[7])
    made = trail(panorama, store, moments, str(folder))
    assert made.frames == moments
    touched = np.zeros(panorama.alpha.shape, bool)
    for frame in moments:
        x, y = places[frame]
        corners = np.array(
            [[x, y], [x + SIDE - 1, y], [x + SIDE - 1, y + SIDE - 1], [x, y + SIDE - 1]], float
        )
        at = panorama.frame_to_pixel(frame, corners)
        (left, top), (right, bottom) = (
            np.ceil(at.min(axis=0)).astype(int),
            np.floor(at.max(axis=0)).astype(int),
        )
        inside = made.image[top + 2 : bottom - 1, left + 2 : right - 1]
        np.testing.assert_allclose(inside, WHITE, atol=8)  # the darker frame in the light of the others
        touched[top - 4 : bottom + 5, left - 4 : right + 5] = True
    rest = ~touched & (panorama.alpha > 0)
    np.testing.assert_array_equal(
        made.image[rest], panorama.image[rest]
    )  # and no black square, which was cut off
    plain = panorama.image[touched].max()
    assert plain < 235  # the plate itself has nobody there


def test_no_rim_of_ground_in_another_light_goes_with_a_body(scene):
    panorama, store, places, folder = scene
    frame = sorted(places)[7]
    made = trail(panorama, store, (frame,), str(folder))
    changed = np.abs(made.image.astype(int) - panorama.image).max(axis=-1) > 6
    rows, columns = np.nonzero(changed)
    assert np.ptp(rows) + 1 <= SIDE + 5 and np.ptp(columns) + 1 <= SIDE + 5
