"""Which views show the ground, once it is known what moves in them."""

import numpy as np

from mosaic.moving import shown_clear
from mosaic.surface import Surface
from mosaic.views import CompositeOptions, lattice_of, rate_views, share_views
from tests.mosaic.pinhole import Pinhole

SIZE_PX = (320, 180)
VIEWS = [Pinhole(frame=10 * k, size_px=SIZE_PX, f_px=400.0) for k in range(8)]
SURFACE = Surface(kind="planar", scale_px=400.0, cx=159.5, cy=89.5, width=320, height=180)
LATTICE = lattice_of(SURFACE)


def planes():
    """Half of the size; a body on the left third of all views but the fourth."""
    found = [np.full((90, 160), 255, np.uint8) for _ in VIEWS]
    for k, plane in enumerate(found):
        if k != 3:
            plane[:, :53] = 2
    return found


def test_a_view_is_clear_where_nothing_moves_about_the_point():
    clear = shown_clear(planes(), VIEWS, LATTICE, SURFACE).reshape(len(VIEWS), -1, len(LATTICE.x_px))
    left, right = LATTICE.x_px < 60, LATTICE.x_px > 150
    assert clear[3].min() > 0.99
    others = np.delete(clear, 3, axis=0)
    assert others[..., left].max() < 0.02 and others[..., right].min() > 0.99


def test_who_shows_the_ground_has_a_vote_beside_others():
    options = CompositeOptions(views=3)
    rating = rate_views(VIEWS, LATTICE, options)
    clear = shown_clear(planes(), VIEWS, LATTICE, SURFACE)
    blind = share_views(VIEWS, rating, LATTICE, SURFACE.scale_px, options)
    told = share_views(VIEWS, rating, LATTICE, SURFACE.scale_px, options, clear)
    inner = np.s_[1:-1, 1:2]  # of the left third, less the rim that no view counts at
    assert not blind[3][
        inner
    ].all()  # three far apart in time: the fourth of eight is none of them everywhere
    assert (told[3][inner] > 0).all()
    assert (told[blind > 0] > 0).all()  # nobody lost his
    assert np.array_equal(
        told[:, :, -3:], blind[:, :, -3:]
    )  # and where enough show the ground nothing is different
