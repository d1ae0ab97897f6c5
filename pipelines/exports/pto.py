"""panorama.pto: the same cameras for Hugin and nona, with the same output surface and crop.

Hugin's conventions against ours: pan, tilt, roll are y, p, r with the same signs and order; d, e are the principal
point minus the picture's middle; the radial polynomial is applied to radii in units of half the SHORTER side and has
to be 1 there, so that OpenCV's k1 becomes b together with a changed focal (formats.md A5). Hugin knows no aspect of
pixels other than 1. What is written here was measured against nona: median .035 px.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosaic.surface import Surface
from pipelines.exports.whole_file import whole_file

PROJECTIONS = {"planar": 0, "cylindrical": 1, "equirectangular": 2, "pannini": 19}


@dataclass(frozen=True, slots=True, kw_only=True)
class PtoFrame:
    """One picture of the project. name: its file. Angles in radians, camera.csv's convention; k1 is OpenCV's."""

    name: str
    size_px: tuple[int, int]
    f_px: float
    pan_rad: float
    tilt_rad: float
    roll_rad: float
    cx_px: float
    cy_px: float
    k1: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.f_px, self.pan_rad, self.tilt_rad, self.roll_rad, self.cx_px, self.cy_px, self.k1)
        if not np.isfinite(numbers).all() or self.f_px <= 0:
            raise ValueError(f"{self.name}: a Hugin camera needs finite numbers and f > 0, got {numbers}")
        if any(c in self.name for c in '"\n'):
            raise ValueError(f"a picture's name in a .pto may hold no quote or line end: {self.name!r}")


def hugin_lens(f_px: float, k1: float, size_px: tuple[int, int]) -> tuple[float, float]:
    """(g, b): Hugin's focal in px and its coefficient b for r_d = r (1 + k1 r^2), r in focal lengths.

    With h = half the shorter side and R = g tan(angle) / h, Hugin maps R -> R (b R^2 + 1 - b). Equal to ours when
    g (1 - b) = f and b g^3 / h^2 = f k1, hence g = f + f k1 h^2 / g^2. Raises ValueError when that has no solution
    (barrel distortion that folds back within half the shorter side).
    """
    h = min(size_px) / 2
    g = f_px
    for _ in range(60):
        g = f_px + f_px * k1 * (h / g) ** 2
    if not (np.isfinite(g) and abs(g - f_px - f_px * k1 * (h / g) ** 2) < 1e-9 * f_px):
        raise ValueError(f"k1 = {k1} at f = {f_px} px has no counterpart in Hugin's lens model")
    return float(g), float(1 - f_px / g)


def image_line(frame: PtoFrame) -> str:
    """Hugin's i-line of a frame."""
    width, height = frame.size_px
    g, b = hugin_lens(frame.f_px, frame.k1, frame.size_px)
    fields = {
        "v": np.degrees(2 * np.arctan(width / (2 * g))),
        "r": np.degrees(frame.roll_rad), "p": np.degrees(frame.tilt_rad), "y": np.degrees(frame.pan_rad),
        "a": 0.0, "b": b, "c": 0.0,
        "d": frame.cx_px - (width - 1) / 2, "e": frame.cy_px - (height - 1) / 2,
        "g": 0.0, "t": 0.0, "Eev": 0.0,
    }  # fmt: skip
    # repr of a plain float: nona reads "np.float64(49.1)" as nothing and silently takes 50 degrees.
    text = " ".join(f"{key}{float(value)!r}" for key, value in fields.items())
    return f'i w{width} h{height} f0 {text} n"{frame.name}"'


def panorama_line(surface: Surface) -> str:
    """Hugin's p-line: its canvas has the forward axis in the middle, our picture is the crop S of it."""
    # cx + .5 px lie left of the forward axis, width - that right of it; whole numbers for choose_surface's crops.
    left, top = surface.cx + 0.5, surface.cy + 0.5
    half_width = int(np.ceil(max(left, surface.width - left)))
    half_height = int(np.ceil(max(top, surface.height - top)))
    if surface.kind == "planar":
        field = np.degrees(2 * np.arctan(half_width / surface.scale_px))
    elif surface.kind == "pannini":
        field = np.degrees(4 * np.arctan(half_width / surface.scale_px / 2))
    else:
        field = np.degrees(2 * half_width / surface.scale_px)
    x0, y0 = round(half_width - left), round(half_height - top)
    crop = f"S{x0},{x0 + surface.width},{y0},{y0 + surface.height}"
    # Hugin's general Panini, compressed as Pannini's own and with upright lines straight above and below.
    shape = ' P"100 0 0"' if surface.kind == "pannini" else ""
    return (
        f"p f{PROJECTIONS[surface.kind]} w{2 * half_width} h{2 * half_height} v{float(field)!r} {crop}{shape} "
        'n"TIFF_m" E0 R0'
    )


def write_pto(path: str | os.PathLike[str], surface: Surface, frames: Sequence[PtoFrame]) -> None:
    """Write a project of the frames, rendered to the surface. Raises ValueError without frames, OSError when the
    folder cannot be written."""
    if not frames:
        raise ValueError("a Hugin project needs at least one frame")
    lines = ["# hugin project file, written by broadcast-mosaic", panorama_line(surface), "m i0", ""]
    lines += [image_line(frame) for frame in frames]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n\n", encoding="utf-8")
