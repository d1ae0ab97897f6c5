"""The lens's falloff from overlaps: found where it is, of the right size, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.moving import _levelled
from mosaic.surface import choose_surface
from mosaic.vignetting import corner, log_falloff, radius_squared
from tests.mosaic.pinhole import Pinhole, sweep
from tests.mosaic.scenes import clean_plate, composite_of, picture, psnr
from tests.mosaic.test_composite import with_squares

SIZE = (240, 136)
PAN = sweep((-9, 9), n=20, f_px=400.0, size_px=SIZE)


def shot(frames, corner_loss, seed=0, players=0):
    """Pictures with noise, every one with an exposure and a white balance of its own, and the gains."""
    gains = np.exp(np.random.default_rng(seed).normal(0, 0.05, (len(frames), 3)))
    pictures = [
        picture(p, gain=g, noise=1.5, seed=seed, corner_loss=corner_loss)
        for p, g in zip(frames, gains, strict=True)
    ]
    return [with_squares(p, rgb, players) for p, rgb in zip(frames, pictures, strict=True)], gains


def left_in_the_corner(panorama):
    """What the falloff leaves of the light in a corner."""
    return np.exp(log_falloff(panorama.falloff, corner(SIZE)))


def test_radius_is_in_half_widths_from_the_middle():
    np.testing.assert_allclose(radius_squared(np.array([[119.5, 67.5], [239.5, 67.5]]), SIZE), [0, 1])
    assert radius_squared(np.array([-0.5, -0.5]), SIZE) == pytest.approx(corner(SIZE))


def quality(folder, corner_loss):
    """The panorama of a pan through players, and its PSNR against the clean plate where nine views or more are."""
    surface = choose_surface(PAN, "cylindrical")
    pictures, gains = shot(PAN, corner_loss, players=3)
    panorama = composite_of(folder, PAN, surface, pictures)
    # One level for the whole picture is free: the gains' median is 1, whatever the frames' was.
    level = np.median(panorama.gains * gains[list(panorama.frames)], axis=0)
    return panorama, psnr(panorama.image, clean_plate(surface) * level, panorama.n_seen >= 9)


def test_a_falloff_of_20_percent_is_taken_out(tmp_path):
    panorama, with_falloff = quality(tmp_path, 0.2)
    share = np.linspace(0, 1, 11)  # of r^2 in the corner
    found = np.exp(log_falloff(panorama.falloff, share * corner(SIZE)))
    # 1 - .2 s is not an exponential: the nearest one is up to .013 off, in the corner, where few samples are.
    np.testing.assert_allclose(found, 1 - 0.2 * share, atol=0.02)
    _, without = quality(tmp_path, 0.0)
    assert with_falloff > 48 and with_falloff > without - 1  # 31.9 where it is left in


@pytest.mark.parametrize("seed", range(4))
def test_none_is_found_where_there_is_none(tmp_path, seed):
    pictures, _ = shot(PAN, 0.0, seed, players=3)
    panorama = composite_of(tmp_path, PAN, choose_surface(PAN, "cylindrical"), pictures, motion_rounds=0)
    assert not panorama.falloff.any()


def test_a_camera_that_stands_still_shows_none(tmp_path):
    still = sweep((0, 0), n=12, f_px=400.0, size_px=SIZE)
    pictures, _ = shot(still, 0.2)
    panorama = composite_of(tmp_path, still, choose_surface(still, "planar"), pictures, motion_rounds=0)
    assert not panorama.falloff.any()


def test_a_zoom_shows_it(tmp_path):
    zoom = [Pinhole(frame=k, f_px=400.0 * 1.05**k, size_px=SIZE) for k in range(20)]
    pictures, _ = shot(zoom, 0.2)
    panorama = composite_of(tmp_path, zoom, choose_surface(zoom, "planar"), pictures, motion_rounds=0)
    assert left_in_the_corner(panorama) == pytest.approx(0.8, abs=0.04)


def test_frames_are_levelled_for_the_search_of_what_moves():
    placement = Pinhole(size_px=SIZE)
    falloff = np.array([-0.15, -0.014])
    dark, bright = (picture(placement, corner_loss=loss) for loss in (0.2, 0.0))
    gain = np.ones(3, np.float32)
    assert np.abs(dark - bright.astype(float)).max() > 20
    assert np.abs(_levelled(dark, gain, falloff) - bright.astype(float)).max() <= 2
