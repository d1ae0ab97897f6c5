"""The environment as a picture: a cylinder around the pan axis, painted once, with mip levels and an exact address.

Level l: x = (s / 2^l) (lon - lon_left), y = (s / 2^l) (tan_top - tan lat), lon = atan2(X, Z), tan lat = -Y / hypot(X,
Z).
Texel 0 of every level lies on the same ray, so levels differ in sharpness only. Each level has a point spread of
PSF_PX of its own texels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tests.synth.camera import SynthCamera
from tests.synth.goals import draw_goals
from tests.synth.paint import paint_rows, paint_strip
from tests.synth.stadium import Stadium, make_stadium, seen_from

PSF_PX = 0.6  # Gaussian sigma; MTF .17 at Nyquist, as a broadcast chain has, and no visible aliasing
_DECIMATION_BLUR_PX = PSF_PX * np.sqrt(3.0)  # (2 PSF)^2 - PSF^2: the next level has PSF_PX of its own again
TEXTURES = ("full", "band", "arena")

_SHIRTS = np.array(
    [
        [190, 30, 40], [40, 70, 180], [235, 235, 235], [30, 30, 34], [120, 120, 125], [20, 30, 70], [220, 190, 60],
        [60, 110, 70], [150, 110, 80], [200, 170, 150], [90, 140, 200], [230, 230, 225], [60, 60, 66], [160, 60, 110],
    ],
    dtype=np.float64,
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSpec:
    """What to paint. texture: full, band (low texture on grass and above the lower tier) or arena. px_per_rad: texels
    a radian of level 0. board_height_m: hoardings; 6 m cover about 10 % of a picture. camera_moved_m: towards the
    pitch and up, from where the camera stands otherwise."""

    seed: int = 1
    texture: str = "full"
    px_per_rad: float = 4200.0
    board_height_m: float = 1.6
    camera_moved_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.texture not in TEXTURES:
            raise ValueError(f"texture {self.texture!r} is none of {TEXTURES}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """levels[l] (h, w, 3) uint8 RGB; address as the module says. stadium gives depths to whoever needs them."""

    levels: tuple[np.ndarray, ...]
    px_per_rad: float
    lon_left: float
    tan_top: float
    stadium: Stadium

    def rays_to_texel(self, rays: np.ndarray) -> np.ndarray:
        """Directions (..., 3) from the pan axis -> level-0 texel coordinates (..., 2)."""
        horizontal = np.hypot(rays[..., 0], rays[..., 2])
        lon = np.arctan2(rays[..., 0], rays[..., 2])
        x = self.px_per_rad * (lon - self.lon_left)
        y = self.px_per_rad * (self.tan_top + rays[..., 1] / horizontal)
        return np.stack([x, y], axis=-1)


def build_levels(level0: np.ndarray, n_levels: int = 4) -> tuple[np.ndarray, ...]:
    """Mip levels of an environment whose level 0 already has a point spread of PSF_PX."""
    levels = [level0]
    for _ in range(n_levels - 1):
        if min(levels[-1].shape[:2]) < 64:
            break
        smooth = cv2.GaussianBlur(levels[-1], (0, 0), _DECIMATION_BLUR_PX, borderType=cv2.BORDER_REFLECT_101)
        levels.append(np.ascontiguousarray(smooth[::2, ::2]))
    return tuple(levels)


def window_of(cameras: Sequence[SynthCamera], margin_rad: float) -> tuple[float, float, float, float]:
    """lon_min, lon_max, tan_min, tan_max that the cameras' borders see, with a margin."""
    lons, tans = [], []
    for camera in cameras:
        w, h = camera.width - 1, camera.height - 1
        t = np.linspace(0, 1, 17)
        border = np.concatenate(
            [
                np.stack(p, -1)
                for p in ((w * t, 0 * t), (w * t, 0 * t + h), (0 * t, h * t), (0 * t + w, h * t))
            ]
        )
        rays = camera.pixel_to_ray(border)
        lons.append(np.arctan2(rays[:, 0], rays[:, 2]))
        tans.append(-rays[:, 1] / np.hypot(rays[:, 0], rays[:, 2]))
    lon, tan = np.concatenate(lons), np.concatenate(tans)
    return (
        float(lon.min() - margin_rad),
        float(lon.max() + margin_rad),
        float(tan.min() - margin_rad),
        float(tan.max() + margin_rad),
    )


def make_world(spec: WorldSpec, cameras: Sequence[SynthCamera]) -> World:
    """Paint what the cameras see. Deterministic in spec; the window changes no colour, only what is there."""
    s = spec.px_per_rad
    pupil = max((c.pupil_m for c in cameras), default=0.0)
    lon0, lon1, tan0, tan1 = window_of(cameras, 12 / min(s, 1500.0) + pupil * 0.03)
    # anchored to whole texels of the coarsest level, so that windows of one world share their texels
    lon_left, tan_top = np.floor(lon0 * s / 8) * 8 / s, np.ceil(tan1 * s / 8) * 8 / s
    w, h = int(np.ceil((lon1 - lon_left) * s)) + 1, int(np.ceil((tan_top - tan0) * s)) + 1
    stadium = make_stadium(arena=spec.texture == "arena", board_height_m=spec.board_height_m)
    stadium = seen_from(stadium, *spec.camera_moved_m)
    rng = np.random.default_rng([spec.seed, 7])
    distance = float(stadium.faces[0, 2])
    res = min(64.0, 1.2 * s / distance)
    board = paint_strip(rng, spec.board_height_m, res)
    ribbon = paint_strip(rng, 0.35 * float(stadium.profile[3, 3] - stadium.profile[3, 1]), res)
    colours = _SHIRTS.copy()
    colours[:2] = colours[rng.permutation(len(colours))[:2]]
    grass, plain = (0.35, 1.0) if spec.texture == "band" else (1.0, 0.0)
    level0 = np.empty((h, w, 3), np.uint8)
    for first in range(
        0, h, 256
    ):  # in strips: the float picture of a large window would be four times the memory
        pad0, pad1 = min(first, 4), min(h - min(first + 256, h), 4)
        rows = np.empty((min(256, h - first) + pad0 + pad1, w, 3), np.float32)
        paint_rows(
            rows,
            first - pad0,
            lon_left,
            tan_top,
            s,
            stadium,
            spec.seed * 1000,
            grass,
            plain,
            board,
            ribbon,
            colours,
        )
        soft = cv2.GaussianBlur(rows, (7, 7), PSF_PX, borderType=cv2.BORDER_REFLECT_101)
        level0[first : first + 256] = np.clip(soft[pad0 : len(rows) - pad1] + 0.5, 0, 255)

    def to_texel(points: np.ndarray) -> np.ndarray:
        horizontal = np.hypot(points[..., 0], points[..., 2])
        lon = np.arctan2(points[..., 0], points[..., 2])
        return np.stack([s * (lon - lon_left), s * (tan_top + points[..., 1] / horizontal)], axis=-1)

    draw_goals(level0, stadium, to_texel, s)
    return World(
        levels=build_levels(level0),
        px_per_rad=s,
        lon_left=float(lon_left),
        tan_top=float(tan_top),
        stadium=stadium,
    )
