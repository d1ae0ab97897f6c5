"""Frames for a panorama, chosen by what small pictures of some of them show of the ground."""

import cv2
import numpy as np
import pytest

from mosaic.framestore import FrameStore
from mosaic.glances import shown_ground
from mosaic.surface import choose_surface
from mosaic.views import BODY_SHARE, CompositeOptions, ShownGround, plan_views, show_rest
from tests.mosaic.pinhole import Pinhole
from tests.mosaic.scenes import picture

SIZE_PX, SMALL_PX = (640, 360), (160, 90)
# There and back again, by a percent of the picture.
VIEWS = [
    Pinhole(frame=4 * k, size_px=SIZE_PX, f_px=700.0, pan_deg=float(0.5 * np.sin(k / 6))) for k in range(40)
]
SURFACE = choose_surface(VIEWS)
BODY_PX = (28, 80)  # half of its width, and its height, in the frame


def shown(clear, frames=None, vote=None, cells_seen=100.0):
    """Of cells (n, p), ten frames apart unless told."""
    n = len(clear)
    return ShownGround(
        frames=10 * np.arange(n) if frames is None else np.array(frames), clear=np.array(clear, bool),
        vote=np.ones(n, np.float32) if vote is None else np.array(vote, np.float32), cells_seen=cells_seen,
    )  # fmt: skip


def test_what_the_chosen_hide_is_taken_from_who_shows_it():
    clear = np.ones((8, 50), bool)
    clear[:, :20] = False
    clear[5, :20] = True  # there only this one shows the ground
    assert show_rest(shown(clear), [0, 20, 40], 3, 10) == [50]
    assert show_rest(shown(clear), [0, 20, 50], 3, 10) == []


def test_nothing_is_added_for_less_than_a_body():
    clear = np.ones((8, 50), bool)
    clear[:, :20] = False
    clear[5, :20] = True
    assert show_rest(shown(clear, cells_seen=0.99 * 20 / BODY_SHARE), [0, 20, 40], 3, 10) == [50]
    assert show_rest(shown(clear, cells_seen=1.01 * 20 / BODY_SHARE), [0, 20, 40], 3, 10) == []


def test_views_of_one_moment_are_one():
    """Ten frames in a row show what the chosen one does not, the last of all as well, 40 frames later."""
    clear = np.zeros((12, 50), bool)
    clear[1:] = True
    frames = [0, *range(20, 30), 70]
    added = show_rest(shown(clear, frames), [0], 2, 12)
    assert len(added) == 2
    assert abs(added[0] - added[1]) >= 6


def test_blurred_views_come_after_sharp_ones_and_useless_ones_never():
    clear = np.ones((4, 50), bool)
    clear[0] = False
    assert show_rest(shown(clear, vote=[1, 0.5, 1, 0]), [0], 1, 10) == [20]
    clear[2] = False
    assert show_rest(shown(clear, vote=[1, 0.5, 1, 0]), [0], 2, 10) == [10]


def test_no_more_than_the_limit():
    clear = np.eye(30, dtype=bool).repeat(20, axis=1)  # each shows a place of its own
    assert len(show_rest(shown(clear), [0], 3, 7)) == 7


def body_at(k):
    """Pan in degrees of a body that stays for most of the clip, and then leaves: in view all the time."""
    return 0.5 if k < 30 else 0.5 + 4.0 * (k - 29) / 5


def small_pictures(folder, store):
    """Glances of the world with the body, and where it truly covers the small picture (n, h, w)."""
    covered = []
    for k, view in enumerate(VIEWS):
        rgb = picture(view, fine=20.0, noise=2.0)
        ray = [np.sin(np.radians(body_at(k))), 0.0, np.cos(np.radians(body_at(k)))]
        x, y = view.ray_to_pixel(np.array(ray))
        mask = np.zeros(SIZE_PX[::-1], np.uint8)
        left, top = round(x) - BODY_PX[0], round(y) - 20
        cv2.rectangle(mask, (left, top), (left + 2 * BODY_PX[0], top + BODY_PX[1]), 1, -1)
        rgb[mask > 0] = (20, 20, 20)
        gray = cv2.cvtColor(cv2.resize(rgb, SMALL_PX, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        store.put(view.frame, cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB))
        covered.append(mask)
    return np.array(covered)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    folder = tmp_path_factory.mktemp("glances")
    with FrameStore(folder, SMALL_PX) as store:
        covered = small_pictures(folder, store)
        found = shown_ground(store, VIEWS, SURFACE, CompositeOptions())
    assert found is not None
    return found, covered


def cells_of(found):
    """Centres of the cells on the surface, px: twice the small pictures' pixel."""
    side = 2 * SIZE_PX[0] / SMALL_PX[0]
    n_columns = int(np.ceil(np.ceil(SURFACE.width * SMALL_PX[0] / SIZE_PX[0]) / 2))
    n_rows = found.clear.shape[1] // n_columns
    xy = np.stack(np.meshgrid(np.arange(n_columns), np.arange(n_rows)), axis=-1).reshape(-1, 2)
    return (xy + 0.5) * side - 0.5


def test_small_gray_pictures_say_where_a_body_stands(told):
    found, covered = told
    rays = SURFACE.pixel_to_ray(cells_of(found))
    n_right, n_body, n_free = 0, 0, 0
    for row, view in enumerate(VIEWS):
        at = np.nan_to_num(view.ray_to_pixel(rays), nan=-1.0)
        inner = ((at > 12) & (at < np.array(SIZE_PX) - 13)).all(axis=-1)
        x, y = np.rint(at[inner]).astype(int).T
        hidden = covered[row][y, x] > 0
        clear = found.clear[row][inner]
        n_body += hidden.sum()
        n_right += (hidden & ~clear).sum()
        # His own size about him is nobody's: what is before a crowd is not seen for certain (moving.NEAR).
        far = cv2.dilate(covered[row], np.ones((201, 201), np.uint8))[y, x] == 0
        n_free += clear[far].sum() / max(far.sum(), 1)
    # He stands before a place for three quarters of the time: a median alone would call him the ground there.
    assert n_right > 0.9 * n_body
    assert n_free > 0.98 * len(VIEWS)


def test_the_plan_takes_the_frames_in_which_the_body_has_left(told):
    found, covered = told
    # The frames that are known to show the ground at last are blurred a little: they are nobody's first choice.
    views = [
        Pinhole(frame=v.frame, size_px=SIZE_PX, f_px=700.0, pan_deg=v.pan_deg, blur_px=0.0 if k < 32 else 3.0)
        for k, v in enumerate(VIEWS)
    ]

    def n_clear(frames):
        """Views of the place where he stood, by the truth."""
        ray = np.array([np.sin(np.radians(0.5)), 0.02, np.cos(np.radians(0.5))])
        at = [np.rint(views[f // 4].ray_to_pixel(ray)).astype(int) for f in frames]
        return sum(
            bool(((a > 3) & (a < np.array(SIZE_PX) - 4)).all() and covered[f // 4][a[1], a[0]] == 0)
            for f, a in zip(frames, at, strict=True)
        )

    blind = plan_views(views, SURFACE)
    knowing = plan_views(views, SURFACE, shown=found)
    n_moments = n_clear([v.frame for v in views[::2]])  # eight frames apart: six at least are a moment
    assert n_clear(blind.frames) == 0
    assert n_clear(knowing.frames) >= n_moments
    assert len(knowing.frames) <= len(blind.frames)


def test_of_pictures_that_see_nothing_nothing_is_known(tmp_path):
    away = [Pinhole(frame=k, size_px=SIZE_PX, f_px=700.0, pan_deg=170.0) for k in range(3)]
    with FrameStore(tmp_path, SMALL_PX) as store:
        for view in away:
            store.put(view.frame, np.full((*SMALL_PX[::-1], 3), 99, np.uint8))
        assert shown_ground(store, away, SURFACE, CompositeOptions()) is None
        assert shown_ground(store, VIEWS[5:], SURFACE, CompositeOptions()) is None  # none of these is stored
