"""Surfaces: formulas against hand-written values, inverses, cropping, the pixel budget."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaic.surface import KINDS, Surface, choose_surface
from tests.mosaic.pinhole import Pinhole, sweep


def surface_of(kind, **changes):
    values = dict(kind=kind, scale_px=900.0, cx=700.5, cy=300.5, width=1500, height=640)
    return Surface(**(values | changes))


@pytest.mark.parametrize(
    ("kind", "y"), [("equirectangular", 300.5 - 900 * 0.2), ("cylindrical", 300.5 - 900 * np.tan(0.2))]
)
def test_longitude_latitude_follow_the_published_formulas(kind, y):
    lon, lat = 0.3, 0.2
    ray = [np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)]
    np.testing.assert_allclose(surface_of(kind).ray_to_pixel(ray), [700.5 + 900 * lon, y], atol=1e-9)


def test_planar_follows_the_published_formula():
    np.testing.assert_allclose(surface_of("planar").ray_to_pixel([0.6, -0.4, 2.0]), [970.5, 120.5], atol=1e-9)


def test_pannini_keeps_upright_lines_and_lines_through_the_middle_straight():
    lon, lat = 0.7, 0.3
    q = 2 / (1 + np.cos(lon))
    ray = np.array([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)])
    surface, middle = surface_of("pannini"), np.array([700.5, 300.5])
    expected = middle + 900 * q * np.array([np.sin(lon), -np.tan(lat)])
    np.testing.assert_allclose(surface.ray_to_pixel(ray), expected, atol=1e-9)
    t = np.linspace(-1, 1, 9)[:, None]
    upright = surface.ray_to_pixel(np.array([0.8, 0.0, 1.0]) + t * [0.0, 0.5, 0.0])
    assert np.ptp(upright[:, 0]) < 1e-9
    through = surface.ray_to_pixel(np.array([0.0, 0.0, 1.0]) + t * [0.9, 0.4, 0.0]) - middle
    assert np.abs(through[:, 1] - through[:, 0] * 0.4 / 0.9).max() < 1e-9
    # A touchline: far less bent than on a cylinder.
    line = np.array([0.0, 0.3, 1.0]) + t * [0.9, 0.0, 0.0]
    bend = {kind: np.ptp(surface_of(kind).ray_to_pixel(line)[:, 1]) for kind in ("pannini", "cylindrical")}
    assert bend["pannini"] < 0.6 * bend["cylindrical"]


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.sampled_from(KINDS), st.floats(-400, 3000), st.floats(-200, 1200), st.floats(-3000, 3000))
def test_pixel_ray_pixel_is_the_identity(kind, x, y, cx):
    surface = surface_of(kind, cx=cx, cy=450.0)
    if kind not in (
        "planar",
        "pannini",
    ):  # a longitude is known up to a turn: only pixels within half a turn of the middle
        half = np.pi * surface.scale_px
        x = float(np.clip(x, 749.5 - half + 1e-6, 749.5 + half - 1e-6))
    ray = surface.pixel_to_ray([x, y])
    assert abs(np.linalg.norm(ray) - 1) < 1e-12
    np.testing.assert_allclose(surface.ray_to_pixel(3.0 * ray), [x, y], atol=1e-6)


def test_nothing_behind_a_plane_and_nothing_above_a_cylinder():
    assert np.isnan(surface_of("planar").ray_to_pixel([0.1, 0.1, -1.0])).all()
    assert np.isnan(surface_of("cylindrical").ray_to_pixel([0.0, -1.0, 0.0])[1])


@pytest.mark.parametrize(
    ("pans_deg", "expected"),
    [((-8, 8), "planar"), ((-30, 30), "pannini"), ((-60, 60), "equirectangular")],
)
def test_kind_follows_the_field_of_view(pans_deg, expected):
    frames = sweep(pans_deg, n=5, f_px=800.0, size_px=(480, 270))  # 33 degrees wide
    assert choose_surface(frames).kind == expected


@pytest.mark.parametrize("kind", KINDS)
def test_crop_holds_every_frame_and_wastes_little(kind):
    frames = sweep((-12, 20), n=7, f_px=900.0, size_px=(640, 360), tilt_deg=4.0, k1=-0.05)
    surface = choose_surface(frames, kind)
    assert surface.scale_px == pytest.approx(900.0, rel=1e-3)
    assert (surface.cx - 0.5) % 1 == 0 and (surface.cy - 0.5) % 1 == 0
    edge = np.stack(np.meshgrid(np.linspace(-0.5, 639.5, 41), np.linspace(-0.5, 359.5, 23)), -1).reshape(
        -1, 2
    )
    pixels = np.concatenate([surface.ray_to_pixel(p.pixel_to_ray(edge)) for p in frames])
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert (low > -1.5).all() and (high < [surface.width + 0.5, surface.height + 0.5]).all()
    assert (low < 1.5).all() and (high > [surface.width - 2.5, surface.height - 2.5]).all()


def test_full_turn_is_an_even_number_of_pixels_and_a_pan_across_the_back_is_one_piece():
    frames = sweep((150, 230), n=21, f_px=500.0, size_px=(400, 300))
    surface = choose_surface(frames)
    assert surface.kind == "equirectangular"
    assert (2 * np.pi * surface.scale_px) % 2 == pytest.approx(0, abs=1e-6)
    assert surface.width < 500 * np.radians(80 + 60)
    xy = surface.ray_to_pixel(frames[-1].pixel_to_ray(np.array([[199.5, 149.5]])))[0]
    assert 0 < xy[0] < surface.width and surface.ray_to_pixel(surface.pixel_to_ray(xy))[0] == pytest.approx(
        xy[0]
    )


def test_more_than_a_turn_is_cut_to_one():
    surface = choose_surface(sweep((0, 500), n=60, f_px=200.0, size_px=(200, 100)))
    assert surface.width <= np.ceil(2 * np.pi * surface.scale_px) + 1


def test_pixel_budget_binds_and_finest_zoom_sets_the_scale():
    frames = [*sweep((-20, 20), n=100, f_px=700.0), *sweep((0, 1), n=10, f_px=1900.0)]
    assert choose_surface(frames).scale_px == pytest.approx(1900.0, rel=1e-3)
    small = choose_surface(frames, max_pixels=1e5)
    assert small.width * small.height <= 1e5 < 1.1 * small.width * small.height


def test_one_broken_zoom_does_not_set_the_scale_and_broken_outlines_are_left_out():
    frames = sweep((-20, 20), n=100, f_px=700.0)
    frames.append(Pinhole(frame=100, f_px=90000.0))
    frames.append(Pinhole(frame=101, f_px=np.nan))
    assert choose_surface(frames).scale_px == pytest.approx(700.0, rel=1e-2)
    with pytest.raises(ValueError, match="finite outline"):
        choose_surface(frames[-1:])


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"kind": "conic"}, "conic"), ({"width": 0}, "0 x 640"), ({"scale_px": np.nan}, "nan")],
)
def test_impossible_surfaces_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        surface_of(**({"kind": "planar"} | changes))
