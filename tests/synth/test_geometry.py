"""The generator's own geometry, < .01 px: every accuracy test of the project rests on it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from tests.synth.camera import SynthCamera, pixel_grid, rotation_cam_world
from tests.synth.render import Renderer, node_map, node_step, texel_map
from tests.synth.sampling import expand_row
from tests.synth.stadium import make_stadium
from tests.synth.world import World, build_levels


def camera(**changes: Any) -> SynthCamera:
    base: dict[str, Any] = {"width": 640, "height": 360, "f_px": 900.0, "cx_px": 319.5, "cy_px": 179.5}
    return SynthCamera(**(base | changes))


CAMERAS = {
    "plain": camera(tilt_rad=-0.15),
    "pan_roll": camera(pan_rad=0.25, tilt_rad=-0.18, roll_rad=0.06),
    "lens": camera(pan_rad=-0.2, tilt_rad=-0.12, roll_rad=-0.02, k1_half=0.05, cx_px=325.0, cy_px=172.0),
    "zoomed": camera(f_px=1880.0, pan_rad=0.1, tilt_rad=-0.16, roll_rad=0.01, k1_half=0.03),
    "barrel": camera(f_px=1250.0, tilt_rad=-0.1, k1_half=-0.08),
}


def dotted_world(rays: np.ndarray, *, px_per_rad: float = 2000.0, sigma_texel: float = 5.0) -> World:
    """A black environment with one Gaussian dot at each of the rays (n, 3), drawn from the cylinder's formula."""
    lon_left, tan_top = -0.75, 0.30
    w, h = int(1.5 * px_per_rad), int(0.8 * px_per_rad)
    level0 = np.zeros((h, w), np.float64)
    for ray in rays:
        x = px_per_rad * (np.arctan2(ray[0], ray[2]) - lon_left)
        y = px_per_rad * (tan_top + ray[1] / np.hypot(ray[0], ray[2]))
        x0, y0 = int(x) - 40, int(y) - 40
        gx = np.exp(-0.5 * ((np.arange(x0, x0 + 81) - x) / sigma_texel) ** 2)
        gy = np.exp(-0.5 * ((np.arange(y0, y0 + 81) - y) / sigma_texel) ** 2)
        level0[y0 : y0 + 81, x0 : x0 + 81] += gy[:, None] * gx
    image = np.repeat((level0 * 250 + 0.5).astype(np.uint8)[..., None], 3, axis=2)
    return World(
        levels=build_levels(image),
        px_per_rad=px_per_rad,
        lon_left=lon_left,
        tan_top=tan_top,
        stadium=make_stadium(),
    )


def centroid(image: np.ndarray, near: np.ndarray, radius: int = 16) -> np.ndarray:
    """Centroid (x, y) of a bright dot on black within radius of near, where the window is refined twice."""
    at = near
    for _ in range(3):
        x0, y0 = np.round(at).astype(int) - radius
        part = image[y0 : y0 + 2 * radius + 1, x0 : x0 + 2 * radius + 1].astype(np.float64)
        at = (
            np.array([(part.sum(0) @ np.arange(part.shape[1])), part.sum(1) @ np.arange(part.shape[0])])
            / part.sum()
        )
        at += (x0, y0)
    return at


def displacement(image: np.ndarray, model: np.ndarray, near: np.ndarray, radius: int = 12) -> np.ndarray:
    """Least-squares shift (x, y) of image against model within radius of near, amplitude and level free.

    A centroid would carry .01 px of 8-bit rounding from the window's rim; this weights by the gradient.
    """
    x, y = np.round(near).astype(int)
    part = np.s_[y - radius : y + radius + 1, x - radius : x + radius + 1]
    gy, gx = np.gradient(model)
    design = np.stack([-gx[part].ravel(), -gy[part].ravel(), model[part].ravel(), np.ones(gx[part].size)], -1)
    return np.linalg.lstsq(design, image[part].ravel().astype(np.float64), rcond=None)[0][:2]


@pytest.mark.parametrize("name", CAMERAS)
def test_dots_land_where_projection_says(name: str) -> None:
    """Dots at known rays, through renderer and mip levels, against closed-form pixels."""
    cam = CAMERAS[name]
    pixels = np.stack(np.meshgrid(np.linspace(40, 600, 7), np.linspace(40, 320, 5)), -1).reshape(-1, 2) + 0.37
    rays = cam.pixel_to_ray(pixels)
    sigma_texel = 3.0 * 2000.0 / cam.f_px
    world = dotted_world(rays, sigma_texel=sigma_texel)
    image = Renderer(world=world).render_clean(cam)[..., 1]
    # around each dot: the angle between ray and dot in the cylinder's own units, from ray_to_pixel's inverse alone
    seen = cam.pixel_to_ray(pixel_grid(640, 360))
    worst = 0.0
    for pixel, ray in zip(pixels, rays, strict=True):
        lon = np.arctan2(seen[..., 0], seen[..., 2]) - np.arctan2(ray[0], ray[2])
        tan = seen[..., 1] / np.hypot(seen[..., 0], seen[..., 2]) - ray[1] / np.hypot(ray[0], ray[2])
        blurred2 = (sigma_texel / 2000.0) ** 2 + (0.6 / cam.f_px) ** 2
        model = 250 * np.exp(-0.5 * (lon**2 + tan**2) / blurred2)
        assert np.linalg.norm(np.array(np.unravel_index(model.argmax(), model.shape))[::-1] - pixel) < 1
        worst = max(worst, float(np.abs(displacement(image, model, pixel)).max()))
    assert worst < 0.01


@pytest.mark.parametrize("name", CAMERAS)
def test_node_interpolation_is_exact(name: str) -> None:
    cam = CAMERAS[name]
    world = dotted_world(np.array([[0, 0.1, 1.0]]))
    step = node_step(cam)
    nodes = node_map(world, cam, step)
    xs, ys = np.empty(640), np.empty(640)
    worst = 0.0
    for row in (0, 7, 100, 101, 359):
        expand_row(nodes, step, row, xs, ys)
        exact = texel_map(world, cam, np.stack([np.arange(640.0), np.full(640, float(row))], -1))
        worst = max(worst, np.abs(np.stack([xs, ys], -1) - exact).max() * cam.f_px / world.px_per_rad)
    assert worst < 1e-3


@pytest.mark.parametrize("name", CAMERAS)
def test_pixel_ray_round_trip(name: str) -> None:
    cam = CAMERAS[name]
    pixels = pixel_grid(640, 360, 13)
    assert np.abs(cam.ray_to_pixel(cam.pixel_to_ray(pixels)) - pixels).max() < 1e-9


@pytest.mark.parametrize("k1_half", [-0.1, -0.05, 1e-6, 0.05, 0.15])
def test_distortion_round_trip_and_opencv_convention(k1_half: float) -> None:
    cam = camera(k1_half=k1_half, cx_px=322.0, cy_px=176.0)
    pixels = pixel_grid(640, 360, 17)
    ideal = cam.undistort(pixels)
    assert np.abs(cam.distort(ideal) - pixels).max() < 1e-8
    normalised = np.concatenate(
        [(ideal - [322.0, 176.0]) / 900.0, np.ones((*ideal.shape[:2], 1))], -1
    ).reshape(-1, 3)
    by_opencv, _ = cv2.projectPoints(
        normalised, np.zeros(3), np.zeros(3), cam.K, np.array([cam.k1_opencv, 0, 0, 0, 0])
    )
    assert np.abs(by_opencv.reshape(pixels.shape) - pixels).max() < 1e-6


def test_fold_of_barrel_distortion_is_nan() -> None:
    cam = camera(k1_half=-0.4)
    assert np.isnan(cam.pixel_to_ray(np.array([0.0, 0.0]))).all()


def test_signs() -> None:
    """Pan right moves content left, tilt up moves it down, clockwise roll turns it counter-clockwise."""
    ahead, right = np.array([0, 0, 1.0]), np.array([0.2, 0, 1.0])
    still = camera()
    assert camera(pan_rad=0.1).ray_to_pixel(ahead)[0] < still.ray_to_pixel(ahead)[0] - 50
    assert camera(tilt_rad=0.1).ray_to_pixel(ahead)[1] > still.ray_to_pixel(ahead)[1] + 50
    assert camera(roll_rad=0.1).ray_to_pixel(right)[1] < still.ray_to_pixel(right)[1] - 10


def test_signs_in_pictures() -> None:
    """The same through the renderer: a dot ahead, pictures of it."""
    world = dotted_world(np.array([[0.0, 0.0, 1.0], [0.12, 0.0, 1.0]]))
    renderer = Renderer(world=world)

    def peaks(cam: SynthCamera) -> np.ndarray:
        image = renderer.render_clean(cam)[..., 0]
        _, _, _, centres = cv2.connectedComponentsWithStats((image > 100).astype(np.uint8))
        return centres[1:][np.argsort(centres[1:, 0])]

    still = peaks(camera())
    assert (peaks(camera(pan_rad=0.05))[:, 0] < still[:, 0] - 30).all()
    assert (peaks(camera(tilt_rad=0.05))[:, 1] > still[:, 1] + 30).all()
    assert peaks(camera(roll_rad=0.1))[1, 1] < still[1, 1] - 5


def test_rotation_matches_the_contract() -> None:
    """Angles come back by calibration.md's formulas."""
    R = rotation_cam_world(0.3, -0.2, 0.05)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.isclose(np.linalg.det(R), 1)
    found = np.arctan2(R[2, 0], R[2, 2]), np.arcsin(-R[2, 1]), np.arctan2(R[0, 1], R[1, 1])
    assert np.allclose(found, (0.3, -0.2, 0.05), atol=1e-14)


def test_levels_share_their_rays() -> None:
    """A dot is at the same ray on every mip level."""
    rays = np.array([[0.05, 0.1, 1.0], [-0.3, -0.05, 1.0]])
    world = dotted_world(rays, sigma_texel=8.0)
    truth = world.rays_to_texel(rays)
    for level, image in enumerate(world.levels):
        found = (
            np.array([centroid(image[..., 0], t / 2**level, 40 // 2**level + 3) for t in truth]) * 2**level
        )
        assert np.abs(found - truth).max() < 0.05


def test_parallax_is_the_formula() -> None:
    """Pupil r before the axis: depths Z1, Z2 separate by f r sin(dpan) (1/Z1 - 1/Z2) (real-footage.md 5)."""
    world = dotted_world(np.array([[0, 0.1, 1.0]]))
    stadium = world.stadium
    near = np.array([0.0, stadium.camera_height, 40.0])
    far = np.array([0.0, stadium.camera_height, 100.0])
    shift = []
    for point in (near, far):
        pure, real = (camera(f_px=2750.0, pan_rad=0.08, tilt_rad=-0.2, pupil_m=r) for r in (0.0, 0.6))
        seen = real.point_to_pixel(point)
        shift.append(seen - pure.point_to_pixel(point))
        # the renderer's own map shows at that pixel the texel of that point
        texel = texel_map(world, real, seen)
        assert np.abs(texel - world.rays_to_texel(point)).max() < 2e-3
    between = abs(shift[0][0] - shift[1][0])
    expected = 2750 * 0.6 * np.sin(0.08) * (1 / np.linalg.norm(near) - 1 / np.linalg.norm(far))
    assert between == pytest.approx(expected, rel=0.15)
