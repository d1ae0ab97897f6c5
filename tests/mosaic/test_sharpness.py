"""Detail and lines of a composite: a lettered hoarding stays as sharp as in the sharpest frame, lines do not step."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mosaic.surface import choose_surface
from tests.mosaic.pinhole import Pinhole
from tests.mosaic.scenes import composite_of

F_PX = 500.0
FINE = 4  # px of the painted plane per px of a frame


def hoarding():
    """A plane at z = 1, FINE x F_PX px per unit: letters about its middle, a straight white line below them."""
    plane = np.full((1200, 4000, 3), (40, 110, 50), np.uint8)
    cv2.rectangle(plane, (0, 420), (3999, 640), (20, 40, 130), -1)
    cv2.putText(
        plane, "MOSAIC FJORD TELEVOX QUARZ", (300, 600), cv2.FONT_HERSHEY_DUPLEX, 6.0, (250, 250, 250), 16
    )
    for x in range(4000):  # a line that rises by 1 in 20, five frame px wide, exact to a fine pixel
        plane[int(900 - x / 20) : int(920 - x / 20), x] = 235
    return cv2.GaussianBlur(plane, (0, 0), 0.5 * FINE)  # what a frame's pixels average


def seen_by(placement, plane, smear_px=0):
    """What the placement sees of the plane, smeared sideways over smear_px."""
    xy = np.stack(np.meshgrid(*(np.arange(n) for n in placement.size_px)), axis=-1).astype(float)
    rays = placement.pixel_to_ray(xy)
    at = rays[..., :2] / rays[..., 2:] * F_PX * FINE + np.array(plane.shape[1::-1]) / 2
    view = cv2.remap(plane, *np.moveaxis(at.astype(np.float32), -1, 0), cv2.INTER_LINEAR)
    return cv2.blur(view, (smear_px, 1)) if smear_px else view


def composite_of_hoarding(folder, *, smear_px, error_px):
    rng, plane = np.random.default_rng(4), hoarding()
    frames = [
        Pinhole(
            frame=6 * k, size_px=(480, 270), f_px=F_PX, pan_deg=pan, blur_px=float(smear_px if k % 3 else 0)
        )
        for k, pan in enumerate(np.linspace(-9, 9, 25))
    ]
    pictures = [seen_by(p, plane, int(p.blur_px)) for p in frames]
    turn = np.degrees(error_px / F_PX)
    said = [
        replace(p, pan_deg=p.pan_deg + turn * rng.normal(), tilt_deg=p.tilt_deg + turn * rng.normal())
        for p in frames
    ]
    surface = choose_surface(said, "planar", px_per_rad=F_PX)
    return composite_of(folder, said, surface, pictures), frames, pictures


def gradient_energy(rgb):
    gray = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(float)
    return float(sum((g**2).mean() for g in np.gradient(gray)))


@pytest.mark.parametrize("smear_px", [0, 5])
def test_letters_are_as_sharp_as_in_the_sharpest_frame_that_sees_them(tmp_path, smear_px):
    panorama, frames, pictures = composite_of_hoarding(tmp_path, smear_px=smear_px, error_px=0.1)
    middle = 12  # pan 0, sharp: the same place in the same scale as a planar panorama
    assert frames[middle].pan_deg == 0 and frames[middle].blur_px == 0
    box = np.array([[100.0, 85.0], [380.0, 140.0]])
    (x0, y0), (x1, y1) = np.rint(panorama.surface.ray_to_pixel(frames[middle].pixel_to_ray(box))).astype(int)
    sharpest = gradient_energy(pictures[middle][85:140, 100:380])
    assert gradient_energy(panorama.image[y0:y1, x0:x1]) > 0.95 * sharpest
    if smear_px:
        assert gradient_energy(pictures[middle + 1][85:140, 100:380]) < 0.8 * sharpest


def test_a_line_across_frame_borders_does_not_step(tmp_path):
    panorama, _, _ = composite_of_hoarding(tmp_path, smear_px=0, error_px=0.15)
    seen = panorama.n_seen >= 3
    blue = panorama.image[..., 2].astype(float)  # where the line stands out most from grass
    columns, centre = [], []
    for x in range(0, panorama.surface.width, 2):
        ray = np.array([(x - panorama.surface.cx) / panorama.surface.scale_px, 0.0, 1.0])
        u = ray[0] * F_PX * FINE + 2000
        middle = panorama.surface.ray_to_pixel([ray[0], (910 - u / 20 - 600) / (F_PX * FINE), 1.0])[1]
        rows = np.arange(round(middle) - 7, round(middle) + 8)
        if rows[0] < 0 or rows[-1] >= len(blue) or not seen[rows, x].all():
            continue
        weight = np.maximum(blue[rows, x] - 60, 0)
        columns.append(x)
        centre.append(float((weight * rows).sum() / weight.sum()))
    assert len(columns) > 250
    straight = np.polyval(np.polyfit(columns, centre, 1), columns)
    off = np.array(centre) - straight
    assert np.abs(off).max() < 0.5
    assert np.abs(np.diff(centre) - np.diff(straight)).max() < 0.5
