"""The clean plate: a shot's panorama as any camera would see it, and the light that a frame was taken in beside it.

The panorama is read whole with its half-size levels (a third more), once; the level is chosen so that no pixel of it
is skipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from mosaic.framestore import eight_bits
from mosaic.surface import Surface
from pipelines.errors import InputError
from pipelines.exports.panorama_json import read_surface
from pipelines.render.views import View, dense_map, node_grid

MARGIN = 4  # px of the panorama beside what is read: the reach of the cubic, and a little
KEEP = 0.6  # of the pixels, those with the smallest residual, decide the light: players are seldom more than the rest
N_LIGHT = 10_000
MIN_LIGHT = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """frame = gain * plate + offset, per colour (3,)."""

    gain: NDArray[np.float32]
    offset: NDArray[np.float32]

    def applied(self, plate: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The plate (..., 3) in this light, float32, not clipped."""
        return plate.astype(np.float32) * self.gain + self.offset


SAME_LIGHT = Light(gain=np.ones(3, np.float32), offset=np.zeros(3, np.float32))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plate:
    """surface: pixel to ray of the full picture. levels: RGBA (h, w, 4) uint8, each half the size of the one before."""

    surface: Surface
    levels: tuple[NDArray[np.uint8], ...]

    def seen_by(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The plate in a view: (h, w, 3) RGB, black where never seen, and (h, w) where it was seen."""
        nodes = self.surface.ray_to_pixel(view.pixel_to_ray(node_grid(view.size_px)))
        level = self._level(nodes)
        picture = self.levels[level]
        # Level n's pixel centre i lies at 2^n (i + .5) - .5 of the full picture's.
        scale = 2.0**level
        map_x, map_y = dense_map((nodes + 0.5) / scale - 0.5, view.size_px)
        x0, y0, x1, y1 = _bounds(map_x, map_y, picture.shape[1], picture.shape[0])
        if x1 <= x0 or y1 <= y0:
            return np.zeros((*map_x.shape, 3), np.uint8), np.zeros(map_x.shape, bool)
        # remap counts pixels in 16 bits: what is not needed stays out.
        rgba = cv2.remap(
            picture[y0:y1, x0:x1], map_x - x0, map_y - y0, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT
        )
        alpha = rgba[..., 3]
        known = alpha > 127
        rgb = np.ascontiguousarray(rgba[..., :3]).astype(np.uint8, copy=False)
        rgb[~known] = 0
        # Unseen pixels are black, so that the mixture at their border is dark by as much as alpha is below 255.
        border = known & (alpha < 255)
        full = rgb[border] * (255.0 / alpha[border].astype(np.float32))[:, None]
        rgb[border] = np.clip(full + 0.5, 0, 255).astype(np.uint8)
        return rgb, known

    def _level(self, nodes: NDArray[np.float64]) -> int:
        """The level on which neighbouring pixels of the view are at least one pixel apart, across and down."""
        across = np.linalg.norm(np.diff(nodes, axis=1), axis=-1) / 8.0
        down = np.linalg.norm(np.diff(nodes, axis=0), axis=-1) / 8.0
        steps = [float(np.median(s[np.isfinite(s)])) for s in (across, down) if np.isfinite(s).any()]
        if not steps:
            return 0
        return int(np.clip(np.floor(np.log2(max(min(steps), 1.0)) + 0.1), 0, len(self.levels) - 1))


def read_plate(path: Path) -> Plate:
    """A panorama.tif with the panorama.json beside it. Raises InputError: damaged."""
    try:
        surface = read_surface(path.with_suffix(".json"))
        with tifffile.TiffFile(path) as tiff:
            levels = tuple(eight_bits(level.asarray()) for level in tiff.series[0].levels)
    except (OSError, ValueError, KeyError, tifffile.TiffFileError) as error:
        raise InputError(path, f"cannot be read ({error})", "run again, into this folder") from None
    if levels[0].shape != (surface.height, surface.width, 4):
        raise InputError(path, "does not fit its panorama.json", "run again, into this folder")
    return Plate(surface=surface, levels=levels)


def fit_light(frame: NDArray[np.uint8], plate: NDArray[np.uint8], known: NDArray[np.bool_]) -> Light:
    """Gain and offset per colour that make the plate look like the frame; pictures (h, w, 3), known (h, w).

    Least squares over the 60 % of pixels that fit best, found in four rounds: what stands in front does not count.
    SAME_LIGHT where fewer than 200 pixels are common.
    """
    stride = max(1, int(np.sqrt(known.size / N_LIGHT)))
    inside = known[::stride, ::stride]
    a = plate[::stride, ::stride][inside].astype(np.float64)
    b = frame[::stride, ::stride][inside].astype(np.float64)
    if len(a) < MIN_LIGHT:
        return SAME_LIGHT
    gain, offset = np.ones(3), np.median(b - a, axis=0)
    for _ in range(4):
        residual = np.abs(b - gain * a - offset).max(axis=1)
        keep = residual <= np.quantile(residual, KEEP)
        x, y = a[keep], b[keep]
        centred = x - x.mean(axis=0)
        variance = (centred**2).mean(axis=0)
        slope = (centred * (y - y.mean(axis=0))).mean(axis=0) / np.maximum(variance, 1e-9)
        # A flat plate says nothing about a gain; one stop up or down is all that a shot's exposure does.
        gain = np.where(variance > 4.0, np.clip(slope, 0.5, 2.0), 1.0)
        offset = y.mean(axis=0) - gain * x.mean(axis=0)
    return Light(gain=gain.astype(np.float32), offset=offset.astype(np.float32))


def _bounds(
    map_x: NDArray[np.float32], map_y: NDArray[np.float32], width: int, height: int
) -> tuple[int, int, int, int]:
    """The part x0, y0, x1, y1 of a picture that a map reads, with its margin; empty when it reads nothing."""
    inside = (map_x > -1) & (map_x < width) & (map_y > -1) & (map_y < height)
    if not inside.any():
        return 0, 0, 0, 0
    x, y = map_x[inside], map_y[inside]
    return (
        max(int(x.min()) - MARGIN, 0),
        max(int(y.min()) - MARGIN, 0),
        min(int(x.max()) + MARGIN + 1, width),
        min(int(y.max()) + MARGIN + 1, height),
    )
