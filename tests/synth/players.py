"""Players: articulated figures that walk on the pitch, drawn as shaded capsules through the camera.

Positions are metres on the pitch plane, independent of the camera. `scale` enlarges the figures until they cover the
wanted share of the picture; feet stay on the grass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tests.synth.camera import SynthCamera
from tests.synth.stadium import Stadium

# joints (lateral, height) of a standing person of 1.8 m, and which pairs are limbs: radius m, colour index
# colours: 0 shirt, 1 shorts, 2 legs / socks, 3 skin, 4 hair, 5 second shirt colour
_N_LIMBS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Squad:
    """start_m (n, 2) pitch metres; velocity_m_s (n, 2); wander: amplitude m, rad/s, phase (n, 2, 3); colours (n, 6, 3);
    gait_phase (n,), standing (n,) bool; scale: height over 1.8 m."""

    start_m: np.ndarray
    velocity_m_s: np.ndarray
    wander: np.ndarray
    colours: np.ndarray
    gait_phase: np.ndarray
    standing: np.ndarray
    scale: float

    def positions(self, time_s: float, stadium: Stadium) -> np.ndarray:
        """(n, 2) pitch metres; who reaches the edge of the playing area turns round."""
        p = self.start_m + self.velocity_m_s * time_s
        a, omega, phase = self.wander[..., 0], self.wander[..., 1], self.wander[..., 2]
        p = p + np.where(self.standing[:, None], 0, a * (np.sin(omega * time_s + phase) - np.sin(phase)))
        limit = np.array([stadium.half_length + 1.5, stadium.half_width + 1.5])
        folded = np.mod(p + limit, 4 * limit)
        return np.where(folded > 2 * limit, 4 * limit - folded, folded) - limit


def make_squad(
    *,
    seed: int,
    n: int,
    cameras: list[SynthCamera],
    stadium: Stadium,
    scale: float = 1.0,
    standing: int = 0,
    duration_s: float = 6.0,
) -> Squad:
    """n players where the camera will look, at a time drawn at random; the first `standing` of them never move."""
    rng = np.random.default_rng([seed, 33])
    limit = np.array([stadium.half_length, stadium.half_width])
    start = np.empty((n, 2))
    speed = rng.uniform(1.2, 4.5, n) * min(1.0 + 0.15 * (scale - 1), 2.0)
    heading = rng.uniform(0, 2 * np.pi, n)
    velocity = np.stack([speed * np.cos(heading), 0.5 * speed * np.sin(heading)], -1)
    velocity[:standing] = 0
    # stratified in time and across the picture, or large figures would stand in a heap
    when, where = (
        (rng.permutation(n) + rng.uniform(size=n)) / n,
        (rng.permutation(n) + rng.uniform(size=n)) / n,
    )
    for i in range(n):
        share = 0.5 if i < standing else when[i]
        camera = cameras[min(int(share * len(cameras)), len(cameras) - 1)]
        # feet below the hoardings: the lower three quarters of the picture, more at the far side, as on a pitch
        pixel = np.array([where[i] * camera.width, (0.30 + 0.68 * rng.uniform() ** 1.3) * camera.height])
        ray = camera.pixel_to_ray(pixel)
        ground = ray * (stadium.camera_height / max(ray[1], 0.03))
        at = np.clip(np.array([ground[0], ground[2] - stadium.camera_back]), -limit, limit)
        start[i] = at - velocity[i] * share * duration_s
    kits = rng.permutation(6)
    palette = np.array(
        [[205, 25, 35], [245, 245, 245], [25, 60, 170], [245, 205, 30], [25, 25, 28], [120, 20, 50]],
        dtype=np.float64,
    )
    colours = np.empty((n, 6, 3))
    for i in range(n):
        team = i % 2 if i % 11 else 2
        skin = np.array([224, 178, 142]) * rng.uniform(0.42, 1.05)
        hair = np.array([60, 45, 30]) * rng.uniform(0.3, 2.2)
        shirt, shorts = palette[kits[team]], palette[kits[(team + 3) % 6]]
        second = palette[kits[team + 3]] if team == 1 else shirt * 0.82
        colours[i] = (
            shirt,
            shorts,
            palette[kits[team]] * 0.9 if team else palette[kits[3]],
            skin,
            hair,
            second,
        )
    wander = np.stack(
        [rng.uniform(0.3, 1.5, (n, 2)), rng.uniform(0.4, 1.6, (n, 2)), rng.uniform(0, 6.28, (n, 2))], -1
    )
    still = np.arange(n) < standing
    return Squad(
        start_m=start,
        velocity_m_s=velocity,
        wander=wander,
        colours=colours,
        gait_phase=rng.uniform(0, 6.28, n),
        standing=still,
        scale=scale,
    )


def _skeleton(phase: float, stride: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Limbs of a walking person: ends (12, 2, 2) as (lateral, height) m for 1.8 m, radii (12,), colour index (12,)."""
    swing, lift = stride * np.sin(phase), 0.10 * stride
    hip, shoulder = 0.96, 1.46
    limbs, radii, colours = [], [], []

    def add(a: tuple[float, float], b: tuple[float, float], radius: float, colour: int) -> None:
        limbs.append((a, b))
        radii.append(radius)
        colours.append(colour)

    for side in (-1, 1):
        x = 0.10 * side
        foot = (x + 0.38 * swing * side, 0.06 + lift * max(0.0, np.cos(phase) * side))
        knee = (x + 0.24 * swing * side + 0.05 * stride, 0.50)
        add((x, hip - 0.05), knee, 0.095, 1)
        add(((x + knee[0]) / 2, 0.66), knee, 0.075, 3)
        add(knee, foot, 0.062, 2)
        elbow = (0.23 * side - 0.16 * swing * side, 1.17)
        add((0.20 * side, shoulder - 0.04), elbow, 0.065, 0)
    add((0.23 - 0.16 * swing, 1.17), (0.25 - 0.30 * swing + 0.06, 0.95), 0.047, 3)
    add((-0.23 + 0.16 * swing, 1.17), (-0.25 + 0.30 * swing + 0.06, 0.95), 0.047, 3)
    add((0.0, hip + 0.04), (0.0, shoulder - 0.08), 0.185, 5)
    add((0.01, 1.66), (0.01, 1.69), 0.105, 3)
    return np.array(limbs), np.array(radii), np.array(colours)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_capsules(image, mask, ends, radii, colours, stripe):
    """Capsules (m, 2, 2) px with radius (m,) px over image (h, w, 3) uint8, in order; mask (h, w) uint8 = cover, max.

    Shaded across, as a round body is; stripe > 0: that many dark bands along the capsule's width.
    """
    h, w = image.shape[0], image.shape[1]
    for m in range(ends.shape[0]):
        ax, ay, bx, by, r = ends[m, 0, 0], ends[m, 0, 1], ends[m, 1, 0], ends[m, 1, 1], radii[m]
        if not (np.isfinite(ax + ay + bx + by + r)):
            continue
        x0, x1 = max(int(min(ax, bx) - r - 1), 0), min(int(max(ax, bx) + r + 2), w - 1)
        y0, y1 = max(int(min(ay, by) - r - 1), 0), min(int(max(ay, by) + r + 2), h - 1)
        ex, ey = bx - ax, by - ay
        length2 = max(ex * ex + ey * ey, 1e-12)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                t = min(max(((x - ax) * ex + (y - ay) * ey) / length2, 0.0), 1.0)
                px, py = x - ax - t * ex, y - ay - t * ey
                distance = np.sqrt(px * px + py * py)
                cover = min(max(r - distance + 0.5, 0.0), 1.0)
                if cover <= 0:
                    continue
                lateral = (px * ey - py * ex) / np.sqrt(length2) / r
                shade = 1.0 - 0.28 * lateral * lateral - 0.12 * lateral
                if stripe[m] > 0 and int(np.floor((lateral + 1) * stripe[m])) % 2 == 0:
                    shade *= 0.55
                for k in range(3):
                    value = min(colours[m, k] * shade, 255.0)
                    image[y, x, k] = np.uint8(image[y, x, k] * (1 - cover) + value * cover + 0.5)
                mask[y, x] = max(mask[y, x], np.uint8(min(255 * cover + 1, 255.0)))


def draw_players(
    image: np.ndarray, mask: np.ndarray, squad: Squad, camera: SynthCamera, stadium: Stadium, time_s: float
) -> None:
    """Draw everybody into image (h, w, 3) uint8, far ones first; mask (h, w) uint8 gets their cover 0..255."""
    at = squad.positions(time_s, stadium)
    before = squad.positions(time_s - 0.04, stadium)
    for i in np.argsort(-at[:, 1], kind="stable"):
        speed = float(np.hypot(*(at[i] - before[i]))) / 0.04
        moving = min(speed / 3.0, 1.2)
        phase = squad.gait_phase[i] + 2 * np.pi * time_s * (1.0 + 0.25 * speed) * (
            0.0 if squad.standing[i] else 1.0
        )
        limbs, radii, colour = _skeleton(phase, moving)
        facing = np.sign(at[i, 0] - before[i, 0]) or 1.0
        foot = np.array([at[i, 0], stadium.camera_height, at[i, 1] + stadium.camera_back])
        points = np.empty((_N_LIMBS, 2, 3))
        points[..., 0] = foot[0] + facing * squad.scale * limbs[..., 0]
        points[..., 1] = foot[1] - squad.scale * limbs[..., 1]
        points[..., 2] = foot[2]
        depth = float((foot - camera.pupil_world_m) @ camera.R_cam_world[2])
        if depth < 2:
            continue
        ends = camera.point_to_pixel(points)
        body = np.concatenate([ends.reshape(-1, 2), ends[-1:, 0] * 1.0])
        if not np.isfinite(body).all() or body[:, 0].max() < -40 or body[:, 0].min() > camera.width + 40:
            continue
        px_per_m = camera.f_px * squad.scale / depth
        stripe = np.zeros(_N_LIMBS)
        stripe[10] = 2.5 if i % 2 else 0.0
        # the head last, the far limbs first
        draw_capsules(image, mask, ends, radii * px_per_m, squad.colours[i][colour], stripe)
        hair = ends[11:12] + np.array([0, -0.05 * px_per_m])
        draw_capsules(
            image, mask, hair, radii[11:12] * px_per_m * 0.85, squad.colours[i][4][None], np.zeros(1)
        )
