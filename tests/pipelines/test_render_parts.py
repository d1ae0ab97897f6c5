"""The parts that rendering is made of, each against its own truth: views, plates, mattes, inlays, paths, encoding."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import Colorspace, Interpolation

from calib.parallax import Parallax
from calib.records import Lens
from calib.rotation import from_pan_tilt_roll
from mosaic.surface import Surface
from pipelines.bridge import CameraPlacement, CameraPose
from pipelines.errors import InputError, OutputError
from pipelines.rays import pixel_to_ray, ray_to_pixel
from pipelines.render.encode import clock_of, nominal_rate, video_writer
from pipelines.render.inlay import draw, picture_levels, place
from pipelines.render.matte import MatteOptions, difference, front_matte
from pipelines.render.paths import read_move, smoothed
from pipelines.render.plate import SAME_LIGHT, Plate, fit_light
from pipelines.render.views import OUTSIDE, camera_view, frame_view, homography_view, seen, warp_map
from tests.pipelines.export_truth import FIRST, LOST, N, truth
from tests.pipelines.tables import camera_table

SIZE = (640, 360)


# ---- views


def test_a_view_is_the_camera_of_its_row() -> None:
    known = truth(aspect=45 / 64)
    table = known.table()
    for i in range(N):
        view = frame_view(table, i, known.size_px)
        if i == LOST:
            assert view is None
            continue
        assert view is not None
        rays = known.rays(i)
        xy = known.project(i, rays)
        np.testing.assert_allclose(view.ray_to_pixel(rays), xy, atol=1e-8)
        np.testing.assert_allclose(view.ray_to_pixel(rays), ray_to_pixel(table, FIRST + i, rays), atol=1e-8)
        back = view.pixel_to_ray(xy)
        unit = back / np.linalg.norm(back, axis=-1, keepdims=True)
        np.testing.assert_allclose(unit, pixel_to_ray(table, FIRST + i, xy), atol=1e-10)
        assert np.isnan(view.ray_to_pixel(-rays)).all()


def test_a_view_with_parallax_is_the_compositors_placement() -> None:
    lens = Lens(size_px=SIZE, pp_px=np.array([310.0, 190.0]), aspect=1.0, c0=0.04)
    pose = CameraPose(log_f=float(np.log(900.0)), R=from_pan_tilt_roll(0.2, -0.15, 0.02))
    parallax = Parallax(over_height=0.04, over_stand=0.006, R_head_world=from_pan_tilt_roll(0.1, 0.05, 0.0))
    placement = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=pose, parallax=parallax)
    view = camera_view(
        SIZE, 900.0, (0.2, -0.15, 0.02), pp_px=(310.0, 190.0), aspect=1.0,
        k1=float(lens.k1_opencv(pose.log_f)), parallax=parallax,
    )  # fmt: skip
    at = np.random.default_rng(0).uniform((0, 0), (639, 359), (50, 2))
    rays = placement.pixel_to_ray(at)
    np.testing.assert_allclose(view.ray_to_pixel(rays), at, atol=1e-6)
    back = view.pixel_to_ray(at)
    np.testing.assert_allclose(back / np.linalg.norm(back, axis=-1, keepdims=True), rays, atol=1e-9)
    np.testing.assert_allclose(view.reduced(2).ray_to_pixel(rays), (at - 0.5) / 2, atol=1e-6)


def test_changed_views_see_the_same_ray_at_the_changed_pixel() -> None:
    view = camera_view(SIZE, 900.0, (0.2, -0.15, 0.02), pp_px=(310.0, 190.0), aspect=0.9, k1=0.15)
    at = np.array([[0.0, 0.0], [100.0, 300.0], [639.0, 10.0]])
    rays = view.pixel_to_ray(at)
    middle = np.array([319.5, 179.5])
    np.testing.assert_allclose(view.scaled(1.3).ray_to_pixel(rays), middle + 1.3 * (at - middle), atol=1e-9)
    part = view.cropped(slice(40, 200), slice(100, 420))
    assert part.size_px == (320, 160)
    np.testing.assert_allclose(part.ray_to_pixel(rays), at - [100, 40], atol=1e-9)
    small = view.reduced(4)
    assert small.size_px == (160, 90)
    # Pixel edges stay pixel edges: the picture's left edge is at -.5 in both.
    np.testing.assert_allclose(small.ray_to_pixel(rays), (at + 0.5) / 4 - 0.5, atol=1e-9)


def test_a_warp_is_exact_to_a_hundredth_of_a_pixel() -> None:
    """At every pixel against the map computed there; the widest lens and the strongest distortion that are met."""
    source = camera_view(SIZE, 700.0, (0.0, -0.2, 0.01), k1=0.12)
    target = camera_view(SIZE, 800.0, (0.12, -0.17, 0.0), k1=0.05)
    map_x, map_y = warp_map(source, target)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    exact = source.ray_to_pixel(target.pixel_to_ray(np.stack([x, y], axis=-1)))
    assert np.abs(np.stack([map_x, map_y], axis=-1) - exact).max() < 0.012
    inside = (exact > -0.5).all(axis=-1) & (exact < [SIZE[0] - 0.5, SIZE[1] - 0.5]).all(axis=-1)
    assert (seen(map_x, map_y, SIZE) != inside).mean() < 1e-3 < inside.mean() < 0.99


def test_what_lies_behind_the_camera_is_nowhere() -> None:
    map_x, map_y = warp_map(camera_view(SIZE, 700.0, (0, 0, 0)), camera_view(SIZE, 700.0, (np.pi, 0, 0)))
    assert (map_x == OUTSIDE).all() and not seen(map_x, map_y, SIZE).any()


def test_a_shot_without_a_focal_length_has_views_by_homography() -> None:
    H = np.array([[1.1, 0.01, 5.0], [0.0, 1.1, -7.0], [1e-5, 0.0, 1.0]])
    table = camera_table(2, homography=np.stack([H, np.full((3, 3), np.nan)]))
    view = homography_view(table, 0, SIZE)
    assert view is not None and homography_view(table, 1, SIZE) is None and frame_view(table, 0, SIZE) is None
    sent = H @ [100.0, 50.0, 1.0]
    np.testing.assert_allclose(view.ray_to_pixel(sent), [100.0, 50.0], atol=1e-9)


# ---- plates and mattes


def striped_plate(kind: str = "cylindrical") -> Plate:
    """A panorama whose colours are smooth functions of direction; its right fifth was never seen."""
    surface = Surface(kind=kind, scale_px=900.0, cx=700.5, cy=300.5, width=1400, height=600)  # type: ignore[arg-type]
    x, y = np.meshgrid(np.arange(1400.0), np.arange(600.0))
    rgb = np.stack(
        [120 + 80 * np.sin(x / 60), 120 + 80 * np.sin(y / 50), 120 + 80 * np.sin((x + y) / 70)], -1
    )
    rgba = np.concatenate([rgb, np.full((600, 1400, 1), 255.0)], axis=-1)
    rgba[:, 1120:] = 0
    full = np.round(rgba).astype(np.uint8)
    half = np.round(rgba.reshape(300, 2, 700, 2, 4).mean(axis=(1, 3))).astype(np.uint8)
    return Plate(surface=surface, levels=(full, half))


def colours_at(plate: Plate, rays: np.ndarray) -> np.ndarray:
    x, y = np.moveaxis(plate.surface.ray_to_pixel(rays), -1, 0)
    return np.stack(
        [120 + 80 * np.sin(x / 60), 120 + 80 * np.sin(y / 50), 120 + 80 * np.sin((x + y) / 70)], -1
    )


@pytest.mark.parametrize("f_px", [1500.0, 900.0, 420.0])
def test_a_plate_shows_what_the_surface_holds_in_that_direction(f_px: float) -> None:
    """Above, at and below the panorama's own scale: the reduced level must not shift the picture."""
    plate = striped_plate()
    view = camera_view(SIZE, f_px, (0.05, -0.02, 0.01), k1=0.05)
    picture, known = plate.seen_by(view)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    rays = view.pixel_to_ray(np.stack([x, y], axis=-1))
    where = plate.surface.ray_to_pixel(rays)
    sure = (where[..., 0] > 4) & (where[..., 0] < 1112) & (where[..., 1] > 4) & (where[..., 1] < 595)
    assert known[sure].all() and not known[where[..., 0] > 1124].any()
    # A shift of half a pixel would be 80 / 60 / 2 grey at the steepest place; rounding and 1/32 px leave less.
    away = picture[sure].astype(float) - colours_at(plate, rays[sure])
    assert np.sqrt(np.mean(away**2)) < 0.5
    assert np.abs(away.mean(axis=0)).max() < 0.1


def test_light_is_found_behind_a_third_of_players() -> None:
    rng = np.random.default_rng(3)
    plate = rng.integers(30, 200, (90, 160, 3)).astype(np.uint8)
    frame = plate * np.array([1.1, 0.9, 1.02]) + np.array([5.0, -3.0, 8.0]) + rng.normal(0, 2, plate.shape)
    frame[20:70, 20:110] = [250, 20, 20]
    light = fit_light(np.clip(frame, 0, 255).astype(np.uint8), plate, np.ones((90, 160), bool))
    np.testing.assert_allclose(light.gain, [1.1, 0.9, 1.02], atol=0.01)
    np.testing.assert_allclose(light.offset, [5.0, -3.0, 8.0], atol=1.0)
    assert fit_light(plate, plate, np.zeros((90, 160), bool)) is SAME_LIGHT


def test_the_matte_has_the_player_and_neither_noise_nor_a_shift_of_a_pixel() -> None:
    rng = np.random.default_rng(5)
    plate = cv2.GaussianBlur(rng.integers(0, 255, (240, 400, 3)).astype(np.uint8), (0, 0), 2.0)
    frame = np.roll(plate, 1, axis=1).astype(np.float32)
    player = np.zeros((240, 400), bool)
    player[80:160, 150:180] = True
    player[100:110, 160:166] = False  # a hole in him, of the colour of the grass
    frame[player] = [220, 30, 40]
    player[100:110, 160:166] = True
    frame[30:32, 300:302] = 255  # a speck
    noisy = np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8)
    known = np.ones((240, 400), bool)
    matte = front_matte(difference(noisy, plate, known, SAME_LIGHT), MatteOptions(), 1280)
    front = matte > 0.5
    assert front[player].mean() > 0.97
    beside = cv2.dilate(player.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0
    assert not front[beside].any()
    assert not front_matte(difference(noisy, plate, ~known, SAME_LIGHT), MatteOptions(), 1280).any()


# ---- inlays


def test_an_inlay_has_its_corners_where_they_were_put() -> None:
    """Its weight's centre in the view and its outline: a slanted board, seen by another camera than it was put in."""
    put = camera_view(SIZE, 900.0, (0.1, -0.1, 0.01), k1=0.05)
    corners = np.array([[200.0, 150.0], [330.0, 140.0], [350.0, 230.0], [190.0, 215.0]])
    picture = np.full((64, 128, 4), 255, np.float32)
    inlay = place(picture_levels(picture), put.pixel_to_ray(corners))
    seen_by = camera_view(SIZE, 1200.0, (0.07, -0.12, 0.0))
    found = draw(inlay, seen_by)
    assert found is not None
    (rows, columns), rgba = found
    cover = np.zeros((SIZE[1], SIZE[0]))
    cover[rows, columns] = rgba[..., 3] / 255
    outline = seen_by.ray_to_pixel(inlay.outline(64))
    wanted = np.zeros((SIZE[1] * 8, SIZE[0] * 8), np.uint8)
    cv2.fillPoly(wanted, [np.round((outline + 0.5) * 8 - 0.5).astype(np.int32)], 1)
    exact = wanted.reshape(SIZE[1], 8, SIZE[0], 8).mean(axis=(1, 3))
    assert abs(cover.sum() / exact.sum() - 1) < 0.005
    assert np.abs(cover - exact).max() < 0.4  # of one pixel, on the border

    def centre(weight: np.ndarray) -> np.ndarray:
        y, x = np.mgrid[: SIZE[1], : SIZE[0]]
        return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()

    np.testing.assert_allclose(centre(cover), centre(exact), atol=0.03)
    np.testing.assert_allclose(put.ray_to_pixel(inlay.outline(1)), corners, atol=1e-8)


def test_an_inlay_that_is_not_in_the_picture_is_not_drawn() -> None:
    put = camera_view(SIZE, 900.0, (0.0, 0.0, 0.0))
    inlay = place(
        picture_levels(np.full((8, 8, 4), 255, np.float32)),
        put.pixel_to_ray([[10, 10], [60, 10], [60, 60], [10, 60]]),
    )
    for pan in (1.0, np.pi):
        found = draw(inlay, camera_view(SIZE, 900.0, (pan, 0, 0)))
        assert found is None or not found[1].any()


@pytest.mark.parametrize(
    ("corners", "said"),
    [
        ([[0, 0], [50, 50], [50, 0], [0, 50]], "crosses itself"),
        ([[0, 0], [50, 0], [20, 10], [0, 50]], "bent inwards"),
        ([[0, 0], [25, 0], [50, 0], [0, 50]], "in one line"),
    ],
)
def test_corners_that_make_no_board_are_refused(corners: list[list[int]], said: str) -> None:
    rays = camera_view(SIZE, 900.0, (0.0, 0.0, 0.0)).pixel_to_ray(np.array(corners, float))
    with pytest.raises(ValueError, match=said):
        place(picture_levels(np.full((8, 8, 4), 255, np.float32)), rays)


# ---- paths


def test_smoothing_keeps_a_steady_pan_and_takes_the_tremor() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(200) / 25
    pan = np.stack([3.0 + 7.0 * t, -2.0 * t], axis=1)
    np.testing.assert_allclose(smoothed(t, pan, 0.5), pan, atol=1e-9)
    shaken = smoothed(t, pan + rng.normal(0, 0.1, pan.shape), 0.5)
    jerk = [np.std(np.diff(v, 2, axis=0)) for v in (pan + rng.normal(0, 0.1, pan.shape), shaken)]
    assert jerk[1] < 0.02 * jerk[0]
    # 25 frames/s and sigma .5 s are 44 frames' weight: the noise goes down by its root.
    assert np.std((shaken - pan)[30:-30]) < 0.1 / np.sqrt(44) * 1.5


def test_a_move_passes_through_its_keyframes_without_overshooting(tmp_path: Path) -> None:
    path = tmp_path / "keys.csv"
    path.write_text("time_s,pan_deg,tilt_deg,hfov_deg\n1,-20,-10,40\n3,10,-12,20\n4,10,-12,20\n")
    keys = read_move(path)
    assert keys.duration_s == 3
    pan, tilt, roll, hfov = (np.degrees(column) for column in keys.at([0.0, 2.0, 3.0]))
    np.testing.assert_allclose(pan, [-20, 10, 10], atol=1e-12)
    np.testing.assert_allclose(tilt, [-10, -12, -12], atol=1e-12)
    np.testing.assert_allclose(hfov, [40, 20, 20], atol=1e-12)
    assert not roll.any()
    between = np.degrees(keys.at(np.linspace(0, 3, 301))[0])
    assert between.max() <= 10 + 1e-9 and (np.diff(between) >= -1e-12).all()


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "time_s,pan_deg,tilt_deg,hfov_deg\n0,1,2,30\n", "has 1 keyframe,"),
        ("a.csv", "time_s,pan_deg,tilt_deg\n0,1,2\n1,1,2\n", "lacks hfov_deg"),
        ("a.csv", "time_s,pan_deg,tilt_deg,hfov_deg\n0,1,2,30\n0,1,2,30\n", "does not rise"),
        ("a.csv", "time_s,pan_deg,tilt_deg,hfov_deg\n0,1,2,30\n1,x,2,30\n", "is no number"),
        ("a.csv", "time_s,pan_deg,tilt_deg,hfov_deg\n0,1,2,30\n1,nan,2,30\n", "not finite"),
        ("a.csv", "time_s,pan_deg,tilt_deg,hfov_deg\n0,1,2,30\n1,1,2,180\n", "between 0 and 170"),
        ("a.json", '{"time_s": 1}', "is not a list"),
        ("a.json", "[", "cannot be read"),
        ("b.csv", "", "no such file"),
    ],
)
def test_keyframes_that_cannot_be_say_why(tmp_path: Path, name: str, text: str, said: str) -> None:
    if name != "b.csv":
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_move(tmp_path / name)


def test_keyframes_may_be_json(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    one = {"time_s": 0, "pan_deg": 170, "tilt_deg": 0, "hfov_deg": 30, "roll_deg": 2}
    path.write_text(f"[{one}, {one | {'time_s': 2, 'pan_deg': -170}}]".replace("'", '"'))
    pan, _, roll, _ = read_move(path).at([1.0])
    # The short way round.
    np.testing.assert_allclose(np.degrees([pan[0], roll[0]]), [180, 2], atol=1e-9)


# ---- encoding


def test_rates_and_times_are_those_of_the_clip() -> None:
    assert nominal_rate(25.0) == 25 and nominal_rate(59.94) == Fraction(60000, 1001)
    assert nominal_rate(23.976) == Fraction(24000, 1001) and nominal_rate(12.5) == Fraction(25, 2)
    even = clock_of(3.0 + np.round(np.arange(90) / 29.97002997, 3), 29.97003)  # a container of milliseconds
    assert even.time_base == Fraction(1001, 30000) and even.ticks == tuple(range(90))
    uneven = clock_of([0.5, 0.54, 0.66, 0.70], 25.0)
    assert uneven.time_base == Fraction(1, 90000) and uneven.ticks == (0, 3600, 14400, 18000)


# FFmpeg's converter cuts grey levels off instead of rounding, unless it is told.
ROUNDED = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
COLOUR = {"space": 5, "range": 1, "primaries": 5, "transfer": 6, "rgb_matrix": "ITU601"}


def ramp_frames(n: int, size: tuple[int, int] = SIZE) -> list[np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    return [
        np.stack([40 + 150 * x, 60 + 100 * y, np.full_like(x, 40.0 + 4 * i)], -1).astype(np.uint8)
        for i in range(n)
    ]


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(container.streams.video[0])]


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_pictures_come_back_with_time_and_colour(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    frames = ramp_frames(12)
    times = 7.0 + np.arange(12) * 1001 / 30000
    with video_writer(
        path, size_px=SIZE, clock=clock_of(times, 29.97), colour=COLOUR, pixel_aspect=64 / 45
    ) as writer:
        for frame in frames:
            writer.write(frame)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, stream.width, stream.height) == ("h264", "yuv420p", *SIZE)
        tags = (context.colorspace, context.color_range, context.color_primaries, context.color_trc)
        assert [int(tag) for tag in tags] == [6, 1, 5, 6]
        assert stream.sample_aspect_ratio == Fraction(64, 45)
        got = list(container.decode(stream))
    times_s = [float(frame.pts * frame.time_base) for frame in got]
    np.testing.assert_allclose(times_s, times - 7.0, atol=0.0006)  # mkv counts milliseconds
    assert len(got) == 12
    for frame, wanted in zip(got, frames, strict=True):
        exact = frame.reformat(
            format="rgb24", src_colorspace=Colorspace.ITU601, interpolation=ROUNDED
        ).to_ndarray()
        away = exact.astype(float) - wanted
        assert np.abs(away.mean(axis=(0, 1))).max() < 0.7  # another matrix would be off by ten


def test_uneven_times_stay_uneven(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with video_writer(path, size_px=SIZE, clock=clock_of([0.0, 0.04, 0.2, 0.24], 25.0), colour={}) as writer:
        for frame in ramp_frames(4):
            writer.write(frame)
    with av.open(str(path)) as container:
        times = [float(f.pts * f.time_base) for f in container.decode(container.streams.video[0])]
    np.testing.assert_allclose(times, [0.0, 0.04, 0.2, 0.24], atol=1e-4)


def test_odd_sides_lose_their_last_line(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with video_writer(path, size_px=(101, 75), clock=clock_of([0.0, 0.04], 25.0), colour={}) as writer:
        for frame in ramp_frames(2, (101, 75)):
            writer.write(frame)
    assert decoded(path)[0].shape == (74, 100, 3)


def with_a_beep(path: Path, beep_s: float) -> Path:
    """A clip of 3 s whose sound is silent but for a beep of .1 s."""
    rate = 48000
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=25)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        sound = container.add_stream("aac", rate=rate)
        for i in range(75):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), i, np.uint8), format="rgb24")
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        t = np.arange(3 * rate) / rate
        wave = np.where((t >= beep_s) & (t < beep_s + 0.1), np.sin(2 * np.pi * 1000 * t), 0).astype(
            np.float32
        )
        for start in range(0, len(wave), 1024):
            chunk = av.AudioFrame.from_ndarray(wave[None, start : start + 1024], format="fltp", layout="mono")
            chunk.sample_rate, chunk.pts = rate, start
            container.mux(sound.encode(chunk))
        container.mux(sound.encode(None))
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_sound_stays_with_its_picture(tmp_path: Path, suffix: str) -> None:
    """A beep at 2 s of the clip is at 1 s of a video that begins at its second 1."""
    source = with_a_beep(tmp_path / "in.mp4", 2.0)
    path = tmp_path / f"out{suffix}"
    with video_writer(
        path,
        size_px=SIZE,
        clock=clock_of(1.0 + np.arange(40) / 25, 25.0),
        colour={},
        sound_of=source,
        sound_from_s=1.0,
    ) as writer:
        for frame in ramp_frames(40):
            writer.write(frame)
        assert writer.sound == "aac, copied"
    with av.open(str(path)) as container:
        stream = container.streams.audio[0]
        heard = [
            (float(f.pts * f.time_base), f.to_ndarray().ravel(), f.sample_rate)
            for f in container.decode(stream)
        ]
    times = np.concatenate([start + np.arange(len(wave)) / rate for start, wave, rate in heard])
    loud = times[np.abs(np.concatenate([wave for _, wave, _ in heard])) > 0.3]
    assert 0.97 < loud.min() < 1.03 and 1.07 < loud.max() < 1.13  # a packet of aac is 21 ms
    assert times.min() < 0.05 and 1.5 < times.max() < 1.75  # no more sound than pictures


def test_a_video_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with (
        pytest.raises(RuntimeError, match="stop"),
        video_writer(path, size_px=SIZE, clock=clock_of([0.0, 0.04], 25.0), colour={}) as writer,
    ):
        writer.write(ramp_frames(1)[0])
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(OutputError, match="which container"),
        video_writer(tmp_path / "out.avi", size_px=SIZE, clock=clock_of([0.0], 25.0), colour={}),
    ):
        pass
