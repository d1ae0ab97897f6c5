"""Clips: truth beside the video, determinism, and that each effect does what its option says."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from tests.synth.clip import ClipSpec, SynthClip, read_truth, write_clip
from tests.synth.command import parser, spec_from
from tests.synth.paths import BROADCAST_LENS, LensSpec, PathSpec
from tests.synth.presets import PRESETS, preset
from tests.synth.sampling import expose, rgb_to_yuv420

SMALL = ClipSpec(width=320, height=180, n_frames=12, player_share=0.1, path=PathSpec(pan_deg=8, zoom=1.3))


@pytest.fixture(scope="module")
def small() -> SynthClip:
    return SynthClip(SMALL)


def decode(path: Path) -> list[av.VideoFrame]:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def test_truth_file_has_the_cameras(tmp_path: Path) -> None:
    spec = dataclasses.replace(SMALL, lens=BROADCAST_LENS, duplicate_every=5)
    other = dataclasses.replace(spec, seed=5, n_frames=3)
    truth = read_truth(write_clip(tmp_path / "two.mp4", [spec, other]))
    frames = decode(tmp_path / "two.mp4")
    assert len(frames) == len(truth["frame"]) == 15
    assert truth["shot"].tolist() == [0] * 12 + [1] * 3
    assert np.allclose(truth["pts_s"], [f.time for f in frames], atol=1e-6)
    clip = SynthClip(spec)
    for k, camera in enumerate(clip.cameras):
        assert truth["f_px"][k] == pytest.approx(camera.f_px, rel=1e-9)
        assert np.deg2rad(truth["pan_deg"][k]) == pytest.approx(camera.pan_rad, abs=1e-10)
        assert np.deg2rad(truth["tilt_deg"][k]) == pytest.approx(camera.tilt_rad, abs=1e-10)
        assert np.deg2rad(truth["roll_deg"][k]) == pytest.approx(camera.roll_rad, abs=1e-10)
        k1_half = BROADCAST_LENS.c0 + BROADCAST_LENS.c1 * np.log(camera.f_px / 320)
        assert truth["k1"][k] == pytest.approx(k1_half * (2 * camera.f_px / 320) ** 2, rel=1e-8)
    # the repeated frames say so
    assert truth["pan_deg"][4] == truth["pan_deg"][3] != truth["pan_deg"][5]
    assert frames[0].colorspace == 1 and frames[0].color_range == 1


def test_encoded_picture_is_the_rendered_one(tmp_path: Path, small: SynthClip) -> None:
    write_clip(tmp_path / "a.mp4", dataclasses.replace(SMALL, crf=8))
    rgb = decode(tmp_path / "a.mp4")[3].to_ndarray(format="rgb24").astype(float)
    difference = rgb - small.frame(3).image
    assert np.abs(difference.mean(axis=(0, 1))).max() < 1.5
    assert np.sqrt((difference**2).mean()) < 14  # chroma subsampling on a colourful crowd


def test_same_seed_same_bytes(small: SynthClip) -> None:
    again = SynthClip(SMALL)
    assert all(np.array_equal(small.frame(k).image, again.frame(k).image) for k in (0, 7))
    different = SynthClip(dataclasses.replace(SMALL, seed=2))
    assert not np.array_equal(small.frame(0).image, different.frame(0).image)


def test_same_frames_same_file(tmp_path: Path) -> None:
    """x264 by itself gives these 180 rows another file every other time."""
    spec = dataclasses.replace(SMALL, noise_grey=3.0)
    files = {write_clip(tmp_path / "a.mp4", spec).with_name("a.mp4").read_bytes() for _ in range(8)}
    assert len(files) == 1


def test_frames_do_not_depend_on_order(small: SynthClip) -> None:
    alone = small.frame(6).image
    streamed = [f.image.copy() for f in small.frames()]
    assert np.array_equal(streamed[6], alone)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_player_share_is_reached(share: float) -> None:
    clip = SynthClip(dataclasses.replace(SMALL, player_share=share, n_players=26))
    found = np.mean([clip.frame(k).player_mask.mean() for k in range(0, 12, 2)])
    assert found == pytest.approx(share, abs=0.03 + 0.1 * share)


def test_mask_marks_exactly_what_is_not_environment(small: SynthClip) -> None:
    spec = dataclasses.replace(SMALL, noise_grey=0, exposure_drift=0)
    clip = SynthClip(spec)
    frame = clip.frame(5)
    changed = (frame.image != clip.render_clean(5)).any(axis=-1)
    assert not (changed & ~frame.player_mask & ~frame.overlay_mask).any()
    assert changed[frame.player_mask].mean() > 0.95


def test_standing_player_stands() -> None:
    clip = SynthClip(dataclasses.replace(SMALL, standing_players=1))
    assert clip.squad is not None
    places = np.array([clip.squad.positions(t, clip.world.stadium) for t in (0.0, 2.0, 5.0)])
    assert np.ptp(places[:, 0], axis=0).max() == 0
    assert np.ptp(places[:, 1:], axis=0).max(axis=-1).min() > 0.5


def test_noise_exposure_and_vignette_are_as_asked() -> None:
    image = np.full((240, 320, 3), 100, np.uint8)
    expose(image, 1.0, 0.0, 0.0, 2.0, 7)
    luma = image @ np.array([0.2126, 0.7152, 0.0722])
    assert luma.std() == pytest.approx(2.0, rel=0.05)
    assert luma.mean() == pytest.approx(100, abs=0.05)
    second = np.full((240, 320, 3), 100, np.uint8)
    expose(second, 1.0, 0.0, 0.0, 2.0, 8)
    assert abs(np.corrcoef(image.ravel(), second.ravel())[0, 1]) < 0.01
    dark = np.full((240, 320, 3), 100, np.uint8)
    expose(dark, 1.5, 10.0, 0.2, 0.0, 0)
    assert dark[120, 160, 0] == 160
    assert dark[0, 0, 0] == 130


def test_yuv_is_bt709_limited() -> None:
    """White, black and the primaries of BT.709 table values."""
    for rgb, yuv in {
        (255, 255, 255): (235, 128, 128),
        (0, 0, 0): (16, 128, 128),
        (255, 0, 0): (63, 102, 240),
        (0, 255, 0): (173, 42, 26),
        (0, 0, 255): (32, 240, 118),
    }.items():
        image = np.full((4, 4, 3), rgb, np.uint8)
        y, u, v = np.empty((4, 4), np.uint8), np.empty((2, 2), np.uint8), np.empty((2, 2), np.uint8)
        rgb_to_yuv420(image, y, u, v)
        assert (y[1, 1], u[1, 1], v[1, 1]) == yuv


def test_led_content_moves_and_nothing_else(small: SynthClip) -> None:
    camera = small.camera(0)
    still = small.renderer.render_clean(camera)
    moved = small.renderer.render_clean(camera, led_shift_m=7.0)
    changed = (still != moved).any(axis=-1)
    rows = np.flatnonzero(changed.any(axis=1))
    assert 0 < changed.mean() < 0.1
    assert np.ptp(rows) < 30  # a strip of 1.6 m at 108 m, over a slanting picture


def test_flash_and_ramp() -> None:
    clip = SynthClip(
        dataclasses.replace(SMALL, flash_frame=6, exposure_ramp_stops=1.0, exposure_drift=0, n_frames=12)
    )
    means = [clip.frame(k).image.mean() for k in (0, 5, 6, 11)]
    assert means[2] > means[1] + 50
    assert clip.look(11).gain / clip.look(0).gain == pytest.approx(2.0)


def test_motion_blur_blurs_along_the_motion() -> None:
    path = PathSpec(kind="whip", pan_deg=12, tilt_deg=0, roll_deg=0, zoom=1.0, jitter_px=0)
    spec = dataclasses.replace(SMALL, path=path, player_share=0, noise_grey=0)
    sharp, blurred = (
        SynthClip(dataclasses.replace(spec, shutter=s)).frame(6).image.astype(float) for s in (0, 0.5)
    )
    across = np.abs(np.diff(blurred, axis=1)).mean() / np.abs(np.diff(sharp, axis=1)).mean()
    along = np.abs(np.diff(blurred, axis=0)).mean() / np.abs(np.diff(sharp, axis=0)).mean()
    assert across < 0.5 < along + 0.2


def test_sample_environment_agrees_with_frames(small: SynthClip) -> None:
    camera = small.camera(4)
    pixels = np.stack(np.meshgrid(np.arange(20.0, 300, 40), np.arange(20.0, 160, 30)), -1)
    seen = small.renderer.sample_environment(camera.pixel_to_ray(pixels), camera.f_px)
    shown = small.render_clean(4)[pixels[..., 1].astype(int), pixels[..., 0].astype(int)]
    assert np.abs(seen - shown).max() < 2
    assert np.isnan(small.renderer.sample_environment(np.array([0.0, 0.0, -1.0]), 400.0)).all()


@pytest.mark.parametrize("kind", ["pure_zoom", "locked_off", "pan_only"])
def test_paths_do_only_what_they_say(kind: str) -> None:
    clip_path = SynthClip(
        dataclasses.replace(SMALL, path=PathSpec(kind=kind, zoom=1.5), player_share=0)
    ).cameras
    f = np.array([c.f_px for c in clip_path])
    angles = np.array([(c.pan_rad, c.tilt_rad, c.roll_rad) for c in clip_path])
    assert (np.ptp(f) > 0) == (kind == "pure_zoom")
    assert (np.ptp(angles, axis=0).max() > 0) == (kind == "pan_only")


def test_track_is_followed() -> None:
    rows = tuple((1.4 + 0.02 * k, 3.0 - k, -10.0 + 0.1 * k, 0.2) for k in range(5))
    cameras = SynthClip(
        dataclasses.replace(SMALL, n_frames=5, path=PathSpec(kind="track", track=rows))
    ).cameras
    found = [(c.f_px / 320, *np.rad2deg((c.pan_rad, c.tilt_rad, c.roll_rad))) for c in cameras]
    assert np.allclose(found, rows, atol=1e-12)


def test_anamorphic_file_says_so(tmp_path: Path) -> None:
    spec = dataclasses.replace(SMALL, lens=LensSpec(aspect=0.75), n_frames=2)
    truth = read_truth(write_clip(tmp_path / "a.mp4", spec))
    assert truth["aspect"].tolist() == [0.75, 0.75]
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].sample_aspect_ratio == Fraction(4, 3)


def test_crowd_sways_about_its_place() -> None:
    """Only the stands change, and over time the mean shift of their texture is nil."""
    clip = SynthClip(SMALL)
    camera = clip.camera(0)
    still = clip.renderer.render_clean(camera).astype(float)
    moved = [clip.renderer.render_clean(camera, sway_m=0.15, time_s=t).astype(float) for t in (0.0, 1.0, 2.7)]
    changed = np.abs(moved[1] - still).max(axis=-1) > 0
    foot = int(
        camera.ray_to_pixel(np.array([0.0, clip.world.stadium.camera_height, 108.0]))[1]
    )  # of the hoardings
    assert changed[:foot].mean() > 0.2
    assert not changed[foot + 20 :].any()
    gx = np.gradient(still.mean(axis=-1), axis=1)
    shifts = [-(gx * (m - still).mean(axis=-1)).sum() / (gx**2).sum() for m in moved]
    assert np.abs(shifts).max() < 0.02


def test_path_reaches_pan_and_zoom() -> None:
    spec = dataclasses.replace(SMALL, n_frames=101, path=PathSpec(pan_deg=30, zoom=2.5, jitter_px=0))
    from tests.synth.paths import CameraPath

    cameras = CameraPath(
        spec=spec.path, lens=LensSpec(), width=320, height=180, n_frames=101, seed=3
    ).cameras()
    assert np.rad2deg(np.ptp([c.pan_rad for c in cameras])) == pytest.approx(30)
    f = np.array([c.f_px for c in cameras])
    assert f.max() / f.min() == pytest.approx(2.5)
    assert f.argmax() == 50


def test_command_line_and_presets() -> None:
    line = (
        "--out x.mp4 --seed 3 --pan 12 --zoom 2 --lens broadcast --pupil 0.6 --size 640x360 --fps 30000/1001"
    )
    arguments = parser().parse_args([*line.split(), "--players", "0.2"])
    spec = spec_from(arguments)
    assert (spec.seed, spec.width, spec.path.pan_deg, spec.path.zoom) == (3, 640, 12, 2)
    assert spec.lens.c0 == BROADCAST_LENS.c0 and spec.lens.pupil_m == 0.6
    assert spec.fps == Fraction(30000, 1001)
    ideal = [preset("ideal", seed=k) for k in range(1, 41)]
    assert all(10 <= s.path.pan_deg <= 40 and 1 <= s.path.zoom <= 3 for s in ideal)
    assert min(s.path.pan_deg for s in ideal) < 15 and max(s.path.zoom for s in ideal) > 2.5
    assert {name for name in PRESETS} >= {"ideal", "lens", "pure_zoom", "locked_off", "hard"}
    with pytest.raises(ValueError, match="none of"):
        preset("nonsense")


def test_rows_of_a_rolling_shutter_are_those_of_their_own_moment() -> None:
    spec = ClipSpec(
        seed=3, width=320, height=180, n_frames=9, path=PathSpec(pan_deg=12, zoom=1.0), player_share=None, n_players=0,
        scoreboard=False, logo=False, noise_grey=0.0, exposure_drift=0.0,
    )  # fmt: skip
    rolling, whole = SynthClip(dataclasses.replace(spec, readout=0.8)), SynthClip(spec)
    seen = rolling.frame(4).image.astype(float)
    for row in (20, 90, 160):
        moment = 4 + 0.8 * ((row + 0.5) / 180 - 0.5)
        own = whole._scene(moment)[0][row].astype(float)
        other = whole._scene(4.0 if row != 90 else 4.3)[0][row].astype(float)
        assert np.abs(seen[row] - own).mean() < 0.5 * np.abs(seen[row] - other).mean()
