"""The rotation + zoom family: points against calib's camera, Jacobian and A against central differences."""

from dataclasses import replace

import numpy as np
import pytest

from calib import rotation
from calib.parallax import Parallax
from calib.records import Lens
from pipelines.bridge import CameraPlacement, CameraPose, PairState, RotationZoomFamily, pair_state

SIZE = (1920, 1080)


def family_and_state(k=0.04, c1=-0.02):
    lens = Lens(size_px=SIZE, pp_px=np.array([965.0, 530.0]), aspect=1.02, c0=k, c1=c1)
    src = CameraPose(log_f=np.log(2500.0), R=rotation.exp([0.02, -0.05, 0.01]))
    dst = CameraPose(log_f=np.log(3100.0), R=rotation.exp([0.03, 0.04, -0.02]))
    return lens, src, dst, RotationZoomFamily(lens=lens, log_f_src=src.log_f), pair_state(src, dst)


POINTS = np.random.default_rng(0).uniform((0, 0), (1919, 1079), (200, 2))


def test_points_equal_the_cameras_placements():
    lens, src, dst, family, state = family_and_state()
    where, _, _ = family.warp(state, family.prepare(POINTS))
    rays = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=src).pixel_to_ray(POINTS)
    expected = CameraPlacement(frame=1, size_px=SIZE, lens=lens, pose=dst).ray_to_pixel(rays)
    np.testing.assert_allclose(where, expected, atol=1e-7)


def test_a_placement_with_parallax_sees_near_and_far_apart_and_is_its_own_inverse():
    lens, src, _, _, _ = family_and_state()
    parallax = Parallax(over_height=0.04, over_stand=0.006, R_head_world=np.eye(3))
    turned = CameraPose(log_f=src.log_f, R=rotation.from_pan_tilt_roll(0.2, -0.1, 0.0))
    plain = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=turned)
    moved = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=turned, parallax=parallax)
    rays = moved.pixel_to_ray(POINTS)
    np.testing.assert_allclose(moved.ray_to_pixel(rays), POINTS, atol=1e-7)
    # The pupil is nearer than the axis: the scene spreads from the optical axis, the near pitch more than the stand.
    spread = np.linalg.norm(moved.ray_to_pixel(plain.pixel_to_ray(POINTS)) - POINTS, axis=1)
    near = POINTS[:, 1] > 1000
    assert spread[near].min() > 1.0 and spread[near].mean() > 1.5 * spread[POINTS[:, 1] < 300].mean()


def test_a_placement_of_a_rolling_shutter_has_a_camera_a_row_and_is_its_own_inverse():
    lens, src, _, _, _ = family_and_state(c1=0.0)
    rate = np.array([0.01, 0.002, 0.03, 0.001])  # a fast pan: 75 px a frame
    rolling = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=src, share=0.6, rate=rate)
    rays = rolling.pixel_to_ray(POINTS)
    # Up to 25 px away, and an arc is taken for a line; a tenth of the speed leaves a hundredth of that.
    np.testing.assert_allclose(rolling.ray_to_pixel(rays), POINTS, atol=0.5)
    slow = replace(rolling, rate=rate / 10)
    np.testing.assert_allclose(slow.ray_to_pixel(slow.pixel_to_ray(POINTS)), POINTS, atol=6e-3)
    # Each row by itself: the camera as it stood when that row was read.
    for point, ray in zip(POINTS[:20], rays[:20], strict=True):
        late = 0.6 * ((point[1] + 0.5) / SIZE[1] - 0.5)
        pose = CameraPose(log_f=src.log_f + rate[0] * late, R=rotation.exp(rate[1:] * late) @ src.R)
        of_row = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=pose)
        np.testing.assert_allclose(of_row.ray_to_pixel(ray), point, atol=1e-3)
    middle = np.array([[100.0, (SIZE[1] - 1) / 2], [1800.0, (SIZE[1] - 1) / 2]])
    plain = CameraPlacement(frame=0, size_px=SIZE, lens=lens, pose=src)
    np.testing.assert_allclose(rolling.pixel_to_ray(middle), plain.pixel_to_ray(middle), atol=1e-12)
    corner = np.array([[0.0, 0.0]])
    assert np.linalg.norm(plain.ray_to_pixel(rolling.pixel_to_ray(corner)) - corner) > 15


@pytest.mark.parametrize("parameter", range(4))
def test_jacobian_against_central_differences(parameter):
    _, _, _, family, state = family_and_state()
    prepared = family.prepare(POINTS)
    _, J, _ = family.warp(state, prepared)
    step = np.zeros(4)
    step[parameter] = 1e-5
    plus, _, _ = family.warp(family.update(state, step), prepared)
    minus, _, _ = family.warp(family.update(state, -step), prepared)
    numeric = (plus - minus) / 2e-5
    np.testing.assert_allclose(J[:, :, parameter], numeric, rtol=2e-5, atol=1e-2)


def test_source_derivative_against_central_differences():
    _, _, _, family, state = family_and_state()
    _, _, A = family.warp(state, family.prepare(POINTS))
    for axis in range(2):
        h = np.zeros(2)
        h[axis] = 1e-3
        plus, _, _ = family.warp(state, family.prepare(POINTS + h))
        minus, _, _ = family.warp(state, family.prepare(POINTS - h))
        np.testing.assert_allclose(A[:, :, axis], (plus - minus) / 2e-3, atol=1e-6)


def test_points_behind_the_camera_are_nan():
    _, _, _, family, _ = family_and_state()
    where, _, _ = family.warp(
        PairState(np.log(2500.0), rotation.exp([0.0, np.pi, 0.0])), family.prepare(POINTS)
    )
    assert np.isnan(where).all()


@pytest.mark.parametrize("k", [0.06, 0.0, -0.1])
def test_compiled_rays_equal_the_lens(k):
    lens, src, _, family, _ = family_and_state(k=k)
    rays, _ = family.prepare(POINTS)
    f = np.exp(src.log_f)
    ideal = rays[:, :2] * np.array([f, f / lens.aspect]) + lens.pp_px
    np.testing.assert_allclose(ideal, lens.undistort(POINTS, src.log_f), atol=1e-7)


@pytest.mark.parametrize(("k1", "k2"), [(0.06, 0.0), (0.0, 0.0), (-0.1, 0.0), (0.02, -0.01)])
def test_compiled_projection_equals_the_lens(k1, k2):
    lens = Lens(size_px=(1280, 720), pp_px=np.array([650.0, 350.0]), aspect=1.02, c0=k1, k2=k2)
    pose = CameraPose(log_f=float(np.log(900.0)), R=rotation.exp([0.02, -0.1, 0.01]))
    placement = CameraPlacement(frame=0, size_px=(1280, 720), lens=lens, pose=pose)
    # All round: behind the camera, and beyond the radius where the two negative lenses fold.
    angle = np.linspace(-np.pi, np.pi, 97)
    rays = np.stack([np.sin(angle), 0.3 * np.cos(3 * angle), np.cos(angle)], axis=-1)
    axes = rays @ pose.R.T
    f = np.exp(pose.log_f)
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = lens.pp_px + np.array([f, f / lens.aspect]) * axes[:, :2] / axes[:, 2:]
    expected = np.where(axes[:, 2:] > 1e-6, lens.distort(ideal, pose.log_f), np.nan)
    np.testing.assert_allclose(placement.ray_to_pixel(rays), expected, rtol=1e-12)
    assert 0 < np.isfinite(expected).sum() < expected.size


def test_increment_is_a_left_rotation():
    _, _, _, family, state = family_and_state()
    step = np.array([0.01, 0.02, -0.03, 0.04])
    moved = family.update(state, step)
    np.testing.assert_allclose(moved.R_dst_src, rotation.exp(step[1:]) @ state.R_dst_src, atol=1e-12)
    assert moved.log_f == pytest.approx(state.log_f + 0.01)
