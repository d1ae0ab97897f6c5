"""Frames out of a photograph: geometry against a photograph whose colours are its own directions."""

from __future__ import annotations

import numpy as np

from tests.synth.camera import SynthCamera, pixel_grid
from tests.synth.photographs import Photograph, paste


def _camera(**values: float) -> SynthCamera:
    given = {"f_px": 300.0, "cx_px": 159.5, "cy_px": 89.5} | values
    return SynthCamera(width=320, height=180, **given)


def test_each_pixel_shows_the_direction_that_the_camera_sees_there():
    height, width = 1024, 2048
    lon = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    lat = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[..., 0] = np.rint(127.5 + 100 * np.sin(lon))[None]
    rgb[..., 1] = np.rint(127.5 + 100 * np.sin(lat))[:, None]
    camera = _camera(pan_rad=0.4, tilt_rad=-0.2, roll_rad=0.1, k1_half=0.05)
    seen = Photograph(rgb=rgb).view(camera)
    rays = camera.pixel_to_ray(pixel_grid(320, 180))
    expected_lon = np.arctan2(rays[..., 0], rays[..., 2])
    # a level is .01 of longitude: half a level is 1.5 px of this camera, so look at the mean over many pixels
    off_x = (seen[..., 0] - 127.5) / 100 - np.sin(expected_lon)
    off_y = (seen[..., 1] - 127.5) / 100 + rays[..., 1]
    for off in (off_x, off_y):
        assert abs(off.mean()) * camera.f_px < 0.05
        assert np.abs(off).max() < 0.006


def test_a_photograph_says_how_long_a_focal_it_bears():
    assert Photograph(rgb=np.zeros((1000, 2000, 3), np.uint8)).px_per_rad * np.pi == 1000


def test_a_person_covers_what_is_behind_and_stands_on_his_feet():
    image = np.zeros((100, 120, 3), np.float32)
    person = (np.full((20, 10, 3), 200, np.float32), np.ones((20, 10), np.float32))
    paste(image, person, np.array([60.0, 80.0]), 40.0)
    rows, columns = np.nonzero(image[..., 0] > 100)
    assert (rows.min(), rows.max()) == (40, 79)
    assert columns.max() - columns.min() + 1 == 20
