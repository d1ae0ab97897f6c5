"""A frame of the stadium as a known camera sees it: environment, hoardings, players, exposure, sensor, screen graphics.

The environment is read with exact-float bicubic weights from the mip level just finer than the frame, blurred to the
frame's own sampling, so sharpness follows the zoom without steps and geometry stays exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tests.synth.camera import Array, SynthCamera
from tests.synth.players import Squad, draw_players
from tests.synth.sampling import NODE_MARGIN, Alive, expose, sample_frame, sample_points
from tests.synth.stadium import (
    BOARD,
    LOWER_TIER,
    UPPER_TIER,
    depths_along,
    perimeter_coordinate,
    profile_edges,
)
from tests.synth.world import PSF_PX, World

_NODE_STEP_PUPIL = 8  # px; parallax has kinks at the hoardings
_PUPIL_STEPS = 5  # fixed point: converges by pupil / depth (< 1 %) a step


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What light and electronics do to one frame. gain multiplies, offset adds (grey levels), vignette is the loss in
    the corner, noise_grey the luma's sigma."""

    gain: float = 1.0
    offset: float = 0.0
    vignette: float = 0.0
    noise_grey: float = 2.0
    noise_seed: int = 0


def texel_map(world: World, camera: SynthCamera, pixels: Array) -> Array:
    """Level-0 texel (..., 2) that each pixel (..., 2) of the camera shows, exact; parallax included if pupil_m."""
    rays = camera.pixel_to_ray(pixels)
    if camera.pupil_m == 0:
        return world.rays_to_texel(rays)
    pupil = camera.pupil_world_m
    flat = rays.reshape(-1, 3)
    seen = flat.copy()
    for _ in range(_PUPIL_STEPS):
        depth = depths_along(world.stadium, seen)
        # t with |pupil + t ray| = depth
        along = flat @ pupil
        t = -along + np.sqrt(along**2 + depth**2 - pupil @ pupil)
        seen = pupil + t[:, None] * flat
    return world.rays_to_texel(seen.reshape(rays.shape))


def node_step(camera: SynthCamera) -> int:
    """Spacing in px at which a cubic through exact nodes stays within 1e-3 px of the exact map [tested]."""
    if camera.pupil_m != 0:
        return _NODE_STEP_PUPIL
    return min(max(camera.width // 160, 4), 16)


def node_map(world: World, camera: SynthCamera, step: int) -> Array:
    """Texel coordinates on the node grid of sampling.expand_row."""
    nx = (camera.width - 1) // step + 3 + NODE_MARGIN
    ny = (camera.height - 1) // step + 3 + NODE_MARGIN
    x, y = np.meshgrid(
        (np.arange(nx) - NODE_MARGIN) * float(step), (np.arange(ny) - NODE_MARGIN) * float(step)
    )
    return texel_map(world, camera, np.stack([x, y], axis=-1))


def _level_for(world: World, px_per_rad: float) -> tuple[int, float]:
    """Finest level not coarser than wanted by more than its octave, and the blur (texels) that it lacks."""
    ratio = world.px_per_rad / px_per_rad
    level = int(np.clip(np.floor(np.log2(max(ratio, 1.0)) + 1e-9), 0, len(world.levels) - 1))
    left = ratio / 2**level
    return level, PSF_PX * float(np.sqrt(max(left**2 - 1, 0.0)))


@dataclass(slots=True, kw_only=True, eq=False)
class Renderer:
    """Renders one world. Holds the tables of what moves in it, nothing of the frames."""

    world: World
    _tables: Alive | None = None

    def render_clean(
        self, camera: SynthCamera, *, led_shift_m: float = 0.0, sway_m: float = 0.0, time_s: float = 0.0
    ) -> np.ndarray:
        """The environment alone (h, w, 3) uint8 RGB: no players, no noise, no graphics.

        led_shift_m: how far the hoardings' content has run; sway_m: how far people in the stands lean, at time_s.
        """
        step = node_step(camera)
        nodes = node_map(self.world, camera, step)
        level, blur = _level_for(self.world, camera.f_px)
        nodes /= 2.0**level
        image = self.world.levels[level]
        margin = 4 + int(np.ceil(4 * blur))
        lo, hi = nodes.reshape(-1, 2).min(axis=0), nodes.reshape(-1, 2).max(axis=0)
        x0, y0 = (int(max(np.floor(v) - margin, 0)) for v in lo)
        x1, y1 = (int(min(np.ceil(v) + margin, n)) for v, n in zip(hi, image.shape[1::-1], strict=True))
        alive = self._alive(level, blur, led_shift_m, sway_m, time_s)
        out = np.empty((camera.height, camera.width, 3), np.uint8)
        sample_frame(_blurred(image[y0:y1, x0:x1], blur), x0, y0, nodes, step, 2.0**level, alive, out)
        return out

    def sample_environment(self, rays: np.ndarray, px_per_rad: float) -> np.ndarray:
        """Clean environment at directions (..., 3) from the pan axis, as a picture of px_per_rad would show it.

        (..., 3) float32 RGB 0..255; NaN where nothing was painted.
        """
        level, blur = _level_for(self.world, px_per_rad)
        source = _blurred(self.world.levels[level], blur)
        texel = self.world.rays_to_texel(np.asarray(rays, dtype=np.float64)).reshape(-1, 2) / 2**level
        out = np.empty((len(texel), 3), np.float32)
        sample_points(source, texel[:, 0].copy(), texel[:, 1].copy(), out)
        return out.reshape(*np.shape(rays)[:-1], 3)

    def render(
        self,
        camera: SynthCamera,
        *,
        squad: Squad | None = None,
        time_s: float = 0.0,
        led_shift_m: float = 0.0,
        sway_m: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Scene with players -> (picture (h, w, 3) uint8, cover (h, w) uint8: 255 = player)."""
        image = self.render_clean(camera, led_shift_m=led_shift_m, sway_m=sway_m, time_s=time_s)
        cover = np.zeros(image.shape[:2], np.uint8)
        if squad is not None:
            draw_players(image, cover, squad, camera, self.world.stadium, time_s)
        return image, cover

    def _alive(self, level: int, blur: float, led_shift_m: float, sway_m: float, time_s: float) -> Alive:
        """Tables for one frame; the hoardings' rows are cut out and blurred only where their content runs."""
        if not led_shift_m and not sway_m:
            return _STILL
        if self._tables is None:
            self._tables = _make_tables(self.world)
        still = self._tables
        scale = self.world.px_per_rad / float(
            self.world.stadium.faces[0, 2]
        )  # texels a metre, opposite the camera
        alive = still._replace(sway=float(sway_m * scale), cell=0.6 * scale, time_s=float(time_s))
        if led_shift_m:
            image = self.world.levels[level]
            y0 = int(np.clip(still.led[0].min() / 2**level - 12, 0, image.shape[0] - 8))
            y1 = int(np.clip(still.led[1].max() / 2**level + 12, y0 + 8, image.shape[0]))
            board = np.ascontiguousarray(_blurred(image[y0:y1], blur))
            alive = alive._replace(shift_m=float(led_shift_m), board_source=board, board_y_off=y0)
        return alive


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur, or the contiguous picture itself where there is nothing to blur."""
    if sigma <= 0.05:
        return np.ascontiguousarray(image)
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)


def _make_tables(world: World) -> Alive:
    """Rows of hoardings and tiers and the hoardings' perimeter coordinate per level-0 column, nothing moving yet."""
    width = world.levels[0].shape[1]
    lon = world.lon_left + np.arange(width) / world.px_per_rad
    rows = world.px_per_rad * (world.tan_top - profile_edges(world.stadium, lon))
    led = np.empty((3, width))
    led[0], led[1] = rows[BOARD], rows[BOARD - 1]
    for col in range(width):
        dx, dy = np.sin(lon[col]), np.cos(lon[col])
        face, rho = _board(world, dx, dy)
        led[2, col] = perimeter_coordinate(world.stadium, face, rho * dx, rho * dy)
    s = np.linspace(led[2, 0], led[2, -1], 4 * width)
    crowd = np.stack([rows[UPPER_TIER], rows[UPPER_TIER - 1], rows[LOWER_TIER], rows[LOWER_TIER - 1]])
    return _STILL._replace(
        led=led,
        x_of_s=np.interp(s, led[2], np.arange(width)),
        s_first=float(s[0]),
        s_step=float(s[1] - s[0]),
        crowd=crowd,
    )


_STILL = Alive(
    led=np.zeros((3, 2)),
    x_of_s=np.zeros(2),
    s_first=0.0,
    s_step=1.0,
    shift_m=0.0,
    board_source=np.zeros((8, 8, 3), np.uint8),
    board_y_off=0,
    crowd=np.zeros((4, 2)),
    sway=0.0,
    cell=1.0,
    time_s=0.0,
)


def _board(world: World, dx: float, dy: float) -> tuple[int, float]:
    """Face and horizontal distance of the hoarding line in a horizontal direction."""
    faces = world.stadium.faces
    along = faces[:, 0] * dx + faces[:, 1] * dy
    rho = np.where(along > 1e-9, faces[:, 2] / np.where(along > 1e-9, along, 1), np.inf)
    face = int(np.argmin(rho))
    return face, float(rho[face])


def finish(image: np.ndarray, look: Look) -> np.ndarray:
    """Exposure, vignetting and sensor noise, in place; returns image."""
    expose(image, look.gain, look.offset, look.vignette, look.noise_grey, look.noise_seed)
    return image
