"""The surface a panorama is painted on (sphere, cylinder, plane, Pannini's) and its map between pixels and rays.

Rays are directions in the shot world: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left
pixel. With ray = (cos lat sin lon, -sin lat, cos lat cos lon):

    equirectangular  x = cx + s lon,   y = cy - s lat
    cylindrical      x = cx + s lon,   y = cy - s tan lat
    planar           x = cx + s X/Z,   y = cy + s Y/Z
    pannini          x = cx + s q sin lon,  y = cy - s q tan lat,  q = 2 / (1 + cos lon)

Pannini's is a cylinder seen from the opposite side of its axis: upright lines and lines through the middle stay
straight as on a plane, the others bend less than on a cylinder; at 50 degrees it stretches 1.2 times, a plane 2.4.

It does not know how a frame sees a ray: that is a Placement, made by whoever knows the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

SurfaceKind = Literal["equirectangular", "cylindrical", "planar", "pannini"]
KINDS: tuple[SurfaceKind, ...] = ("equirectangular", "cylindrical", "planar", "pannini")

# A plane stretches by 1/cos^2 of the angle to its centre: 1.5 times at 35 degrees. Up to about 50 degrees in all
# that is not noticed and straight lines stay straight; a cylinder stretches by 1/cos^2 of the latitude only.
PLANAR_TOTAL_RAD = np.radians(50.0)
PLANAR_SIDE_RAD = np.radians(35.0)
PANNINI_PAN_RAD = np.radians(100.0)
PANNINI_TILT_RAD = np.radians(60.0)
PANNINI_SIDE_RAD = np.radians(45.0)
# Asked for explicitly, plane and cylinder are cut where they would stretch to infinity (1/cos^2 = 15).
CUT_RAD = np.radians(75.0)
PANNINI_CUT_RAD = np.radians(150.0)  # where it is stretched 15 times


class Placement(Protocol):
    """How one frame looks at the world. Rays are in the world of the Surface; pixels are raw (distorted) ones.

    px_per_rad: resolution at the frame's centre. blur_px: length of the smear by motion, 0 for a still camera.
    ray_to_pixel: (..., 3) -> (..., 2) float64, NaN where behind the camera or outside the distortion model.
    pixel_to_ray: (..., 2) -> (..., 3) unit length.
    """

    @property
    def frame(self) -> int: ...
    @property
    def size_px(self) -> tuple[int, int]: ...
    @property
    def px_per_rad(self) -> float: ...
    @property
    def blur_px(self) -> float: ...
    def ray_to_pixel(self, rays: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def pixel_to_ray(self, xy: NDArray[np.float64]) -> NDArray[np.float64]: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """A cropped panorama surface: scale_px in px per radian (px per unit of X/Z on a plane), cx, cy where the
    world's forward axis falls (px, may lie outside the crop), width and height of the crop in px."""

    kind: SurfaceKind
    scale_px: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"surface kind is {self.kind!r}, must be one of {', '.join(KINDS)}")
        if not (np.isfinite(self.scale_px) and self.scale_px > 0 and np.isfinite(self.cx + self.cy)):
            raise ValueError(
                f"surface scale {self.scale_px} and centre ({self.cx}, {self.cy}) must be finite"
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"surface size {self.width} x {self.height} is empty")

    def reduced(self, shrink: float) -> Surface:
        """The same surface in pixels `shrink` times larger; the last ones may reach beyond it."""
        return Surface(
            kind=self.kind, scale_px=self.scale_px / shrink, cx=(self.cx + 0.5) / shrink - 0.5,
            cy=(self.cy + 0.5) / shrink - 0.5, width=int(np.ceil(self.width / shrink)),
            height=int(np.ceil(self.height / shrink)),
        )  # fmt: skip

    @property
    def centre_lon_rad(self) -> float:
        """Longitude of the crop's middle: longitudes are taken within half a turn of it (0 on a plane, and on Pannini's
        surface, which ends half a turn from the forward axis)."""
        return 0.0 if self.kind in ("planar", "pannini") else ((self.width - 1) / 2 - self.cx) / self.scale_px

    def pixel_to_ray(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Panorama pixels (..., 2) -> unit rays (..., 3)."""
        points = np.asarray(xy, dtype=np.float64)
        if points.shape[-1:] != (2,):
            raise ValueError(f"pixels have shape {points.shape}, need (..., 2)")
        a = (points[..., 0] - self.cx) / self.scale_px
        b = (points[..., 1] - self.cy) / self.scale_px
        if self.kind == "equirectangular":
            return np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)
        if self.kind == "cylindrical":
            ray = np.stack([np.sin(a), b, np.cos(a)], axis=-1)
        elif self.kind == "pannini":
            lon = 2 * np.arctan(a / 2)
            ray = np.stack([np.sin(lon), b * (1 + np.cos(lon)) / 2, np.cos(lon)], axis=-1)
        else:
            ray = np.stack([a, b, np.ones_like(a)], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def ray_to_pixel(self, rays: ArrayLike) -> NDArray[np.float64]:
        """Rays (..., 3), any length -> panorama pixels (..., 2), inside the crop or not.

        NaN where the surface has no such point: behind a plane, straight up or down on a cylinder.
        """
        ray = np.asarray(rays, dtype=np.float64)
        if ray.shape[-1:] != (3,):
            raise ValueError(f"rays have shape {ray.shape}, need (..., 3)")
        x, y, z = ray[..., 0], ray[..., 1], ray[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "planar":
                front = z > 0
                a = np.where(front, x / z, np.nan)
                b = np.where(front, y / z, np.nan)
            else:
                # Within half a turn of the crop's middle, so that a pan across +-180 degrees is one piece.
                middle = self.centre_lon_rad
                a = middle + np.remainder(np.arctan2(x, z) - middle + np.pi, 2 * np.pi) - np.pi
                flat = np.hypot(x, z)
                b = (
                    np.arctan2(y, flat)
                    if self.kind == "equirectangular"
                    else np.where(flat > 0, y / flat, np.nan)
                )
                if self.kind == "pannini":
                    q = 2 / (1 + np.cos(a))
                    a, b = q * np.sin(a), q * b
        return np.stack([self.cx + self.scale_px * a, self.cy + self.scale_px * b], axis=-1)


def choose_surface(
    placements: Sequence[Placement],
    kind: SurfaceKind | Literal["auto"] = "auto",
    *,
    max_pixels: float = 60e6,
    px_per_rad: float | None = None,
) -> Surface:
    """The surface for a shot: kind by the field of view, scale by the finest zoom, crop by the frames' outlines.

    kind 'auto': a plane below 50 degrees in all, Pannini up to 100 x 60, else equirectangular. px_per_rad: scale
    to use instead of the finest zoom that 2 % of the frames reach (a single frame gone wrong must not set it).
    max_pixels bounds width x height, whatever the scale asked for. The forward axis falls half-way between two
    pixels (cx, cy = n + .5) and a full equirectangular turn is an even number of pixels: GPano and Hugin count so.
    Raises ValueError when no placement has a finite outline or the budget is not positive.
    """
    if kind != "auto" and kind not in KINDS:
        raise ValueError(f"surface kind is {kind!r}, must be auto or one of {', '.join(KINDS)}")
    if not max_pixels >= 1:
        raise ValueError(f"max_pixels is {max_pixels}, must be at least 1")
    outlines = _outlines(placements)
    lon, lat = outlines[:, 0], outlines[:, 1]
    pan, tilt = np.ptp(lon), np.ptp(lat)
    if kind == "auto":
        if max(pan, tilt) < PLANAR_TOTAL_RAD and np.abs(outlines).max() < PLANAR_SIDE_RAD:
            kind = "planar"
        elif pan <= PANNINI_PAN_RAD and tilt <= PANNINI_TILT_RAD and np.abs(lat).max() < PANNINI_SIDE_RAD:
            kind = "pannini"
        else:
            kind = "equirectangular"
    scale = px_per_rad
    if scale is None:
        zooms = np.array([p.px_per_rad for p in placements], dtype=np.float64)
        scale = float(np.quantile(zooms[np.isfinite(zooms)], 0.98, method="higher"))
    unit = _unit_bounds(kind, lon, lat)
    area = float(np.prod(unit[1] - unit[0]))
    scale = min(scale, float(np.sqrt(max_pixels / max(area, 1e-12))))
    # Rounding the crop outwards adds up to two pixels a side: shrink until the budget holds.
    for _ in range(50):
        surface = _crop(kind, scale, unit)
        if surface.width * surface.height <= max_pixels:
            return surface
        scale *= 0.99
    raise ValueError(f"max_pixels {max_pixels} is too small for any {kind} panorama of these frames")


def _outlines(placements: Sequence[Placement]) -> NDArray[np.float64]:
    """Longitude and latitude (n, 2) of points on a grid over every frame, borders included; longitude continuous."""
    stride = max(1, len(placements) // 4000)
    rays = []
    for placement in placements[::stride]:
        width, height = placement.size_px
        x, y = np.meshgrid(np.linspace(-0.5, width - 0.5, 17), np.linspace(-0.5, height - 0.5, 11))
        rays.append(placement.pixel_to_ray(np.stack([x, y], axis=-1).reshape(-1, 2)))
    if not rays:
        raise ValueError("no placement to choose a surface for")
    ray = np.stack(rays)  # (frames, points, 3)
    centre = ray[:, ray.shape[1] // 2]
    finite_frame = np.isfinite(centre).all(axis=-1)
    if not finite_frame.any():
        raise ValueError(f"none of {len(placements)} placements has a finite outline")
    ray, centre = ray[finite_frame], centre[finite_frame]
    middle = np.unwrap(np.arctan2(centre[:, 0], centre[:, 2]))[:, None]
    lon = np.arctan2(ray[..., 0], ray[..., 2])
    lon = middle + np.remainder(lon - middle + np.pi, 2 * np.pi) - np.pi
    lat = -np.arctan2(ray[..., 1], np.hypot(ray[..., 0], ray[..., 2]))
    points = np.stack([lon, lat], axis=-1).reshape(-1, 2)
    return points[np.isfinite(points).all(axis=-1)]


def _unit_bounds(
    kind: SurfaceKind, lon: NDArray[np.float64], lat: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[[x0, y0], [x1, y1]] of the outlines on the surface of scale 1 about its centre."""
    if kind == "planar":
        inside = (np.abs(lon) < CUT_RAD) & (np.abs(lat) < CUT_RAD)
        if not inside.any():
            raise ValueError(
                "a planar panorama needs frames that look forward: every outline lies beyond 75 degrees"
            )
        x, y = np.tan(lon[inside]), -np.tan(lat[inside]) / np.cos(lon[inside])
    else:
        x = np.clip(lon, -PANNINI_CUT_RAD, PANNINI_CUT_RAD) if kind == "pannini" else lon
        y = -lat if kind == "equirectangular" else -np.tan(np.clip(lat, -CUT_RAD, CUT_RAD))
        if kind == "pannini":
            y = 2 / (1 + np.cos(x)) * y
            x = 2 * np.tan(x / 2)
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    if (
        kind in ("equirectangular", "cylindrical") and high[0] - low[0] > 2 * np.pi
    ):  # more than a turn: one turn about its middle
        low[0], high[0] = (low[0] + high[0]) / 2 - np.pi, (low[0] + high[0]) / 2 + np.pi
    return np.stack([low, high])


def _crop(kind: SurfaceKind, scale: float, unit: NDArray[np.float64]) -> Surface:
    if kind == "equirectangular":
        scale = max(1.0, np.floor(np.pi * scale)) / np.pi  # full turn: an even number of pixels
    # Pixel edges at whole multiples of 1/scale from the forward axis; the first pixel's centre half a pixel in.
    first = np.floor(unit[0] * scale + 1e-9).astype(int)
    last = np.ceil(unit[1] * scale - 1e-9).astype(int)
    width, height = (int(n) for n in np.maximum(last - first, 1))
    return Surface(
        kind=kind,
        scale_px=float(scale),
        cx=-float(first[0]) - 0.5,
        cy=-float(first[1]) - 0.5,
        width=width,
        height=height,
    )
