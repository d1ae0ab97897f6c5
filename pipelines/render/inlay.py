"""A picture put into the scene: four directions for its corners, drawn as any view sees it. Flat, as a board is.

A flat thing seen by a camera that only turns is fixed by the directions of its corners: where it stands and how far
away does not matter. Its picture is mapped by a homography from picture to direction, so perspective is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError

from pipelines.errors import InputError
from pipelines.render.views import STEP, View

FloatArray = NDArray[np.float64]

SUB = (
    2  # samples a pixel, each way: edges of a slanted board stay smooth (and sit at 32nds of STEP, see views)
)
LARGEST_PX = 8192
DEGENERATE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inlay:
    """levels: premultiplied RGBA float32 (h, w, 4) 0..255, halved again and again. G (3, 3): homogeneous pixel of the
    first level to direction."""

    levels: tuple[NDArray[np.float32], ...]
    G: FloatArray

    @property
    def size_px(self) -> tuple[int, int]:
        """(w, h) of the picture."""
        return self.levels[0].shape[1], self.levels[0].shape[0]

    def outline(self, n: int = 16) -> FloatArray:
        """(4 n, 3) directions along the border, from the top left corner clockwise."""
        w, h = self.size_px
        corners = _corners(w, h)
        points = np.concatenate(
            [
                a + np.linspace(0, 1, n, endpoint=False)[:, None] * (b - a)
                for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
            ]
        )
        return np.concatenate([points, np.ones((len(points), 1))], axis=1) @ self.G.T


def read_picture(path: Path) -> tuple[NDArray[np.float32], ...]:
    """A picture file's levels for an `Inlay`. Raises InputError: no such file, no picture, too large."""
    try:
        with Image.open(path) as image:
            if max(image.size) > LARGEST_PX:
                cause = f"is {image.size[0]} x {image.size[1]} px, more than {LARGEST_PX} a side"
                raise InputError(path, cause, "make it smaller")
            rgba = np.asarray(image.convert("RGBA"), np.float32).copy()
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise InputError(path, f"is no picture that can be read ({error})", "give a PNG") from None
    return picture_levels(rgba)


def picture_levels(rgba: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """(h, w, 4) RGBA 0..255, not premultiplied, to the levels of an `Inlay`."""
    levels = [
        np.concatenate([rgba[..., :3] * (rgba[..., 3:] / 255), rgba[..., 3:]], axis=-1).astype(np.float32)
    ]
    while min(levels[-1].shape[:2]) > 1:
        h, w = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
        levels.append(half.astype(np.float32, copy=False))
    return tuple(levels)


def place(levels: Sequence[NDArray[np.float32]], corner_rays: ArrayLike) -> Inlay:
    """The picture with its corners (top left, top right, bottom right, bottom left) at directions (4, 3).

    Raises ValueError: three corners in one line, or an order that crosses over.
    """
    rays = np.asarray(corner_rays, np.float64)
    if rays.shape != (4, 3) or not np.isfinite(rays).all():
        raise ValueError(f"corners are {rays.shape}, need four finite directions")
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    h, w = levels[0].shape[:2]
    source = np.concatenate([_corners(w, h), np.ones((4, 1))], axis=1)
    # How the fourth corner is made of the first three, in the picture and in the scene: the ratios are the scales.
    if abs(np.linalg.det(rays[:3])) < DEGENERATE:
        raise ValueError("three of the four corners lie in one line")
    a, b = np.linalg.solve(source[:3].T, source[3]), np.linalg.solve(rays[:3].T, rays[3])
    scales = b / a
    if (np.abs(b) < DEGENERATE).any():
        raise ValueError("three of the four corners lie in one line")
    if (scales < 0).any():
        raise ValueError(
            "the outline crosses itself or is bent inwards: go round it, from the top left clockwise"
        )
    G = (rays[:3].T * scales) @ np.linalg.inv(source[:3].T)
    return Inlay(levels=tuple(levels), G=G)


def draw(inlay: Inlay, view: View) -> tuple[tuple[slice, slice], NDArray[np.float32]] | None:
    """The inlay as a view sees it: rows and columns of its box, and there premultiplied RGBA (h, w, 4) 0..255.

    None where it is not in the picture.
    """
    box = _box(view.ray_to_pixel(inlay.outline()), view.size_px)
    if box is None:
        return None
    x0, y0, x1, y1 = box
    nx, ny = (x1 - x0 - 1) // STEP + 3, (y1 - y0 - 1) // STEP + 3
    # One node beside the box on each side: the outermost samples lie outside the centres of its pixels.
    nodes = np.stack(
        np.meshgrid(x0 + STEP * (np.arange(nx) - 1.0), y0 + STEP * (np.arange(ny) - 1.0)), axis=-1
    )
    uvw = view.pixel_to_ray(nodes) @ np.linalg.inv(inlay.G).T
    with np.errstate(invalid="ignore", divide="ignore"):
        uv = np.where(uvw[..., 2:] > 0, uvw[..., :2] / uvw[..., 2:], np.nan)
    level, map_x, map_y = _sample_map(inlay, uv, x1 - x0, y1 - y0)
    rgba = cv2.remap(inlay.levels[level], map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    small = cv2.resize(rgba, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    return (slice(y0, y1), slice(x0, x1)), small.astype(np.float32, copy=False)


def _sample_map(
    inlay: Inlay, uv: FloatArray, width: int, height: int
) -> tuple[int, NDArray[np.float32], NDArray[np.float32]]:
    """Level, and its pixel for every sample of the box."""
    across, down = np.diff(uv, axis=1)[:-1], np.diff(uv, axis=0)[:, :-1]
    area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]) / (STEP * SUB) ** 2
    finite = area[np.isfinite(area)]
    step = np.sqrt(np.median(finite)) if len(finite) else 1.0
    level = int(np.clip(np.round(np.log2(max(step, 1.0))), 0, len(inlay.levels) - 1))
    w, h = inlay.size_px
    small_h, small_w = inlay.levels[level].shape[:2]
    uv = (uv + 0.5) * [small_w / w, small_h / h] - 0.5
    x, y = np.meshgrid(
        ((np.arange(width * SUB) + 0.5) / SUB - 0.5) / STEP + 1,
        ((np.arange(height * SUB) + 0.5) / SUB - 0.5) / STEP + 1,
    )
    dense = cv2.remap(uv.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    dense[~np.isfinite(dense).all(axis=-1)] = -1e6
    return level, np.ascontiguousarray(dense[..., 0]), np.ascontiguousarray(dense[..., 1])


def _corners(w: int, h: int) -> FloatArray:
    """Outer corners of the corner pixels (4, 2), from the top left clockwise."""
    return np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])


def _box(outline_px: FloatArray, size_px: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """x0, y0, x1, y1 of the part of the picture that an outline touches; the whole where some of it is behind."""
    w, h = size_px
    finite = np.isfinite(outline_px).all(axis=-1)
    if not finite.any():
        return None
    if not finite.all():
        return 0, 0, w, h
    low, high = np.floor(outline_px.min(axis=0)) - 1, np.ceil(outline_px.max(axis=0)) + 2
    x0, y0 = np.clip(low, 0, [w, h]).astype(int)
    x1, y1 = np.clip(high, 0, [w, h]).astype(int)
    return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else None
