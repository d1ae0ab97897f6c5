"""The composite against a world that is a formula: position, players, exposure, masks, memory, the plan."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mosaic.composite import Canvas, CompositeOptions, FrameStore, composite, plan_views
from mosaic.moving import NEAR, _near_bodies
from mosaic.surface import choose_surface
from tests.mosaic.pinhole import Pinhole, sweep
from tests.mosaic.scenes import clean_plate, composite_of, picture, plan_of, psnr, world_colour


def shift_px(image, truth, where):
    """Sub-pixel shift (x, y) of an image against the truth: least squares on the truth's gradient."""
    gy, gx = np.gradient(truth, axis=(0, 1))
    design = np.stack([gx[where].ravel(), gy[where].ravel(), np.ones(gx[where].size)], axis=1)
    return -np.linalg.lstsq(design, (image - truth)[where].ravel(), rcond=None)[0][:2]


@pytest.mark.parametrize("kind", ["equirectangular", "cylindrical", "planar"])
@pytest.mark.parametrize("cubic", [True, False])
def test_the_panorama_lies_where_its_rays_say(tmp_path, kind, cubic):
    frames = sweep((-9, 9), n=8, f_px=400.0, tilt_deg=3.0, roll_deg=2.0, k1=0.06, size_px=(240, 136))
    surface = choose_surface(frames, kind)
    panorama = composite_of(tmp_path, frames, surface, cubic=cubic)
    seen = panorama.n_seen >= 3
    assert seen.mean() > 0.5
    truth = clean_plate(surface)
    assert np.abs(shift_px(panorama.image, truth, seen)).max() < 0.01
    # Linear sampling blurs the finest waves (42 px long) a little; cubic leaves rounding.
    assert psnr(panorama.image, truth, seen) > (48 if cubic else 44)


def test_a_view_shifted_by_a_pixel_would_be_found(tmp_path):
    frames = sweep((-9, 9), n=8, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    pictures = [np.roll(picture(p), 1, axis=1) for p in frames]
    panorama = composite_of(tmp_path, frames, surface, pictures)
    assert shift_px(panorama.image, clean_plate(surface), panorama.n_seen >= 3)[0] == pytest.approx(
        1, abs=0.1
    )


def test_finer_frames_than_the_panorama_are_averaged_in_place(tmp_path):
    frames = sweep((-5, 5), n=6, f_px=1200.0, size_px=(480, 272))
    surface = choose_surface(frames, "cylindrical", px_per_rad=400.0)
    panorama = composite_of(tmp_path, frames, surface)
    seen = panorama.n_seen >= 3
    assert np.abs(shift_px(panorama.image, clean_plate(surface), seen)).max() < 0.01
    fine = [
        picture(p, fine=2400.0) for p in frames
    ]  # waves of 3 frame px, 1 panorama px: only their mean is left
    waves = composite_of(tmp_path, frames, surface, fine).image.astype(float)
    smooth = composite_of(tmp_path, frames, surface, [picture(p, height=0.0) for p in frames]).image
    assert np.std((waves - smooth)[seen]) < 4  # 22 where every third pixel is taken


def with_squares(placement, rgb, n=3, side=24, seed=5):
    """Squares that run through the picture: cover about a tenth of it, each at its own speed."""
    out, rng = rgb.copy(), np.random.default_rng(seed)
    height, width = rgb.shape[:2]
    for _ in range(n):
        x, y, speed, colour = (
            rng.integers(width),
            rng.integers(height - side),
            rng.uniform(4, 9),
            rng.integers(0, 256, 3),
        )
        left = int(x + speed * placement.frame) % width
        out[y : y + side, left : left + side] = colour
    return out


def test_players_leave_no_trace(tmp_path):
    frames = sweep((-9, 9), n=36, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    pictures = [with_squares(p, picture(p, noise=2.0)) for p in frames]
    panorama = composite_of(tmp_path, frames, surface, pictures)
    many = panorama.n_seen >= 9
    truth = clean_plate(surface)
    error = np.abs(panorama.image - truth).max(axis=-1)[many]
    assert psnr(panorama.image, truth, many) > 40
    assert np.quantile(error, 0.999) < 12 and (error > 40).sum() == 0


def test_where_all_views_agree_few_are_sampled_and_nothing_else_changes(tmp_path):
    frames = sweep((-3, 3), n=30, f_px=400.0, size_px=(320, 180))
    surface = choose_surface(frames, "planar")
    pictures = []
    for p in frames:
        rgb = picture(p, noise=2.0)
        x, y = np.rint(p.ray_to_pixel(np.array([-0.3 + 0.02 * p.frame, 0.0, 1.0]))).astype(int)
        rgb[y - 12 : y + 12, max(x - 6, 0) : max(x + 6, 0)] = 255
        pictures.append(rgb)
    few = composite_of(tmp_path, frames, surface, pictures, quiet_views=5)
    full = composite_of(tmp_path, frames, surface, pictures, quiet_views=200)  # no place has so many
    looked_into = full.n_seen >= 15
    assert np.median(full.n_seen[looked_into]) > 2.5 * np.median(few.n_seen[looked_into])
    truth = clean_plate(surface)
    assert psnr(few.image, truth, looked_into) > 40
    error = np.abs(few.image - truth).max(axis=-1)
    assert (error[looked_into] > 40).sum() == 0
    assert ((few.n_seen > 0) == (full.n_seen > 0)).all()


def test_a_standing_player_is_removed_where_trust_says_so(tmp_path):
    frames = sweep((-1, 1), n=15, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "planar")
    pictures, trusts = [], []
    for placement in frames:
        rgb, trust = picture(placement), np.ones((136, 240), np.float32)
        if placement.frame < 11:  # 11 of 15 views show him, standing on the ground
            x, y = np.rint(placement.ray_to_pixel(np.array([0.0, 0.0, 1.0]))).astype(int)
            rgb[y - 10 : y + 10, x - 5 : x + 5] = 255
            trust[y - 12 : y + 12, x - 7 : x + 7] = 0.05
        pictures.append(rgb)
        trusts.append(trust)
    truth = clean_plate(surface)
    x, y = np.rint(surface.ray_to_pixel([0.0, 0.0, 1.0])).astype(int)
    where = np.s_[y - 8 : y + 8, x - 4 : x + 4]
    without = composite_of(tmp_path, frames, surface, pictures).image[where] - truth[where]
    trusted = composite_of(tmp_path, frames, surface, pictures, trusts=trusts).image[where] - truth[where]
    assert np.abs(without).mean() > 60  # nothing but the trust says that he is not the ground
    assert np.abs(trusted).mean() < 3


def test_slow_players_are_found_by_what_sticks_out(tmp_path):
    frames = sweep((-2, 2), n=17, f_px=400.0, size_px=(320, 180))
    surface = choose_surface(frames, "planar")
    pictures = []
    for placement in frames:  # 52 px wide, 6.4 px a view: the middle is covered in 8 of 17 views
        rgb = picture(placement)
        at = placement.ray_to_pixel(np.array([0.016 * (placement.frame - 8), 0.0, 1.0]))
        x, y = np.rint(at).astype(int)
        rgb[y - 40 : y + 40, x - 26 : x + 26] = [230, 30, 30]
        pictures.append(rgb)
    truth = clean_plate(surface)
    seen = np.zeros(truth.shape[:2], bool)
    x, y = np.rint(surface.ray_to_pixel([0.0, 0.0, 1.0])).astype(int)
    seen[y - 36 : y + 36, x - 60 : x + 60] = True
    without = composite_of(tmp_path, frames, surface, pictures, motion_rounds=0)
    plain = np.abs(without.image - truth).max(axis=-1)[seen] > 40
    found = composite_of(tmp_path, frames, surface, pictures, motion_rounds=3)
    left = np.abs(found.image - truth).max(axis=-1)[seen] > 40
    assert plain.mean() > 0.02 and left.mean() < 0.002
    away = (found.alpha > 0) & ~seen
    assert psnr(found.image, truth, away) > 38


def test_above_legs_that_move_the_view_counts_less_as_high_again_as_they_are():
    found = np.zeros((90, 160), np.uint8)
    found[50:70, 80:90] = 1  # legs
    found[5:7, 5:7] = 1  # a speck is nobody
    plane = _near_bodies(found)
    assert (plane[30:76, 74:96] == NEAR).all()
    assert (plane == NEAR).sum() == 46 * 22 and set(np.unique(plane)) == {NEAR, 255}


def test_exposure_and_white_balance_are_levelled(tmp_path):
    frames = sweep((-12, 12), n=24, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    gains = np.exp(np.random.default_rng(8).normal(0, 0.08, (24, 3)))
    pictures = [picture(p, gain=g, noise=1.5) for p, g in zip(frames, gains, strict=True)]
    panorama = composite_of(tmp_path, frames, surface, pictures)
    left = panorama.gains * gains[list(panorama.frames)]
    assert np.std(np.log(left), axis=0).max() < 0.005
    truth = clean_plate(surface) * np.median(left, axis=0)
    assert psnr(panorama.image, truth, panorama.n_seen >= 3) > 44
    flat = composite_of(tmp_path, frames, surface, pictures, gains=False)
    assert psnr(flat.image, truth, panorama.n_seen >= 3) < 38


def test_a_scoreboard_is_masked_with_its_smear(tmp_path):
    frames = sweep((-3, 3), n=9, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "planar")
    mask = np.ones((136, 240), bool)
    mask[10:50, 10:110] = False
    pictures = [picture(p) for p in frames]
    for rgb in pictures:
        rgb[8:52, 8:112] = 255  # two pixels wider than its mask
    panorama = composite_of(tmp_path, frames, surface, pictures, masks=[mask] * 9)
    assert psnr(panorama.image, clean_plate(surface), panorama.alpha > 0) > 38
    hidden = surface.ray_to_pixel(frames[0].pixel_to_ray(np.array([[90.0, 30.0]])))[0].astype(int)
    assert panorama.alpha[hidden[1], hidden[0]] == 0 and not panorama.image[hidden[1], hidden[0]].any()


def test_no_frame_edge_shows_where_the_camera_model_is_a_little_wrong(tmp_path):
    frames = sweep((-9, 9), n=20, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    x = (np.arange(240) - 119.5) / 120
    shading = (1 + 0.08 * x**2)[None, :, None]  # 8 % brighter at the sides: no gain, no lens
    flat = [np.rint(np.full((136, 240, 3), 160.0) * shading).astype(np.uint8) for _ in frames]
    panorama = composite_of(tmp_path, frames, surface, flat)
    row = panorama.image[surface.height // 2].astype(float).mean(axis=-1)
    inner = row[8:-8]
    assert np.abs(np.diff(inner)).max() <= 1.5 and np.ptp(inner) > 2


def test_alpha_counts_and_methods_agree(tmp_path):
    frames = [Pinhole(frame=3, pan_deg=-8), Pinhole(frame=7, pan_deg=0), Pinhole(frame=9, pan_deg=8)]
    surface = choose_surface(frames, "cylindrical")
    panorama = composite_of(tmp_path, frames, surface)
    assert panorama.frames == (3, 7, 9)
    assert ((panorama.alpha == 255) == (panorama.n_seen > 0)).all()
    xy = np.stack(np.meshgrid(np.arange(surface.width), np.arange(surface.height)), axis=-1)
    count = np.zeros(xy.shape[:2], int)
    for k in panorama.frames:
        at = panorama.pixel_to_frame(k, xy)
        count += ((at >= 3.0) & (at <= [319 - 3.0, 179 - 3.0])).all(axis=-1)
        inside = np.array([[20.0, 30.0], [300.25, 170.5]])
        np.testing.assert_allclose(
            panorama.pixel_to_frame(k, panorama.frame_to_pixel(k, inside)), inside, atol=1e-6
        )
    assert np.mean(count == panorama.n_seen) > 0.995  # the rest: interpolation of the map at the very border
    np.testing.assert_allclose(
        panorama.ray_to_pixel(panorama.pixel_to_ray([[50.0, 60.0]])), [[50, 60]], atol=1e-9
    )


def test_same_input_same_bytes_whatever_the_threads_and_the_memory(tmp_path):
    frames = sweep((-9, 9), n=10, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    first = composite_of(tmp_path, frames, surface, threads=1)
    again = composite_of(tmp_path, frames, surface, threads=3, memory_bytes=0)
    for name in ("image", "alpha", "n_seen", "spread"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not list(tmp_path.iterdir())  # neither the store nor the canvas leaves a file


def deep_picture(placement):
    """What the placement sees, uint16 RGB (h, w, 3): grey levels times 257, finer than 8 bits."""
    xy = np.stack(np.meshgrid(*(np.arange(n) for n in placement.size_px)), axis=-1).astype(float)
    return np.clip(np.rint(world_colour(placement.pixel_to_ray(xy), 20.0) * 257), 0, 65535).astype(np.uint16)


@pytest.mark.parametrize("px_per_rad", [400.0, 190.0])
def test_more_than_8_bits_come_out_as_they_went_in(tmp_path, px_per_rad):
    frames = sweep((-9, 9), n=8, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical", px_per_rad=px_per_rad)
    panorama = composite_of(tmp_path, frames, surface, [deep_picture(p) for p in frames], gains=False)
    seen, truth = panorama.n_seen >= 3, clean_plate(surface, 20.0)
    error = panorama.deep[seen] / 257 - truth[seen]
    assert np.sqrt(np.mean(error**2)) < 0.1  # 8 bits alone: 0.29
    assert np.abs(panorama.deep[seen] / 257 - panorama.image[seen]).max() <= 1.01
    assert (panorama.deep[panorama.alpha == 0] == 0).all()
    assert composite_of(tmp_path, frames, surface, gains=False).deep is None


def test_a_store_of_16_bits_gives_8_where_these_are_asked_for(tmp_path):
    deep = np.random.default_rng(3).integers(0, 65536, (64, 96, 3)).astype(np.uint16)
    with FrameStore(tmp_path, (96, 64)) as store:
        store.put(1, deep)
        assert store.deep
        np.testing.assert_array_equal(store.get(1, deep=True).rgb, deep)
        np.testing.assert_array_equal(store.get(1).rgb, np.rint(deep / 257).astype(np.uint8))
        np.testing.assert_array_equal(store.rows(1, 20, 41, np.empty(deep.size, np.uint16)), deep[20:41])
        half = deep.reshape(32, 2, 48, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(store.get(1, 2, deep=True).rgb, half, atol=0.51)
        np.testing.assert_allclose(store.get(1, 2).rgb, half / 257, atol=0.51)
        with pytest.raises(ValueError, match="uint16"):
            store.put(2, deep.astype(np.uint8))


def test_tiles_do_not_show(tmp_path):
    frames = sweep((-9, 9), n=12, f_px=400.0, size_px=(240, 136))
    surface = choose_surface(frames, "cylindrical")
    pictures = [picture(p, noise=2.0) for p in frames]
    small = composite_of(tmp_path, frames, surface, pictures, tile_px=64).image.astype(float)
    large = composite_of(tmp_path, frames, surface, pictures, tile_px=512).image.astype(float)
    assert np.abs(small - large).mean() < 0.1


def test_zoomed_in_detail_is_kept(tmp_path):
    wide = sweep((-9, 9), n=30, f_px=300.0, size_px=(240, 136))
    close = [Pinhole(frame=100 + 6 * k, f_px=900.0, size_px=(240, 136), pan_deg=0.05 * k) for k in range(20)]
    frames = [*wide, *close]
    surface = choose_surface(frames, "cylindrical")
    assert surface.scale_px == pytest.approx(900.0, rel=1e-3)
    pictures = [
        picture(p, fine=500.0) for p in frames
    ]  # waves of 11 px in the close views, 3.8 in the wide ones
    panorama = composite_of(tmp_path, frames, surface, pictures)
    middle = np.zeros(panorama.alpha.shape, bool)
    y, x = surface.height // 2, int(surface.ray_to_pixel(close[10].pixel_to_ray(np.array([119.5, 67.5])))[0])
    middle[y - 40 : y + 40, x - 80 : x + 80] = True
    truth = clean_plate(surface, fine=500.0)
    contrast = np.std(panorama.image[middle].astype(float)) / np.std(truth[middle])
    assert contrast > 0.95 and psnr(panorama.image, truth, middle) > 32


# --- the plan ------------------------------------------------------------------------------------------------------


def test_plan_gives_every_point_its_views_spread_over_time():
    frames = sweep((-15, 15), n=600, f_px=400.0)
    plan = plan_views(frames, choose_surface(frames))
    assert plan.n_candidates == 600 and len(plan.frames) < 120
    assert np.median(plan.n_views) >= 17
    gaps = np.diff(plan.frames)
    assert gaps.max() < 45  # evenly over the pan


def test_plan_does_not_grow_with_the_clip():
    sizes = []
    for n in (150, 1500, 6000):
        path = [Pinhole(frame=k, f_px=400.0, pan_deg=12 * np.sin(k / n * 40)) for k in range(n)]
        plan = plan_views(path, choose_surface(path))
        assert len(plan.frames) <= plan.limit
        sizes.append(len(plan.frames))
    assert max(sizes) < 1.5 * min(sizes)
    assert plan.bytes_needed((320, 180)) == sizes[-1] * 320 * 180 * 3


def test_a_still_camera_keeps_k_frames_far_apart():
    frames = [Pinhole(frame=k) for k in range(500)]
    plan = plan_views(frames, choose_surface(frames), CompositeOptions(views=9))
    assert len(plan.frames) == 9 and np.diff(plan.frames).min() > 20


def test_plan_prefers_sharp_frames_to_blurred_and_coarse_ones():
    sharp = [Pinhole(frame=2 * k, f_px=800.0, pan_deg=0.1 * np.sin(k)) for k in range(100)]
    blurred = [Pinhole(frame=2 * k + 1, f_px=800.0, blur_px=4.0) for k in range(100)]
    coarse = [Pinhole(frame=1000 + k, f_px=500.0) for k in range(100)]
    frames = [*sharp, *blurred, *coarse]
    plan = plan_views(frames, choose_surface(frames, "planar"))
    assert sum(k % 2 == 0 and k < 1000 for k in plan.frames) >= 15
    assert not any(k % 2 == 1 and k < 1000 for k in plan.frames if k not in range(0, 1000, 2))


def test_a_moment_of_zoom_does_not_leave_a_point_with_one_moments_views():
    wide = [Pinhole(frame=10 * k, f_px=400.0) for k in range(60)]
    close = [Pinhole(frame=601 + k, f_px=900.0) for k in range(20)]  # under a second: a player has not moved
    frames = [*wide, *close]
    plan = plan_views(frames, choose_surface(frames, "planar"))
    assert sum(k >= 601 for k in plan.frames) >= 3 and sum(k < 600 for k in plan.frames) >= 10


# --- the store -----------------------------------------------------------------------------------------------------


def test_store_gives_back_what_it_was_given_and_keeps_its_budget(tmp_path):
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (12, 64, 96, 3), dtype=np.uint8)
    mask = rng.random((64, 96)) > 0.001
    with FrameStore(tmp_path, (96, 64), cache_bytes=3 * 96 * 64 * 3) as store:
        for k, rgb in enumerate(pictures):
            store.put(10 * k, rgb, mask if k % 2 else None)
        for k in (*range(12), 0, 11, 3):
            stored = store.get(10 * k)
            np.testing.assert_array_equal(stored.rgb, pictures[k])
            assert (stored.trust is None) == (k % 2 == 0)
            assert store._cached_bytes <= store.cache_bytes
        assert store.frames == tuple(range(0, 120, 10)) and 30 in store and 31 not in store
        assert store.bytes_on_disk == 12 * 96 * 64 * 3 + 96 * 64  # one mask, kept once
        assert ((store.get(10).trust == 0) >= ~mask).all() and (store.get(10).trust == 0).sum() > 5 * (
            ~mask
        ).sum()
        part = store.rows(10, 20, 41, np.empty(96 * 64 * 3, np.uint8))
        assert (part == store.get(10).rgb[20:41]).all()
        half = store.get(0, shrink=2)
        mean = pictures[0].reshape(32, 2, 48, 2, 3).mean(axis=(1, 3))
        assert half.shrink == 2 and np.abs(half.rgb - mean).max() <= 0.5
    assert not list(tmp_path.iterdir())


def test_a_picture_in_hand_is_not_overwritten_by_later_reads(tmp_path):
    with FrameStore(tmp_path, (96, 64), cache_bytes=1) as store:
        for k in range(20):
            store.put(k, np.full((64, 96, 3), k, np.uint8))
        held = [store.get(k) for k in range(0, 20, 4)]
        views = [store.get(k).rgb[3:5] for k in range(1, 20, 4)]
        for k in range(20):
            assert (store.get(k).rgb == k).all()
        assert [int(h.rgb.max()) for h in held] == [0, 4, 8, 12, 16]
        assert [int(v.max()) for v in views] == [1, 5, 9, 13, 17]


@pytest.mark.parametrize("side", [2, 4, 3])
def test_smaller_pictures_come_from_the_one_that_was_given(tmp_path, side):
    rng = np.random.default_rng(1)
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (100, 200, 3), dtype=np.uint8), (0, 0), 2)
    small = cv2.resize(
        smooth[: 100 // side * side, : 200 // side * side],
        (200 // side, 100 // side),
        interpolation=cv2.INTER_AREA,
    )
    with FrameStore(tmp_path, (200, 100)) as store:
        store.put(0, smooth)
        store.put(1, smooth, small=small)
        for shrink in (2, 4, 6, 8):
            plain, made = (store.get(k, shrink).rgb.astype(int) for k in (0, 1))
            assert plain.shape == made.shape and np.abs(plain - made).max() <= (3 if shrink % side else 1)
        coarse = [store.coarse(k)[0].astype(int) for k in (0, 1)]
        assert np.abs(coarse[0] - coarse[1]).max() <= 1
        store.put(2, smooth, small=255 - small)
        assert np.abs(store.get(2, 4 * side).rgb.astype(int) - store.get(0, 4 * side).rgb).max() > 10


def test_store_refuses_what_does_not_fit(tmp_path):
    with FrameStore(tmp_path, (96, 64)) as store:
        good = np.zeros((64, 96, 3), np.uint8)
        store.put(1, good)
        with pytest.raises(ValueError, match="stored already"):
            store.put(1, good)
        with pytest.raises(ValueError, match="float64"):
            store.put(2, good.astype(float))
        with pytest.raises(ValueError, match="mask"):
            store.put(2, good, np.ones((96, 64), bool))
        with pytest.raises(ValueError, match="trust"):
            store.put(2, good, None, np.ones((3, 3)))
        with pytest.raises(ValueError, match="small"):
            store.put(2, good, small=np.zeros((32, 40, 3), np.uint8))
        with pytest.raises(KeyError):
            store.get(2)


def test_lost_and_missing_frames_are_left_out_and_none_at_all_is_refused(tmp_path):
    frames = sweep((-5, 5), n=5)
    surface = choose_surface(frames)
    with FrameStore(tmp_path, (320, 180)) as store:
        for p in frames[:4]:
            store.put(p.frame, picture(p))
        panorama = composite(
            plan_of(frames), store, frames[1:], surface
        )  # 0 lost its placement, 4 was not stored
        assert panorama.frames == (1, 2, 3)
        with pytest.raises(ValueError, match="no stored frame"):
            composite(plan_of(frames), store, frames[4:], surface)


def test_progress_rises_to_one(tmp_path):
    frames = sweep((-5, 5), n=3)
    seen: list[float] = []
    with FrameStore(tmp_path, (320, 180)) as store:
        for p in frames:
            store.put(p.frame, picture(p))
        composite(
            plan_of(frames),
            store,
            frames,
            choose_surface(frames),
            CompositeOptions(tile_px=128),
            progress=seen.append,
        )
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) > 3


def test_canvas_beyond_its_budget_is_a_file_that_keeps_its_data(tmp_path):
    canvas = Canvas(tmp_path, memory_bytes=1000)
    small, large = canvas.zeros((10, 10)), canvas.zeros((300, 400, 3))
    large[7:9, :, 1], small[3] = 9, 4
    canvas.release()
    assert large[8, 5, 1] == 9 and large.sum() == 9 * 800 and small.sum() == 40


def test_one_long_look_does_not_outvote_three_short_ones(tmp_path):
    # A player stands still while the camera rests on him for 75 frames; later it passes the place three times.
    rest = [Pinhole(frame=3 * k, size_px=(240, 136), pan_deg=0.02 * k) for k in range(25)]
    passes = [
        Pinhole(frame=400 * i + k, size_px=(240, 136), pan_deg=2.0 * k) for i in (1, 2, 3) for k in (-1, 1)
    ]
    frames = [*rest, *passes]
    surface = choose_surface(frames, "cylindrical")
    pictures = [picture(p) for p in frames]
    for placement, rgb in zip(rest, pictures, strict=False):
        x, y = np.rint(placement.ray_to_pixel(np.array([0.0, 0.0, 1.0]))).astype(int)
        rgb[y - 10 : y + 10, x - 5 : x + 5] = 255
    panorama = composite_of(tmp_path, frames, surface, pictures)
    x, y = np.rint(surface.ray_to_pixel([0.0, 0.0, 1.0])).astype(int)
    where = np.s_[y - 8 : y + 8, x - 4 : x + 4]
    assert panorama.n_seen[where].min() >= 17
    assert np.abs(panorama.image[where] - clean_plate(surface)[where]).mean() < 3


def test_every_pixel_that_a_frame_saw_is_filled(tmp_path):
    # One wide glance over the whole, then a long look at the middle at three times the zoom.
    wide = [Pinhole(frame=0, f_px=150.0, size_px=(240, 136))]
    close = [Pinhole(frame=10 + 3 * k, f_px=450.0, size_px=(240, 136), pan_deg=0.1 * k) for k in range(40)]
    frames = [*wide, *close]
    surface = choose_surface(frames, "cylindrical")
    assert 0 in plan_views(frames, surface).frames
    panorama = composite_of(tmp_path, frames, surface)
    xy = np.stack(np.meshgrid(np.arange(surface.width), np.arange(surface.height)), axis=-1)
    at = wide[0].ray_to_pixel(surface.pixel_to_ray(xy))
    seen = ((at >= 4) & (at <= np.array(wide[0].size_px) - 5)).all(axis=-1)
    assert seen.mean() > 0.5 and (panorama.alpha[seen] == 255).all()
    assert psnr(panorama.image, clean_plate(surface), seen) > 25
