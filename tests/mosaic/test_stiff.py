"""The pull of a homography to what a camera that turns and zooms can do."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.estimator import align
from mosaic.pyramid import build_pyramid
from mosaic.stiff import StiffHomographyFamily
from mosaic.template import build_template, prepare
from mosaic.warp import HomographyFamily
from tests.mosaic.textures import SIZE, as_uint8, corner_error_px, homography, picture

STIFF = StiffHomographyFamily(size_px=SIZE)


def camera_homography(focal_half_widths, pan_deg=0.0, tilt_deg=0.0, roll_deg=0.0, zoom=1.0):
    """Of a camera that turns and zooms, raw px, det 1."""
    w, h = SIZE

    def K(f):
        return np.array([[f * w / 2, 0, (w - 1) / 2], [0, f * w / 2, (h - 1) / 2], [0, 0, 1.0]])

    p, t, r = np.deg2rad([pan_deg, tilt_deg, roll_deg])
    Ry = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    Rx = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    Rz = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1.0]])
    H = K(focal_half_widths * zoom) @ Rz @ Rx @ Ry @ np.linalg.inv(K(focal_half_widths))
    return H / np.cbrt(np.linalg.det(H))


def cost(H) -> float:
    """Squared standard deviations that the pull charges."""
    weak, std = STIFF._weak(H)
    return float(np.sum((weak / std) ** 2))


@pytest.mark.parametrize("focal", [2.0, 4.0, 10.0])
@pytest.mark.parametrize("turn", [(0.5, 0.2), (-3.0, 0.5), (2.0, -2.0)])
def test_what_cameras_do_between_frames_is_nearly_free(focal, turn):
    """Turn, roll of half a degree, zoom of 3 %, from 1 to 5 W of focal length: under 1.6 deviations of each of four."""
    assert cost(camera_homography(focal, *turn, roll_deg=0.5, zoom=1.03)) < 4 * 1.6**2


@pytest.mark.parametrize("bent", [homography(px=0.02), homography(py=-0.02), np.diag([1.02, 1 / 1.02, 1.0])])
def test_what_no_camera_does_is_charged(bent):
    """Two per cent of keystone or anisotropy without a turn: dozens of deviations."""
    assert cost(bent) > 400


def test_the_gradient_is_that_of_the_cost():
    """Against central differences of the cost itself, and P is its Gauss-Newton Hessian."""
    H = homography(14, -5, 1.02, 0.4, px=0.004, py=-0.002)
    P, g = STIFF.pull(H)
    std = STIFF._weak(H)[1]

    def half_cost(step):
        return 0.5 * float(np.sum((STIFF._weak(STIFF.update(H, step))[0] / std) ** 2))

    measured = np.array([(half_cost(1e-5 * e) - half_cost(-1e-5 * e)) / 2e-5 for e in np.eye(8)])
    assert np.allclose(g, measured, rtol=1e-3, atol=1e-3 * np.abs(measured).max())
    assert np.allclose(P, P.T) and np.linalg.eigvalsh(P).min() > -1e-6 * np.abs(P).max()


def test_texture_everywhere_outvotes_the_pull():
    """A keystone that no camera makes is still found to .1 px where pixels show it."""
    H = homography(5, 2, 1.01, px=0.02, py=0.01)
    a, b = as_uint8(picture(0), noise=2), as_uint8(picture(0, H), noise=2, seed=1)
    fit, _ = align(prepare(build_template(build_pyramid(a), 0), STIFF), build_pyramid(b), np.eye(3), dst=1)
    assert corner_error_px(fit.H_dst_src, H) < 0.1


def test_a_band_of_texture_does_not_bend_the_rest():
    """Texture in the upper fifth alone: the far corners are three times nearer than with free parameters."""
    H = camera_homography(4.0, -1.0, 0.3, zoom=1.01)
    errors = {"free": [], "stiff": []}
    for seed in range(6):
        band = np.zeros(SIZE[::-1], bool)
        band[:60] = True
        pictures = [
            build_pyramid(as_uint8(gray, noise=6, seed=10 * seed + k), mask=band)
            for k, gray in enumerate((picture(seed), picture(seed, H)))
        ]
        for name, family in (("free", HomographyFamily(size_px=SIZE)), ("stiff", STIFF)):
            source = prepare(build_template(pictures[0], 0), family)
            fit, _ = align(source, pictures[1], np.eye(3), dst=1)
            errors[name].append(corner_error_px(fit.H_dst_src, H) if fit.usable else np.inf)
    assert np.median(errors["stiff"]) < np.median(errors["free"]) / 3
