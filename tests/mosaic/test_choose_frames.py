"""Which frames are stored for a panorama: enough views everywhere, and no heap of frames for strips at the border."""

from __future__ import annotations

import numpy as np

from mosaic.views import STRIP_VIEWS, choose_frames

N_FRAMES, N_SHARED, N_STRIPS, VIEWS = 200, 400, 90, 17


def _a_zoom_that_passes_by_strips() -> np.ndarray:
    """(n, p): 400 points that all frames see, and 90 that only 20 frames each see, as a zoom passes them by."""
    quality = np.zeros((N_FRAMES, N_SHARED + N_STRIPS), np.float32)
    quality[:, :N_SHARED] = 1.0
    for k in range(N_STRIPS):
        quality[2 * k : 2 * k + 20, N_SHARED + k] = 1.0
    return quality


def test_every_point_gets_its_views_where_frames_are_asked_for_strips_too():
    quality = _a_zoom_that_passes_by_strips()
    chosen, count = choose_frames(quality, np.arange(N_FRAMES, dtype=float), VIEWS, N_FRAMES)
    assert (count >= VIEWS).all()
    assert len(chosen) > 0.8 * N_FRAMES


def test_strips_get_a_view_per_moment_and_a_third_of_the_frames():
    quality = _a_zoom_that_passes_by_strips()
    time = np.arange(N_FRAMES, dtype=float)
    chosen, count = choose_frames(quality, time, VIEWS, N_FRAMES, strip=0.05, strip_gap=12.0)
    assert (count[:N_SHARED] >= VIEWS).all()
    assert (count[N_SHARED:] >= STRIP_VIEWS[0]).all()  # 20 frames are two moments or three
    assert len(chosen) < 0.35 * N_FRAMES


def test_what_many_points_want_is_no_strip():
    quality = _a_zoom_that_passes_by_strips()
    quality[:, N_SHARED:] = 0.0
    quality[100:120, N_SHARED:] = 1.0  # 90 points at once: more than a twentieth of a picture
    _, count = choose_frames(quality, np.arange(N_FRAMES, dtype=float), VIEWS, N_FRAMES, strip=0.05)
    assert (count >= VIEWS).all()
