"""Colours of the procedural ground: every texel of the environment from a seed and its place in metres.

Hash-based, so that a colour depends on the place only and not on the window or resolution that is painted. Not
photographic: what counts is contrast and detail where a broadcast picture has them. float 0..255 RGB.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from tests.synth.stadium import (
    BACK_WALL,
    BOARD,
    FACADE,
    FRONT_WALL,
    GROUND,
    LOWER_TIER,
    ROOF,
    UPPER_TIER,
    intersect,
    perimeter_coordinate,
)

STRIP_HALF_LENGTH_M = 170.0
RIBBON_Z_M = (0.2, 0.55)  # where the ribbon board sits, as a share of the facade's height

# octaves of the grass: wavelength across and away from the camera (m; it is seen at a grazing angle), grey levels
_GRASS = np.array([[0.11, 0.34, 7.0], [0.28, 0.8, 6.0], [0.8, 2.0, 5.0], [2.6, 5.0, 4.0], [9.0, 15.0, 5.0]])

_BRANDS = (
    "NORDLICHT", "ALPINA BANK", "KOLIBRI COLA", "MOSAIK", "TELEVOX", "BERGHOF", "SOLARIA", "HEXAGON", "RIVA AIR",
    "QUARZ", "POLARIS TV", "MANGOLD", "VELOCE", "OKTAV", "ZEPPELIN", "FJORDLINE",
)  # fmt: skip
_BOARD_COLOURS = (
    ((20, 40, 140), (250, 250, 250)), ((235, 235, 235), (190, 20, 30)), ((10, 10, 12), (250, 210, 30)),
    ((200, 25, 30), (255, 255, 255)), ((0, 120, 90), (245, 245, 245)), ((245, 200, 20), (20, 20, 30)),
    ((90, 20, 120), (255, 255, 255)), ((250, 250, 250), (20, 60, 170)),
)  # fmt: skip


def paint_strip(rng: np.random.Generator, height_m: float, px_per_m: float) -> np.ndarray:
    """Row of advertising boards (h, w, 3) float32 RGB, STRIP_HALF_LENGTH_M to either side; lettering about .6 high."""
    h, w = max(4, round(height_m * px_per_m)), round(2 * STRIP_HALF_LENGTH_M * px_per_m)
    fine = 4 if h < 64 else 2  # letters are drawn large and averaged down
    strip = np.empty((h, w, 3), np.float32)
    x0 = 0
    while x0 < w:
        name = str(rng.choice(_BRANDS))
        paper, ink = _BOARD_COLOURS[int(rng.integers(len(_BOARD_COLOURS)))]
        scale = fine * h * 0.62 / 22.0
        thickness = max(1, round(fine * h * 0.11))
        (tw, _), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_DUPLEX, scale, thickness)
        width = tw // fine + round(h * rng.uniform(0.8, 1.8))
        panel = np.empty((h * fine, width * fine, 3), np.uint8)
        panel[:] = paper
        panel[: fine * max(1, h // 20)] = panel[-fine * max(1, h // 20) :] = (
            12  # dark frame: LED scroll wraps unseen
        )
        panel[:, : fine * max(1, h // 24)] = 30
        origin = ((width * fine - tw) // 2, round(fine * h * 0.80))
        cv2.putText(panel, name, origin, cv2.FONT_HERSHEY_DUPLEX, scale, ink, thickness, cv2.LINE_AA)
        small = cv2.resize(panel, (width, h), interpolation=cv2.INTER_AREA)
        take = min(width, w - x0)
        strip[:, x0 : x0 + take] = small[:, :take]
        x0 += width
    return strip


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hash(a, b, c):
    """Uniform [0, 1) of three integers."""
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(c) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(31)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0x94D049BB133111EB)
    h ^= h >> np.uint64(32)
    return np.float64(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _value_noise(x, y, salt):
    """Smooth lattice noise in -1..1, one lattice cell a unit."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    a, b = _hash(i, j, salt), _hash(i + 1, j, salt)
    c, d = _hash(i, j + 1, salt), _hash(i + 1, j + 1, salt)
    return 2 * (a + (b - a) * u + (c - a) * v + (a - b - c + d) * u * v) - 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _stroke(distance, half_width, footprint):
    """Share of a texel of the given footprint (m) that a line of half_width at signed distance covers."""
    a = min(max((distance + half_width) / footprint + 0.5, 0.0), 1.0)
    b = min(max((distance - half_width) / footprint + 0.5, 0.0), 1.0)
    return a - b


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _ring(dx, dy, radius, half_width, fx, fy):
    """Cover of a circle line (radius 0: a spot) at offset (dx, dy) m from its centre."""
    if abs(dx) > radius + 2 or abs(dy) > radius + 2:
        return 0.0
    r = np.sqrt(dx * dx + dy * dy) + 1e-9
    return _stroke(r - radius, half_width, (abs(dx) * fx + abs(dy) * fy) / r)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _pitch_lines(x, y, fx, fy, half_l, half_w):
    """White of a football pitch's lines at (x, y) m from the centre spot; fx, fy: texel footprint in m. 0..1."""
    ax, ay, hw = abs(x), abs(y), 0.06
    c = 0.0
    if ax < half_l + hw and ay < half_w + hw:
        c = max(c, _stroke(ay - half_w, hw, fy))
        c = max(c, _stroke(ax - half_l, hw, fx))
        c = max(c, _stroke(ax, hw, fx))
        if ay < 20.16 + hw:
            c = max(c, _stroke(ax - (half_l - 16.5), hw, fx))
        if ax > half_l - 16.5:
            c = max(c, _stroke(ay - 20.16, hw, fy))
        if ay < 9.16 + hw:
            c = max(c, _stroke(ax - (half_l - 5.5), hw, fx))
        if ax > half_l - 5.5:
            c = max(c, _stroke(ay - 9.16, hw, fy))
        c = max(c, _ring(ax, ay, 9.15, hw, fx, fy))
        c = max(c, _ring(ax, ay, 0.0, 0.15, fx, fy))
        if ax < half_l - 16.5:
            c = max(c, _ring(ax - half_l + 11, ay, 9.15, hw, fx, fy))
        c = max(c, _ring(ax - half_l + 11, ay, 0.0, 0.15, fx, fy))
        c = max(c, _ring(ax - half_l, ay - half_w, 1.0, hw, fx, fy))
    return c


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _court_lines(x, y, fx, fy, half_l, half_w):
    """The same for a basketball-like court."""
    ax, ay, hw = abs(x), abs(y), 0.035
    c = 0.0
    if ax < half_l + hw and ay < half_w + hw:
        c = max(_stroke(ay - half_w, hw, fy), _stroke(ax - half_l, hw, fx))
        c = max(c, _stroke(ax, hw, fx))
        if ay < 2.45 + hw:
            c = max(c, _stroke(ax - (half_l - 5.8), hw, fx))
        if ax > half_l - 5.8:
            c = max(c, _stroke(ay - 2.45, hw, fy))
        c = max(c, _ring(ax, ay, 1.8, hw, fx, fy))
        c = max(c, _ring(ax - half_l + 1.575, ay, 6.75, hw, fx, fy))
        c = max(c, _ring(ax - half_l + 5.8, ay, 1.8, hw, fx, fy))
    return c


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _ground(stadium, x, y, fx, fy, salt, grass, out):
    """Grass (or floor) with stripes, wear and lines. grass: contrast of everything that is not a line, 1 = full."""
    hl, hw = stadium.half_length, stadium.half_width
    noise = 0.0
    scale = 0.28 if stadium.arena else 1.0
    for octave in range(5):
        lx, ly = _GRASS[octave, 0] * scale, _GRASS[octave, 1] * scale
        fade = min(max(0.5 * min(lx / fx, ly / fy) - 0.35, 0.0), 1.0)
        if fade > 0:
            noise += fade * _GRASS[octave, 2] * _value_noise(x / lx, y / ly, salt + octave)
    inside = abs(x) < hl + 2 * scale and abs(y) < hw + 2 * scale
    if stadium.arena:
        plank = _hash(
            int(np.floor(x / 1.3 + 7 * _hash(int(np.floor(y / 0.12)), 3, salt))),
            int(np.floor(y / 0.12)),
            salt,
        )
        key = 1.0 if (abs(y) < 2.45 and abs(x) > hl - 5.8) else 0.0
        light = grass * (0.8 * noise + 22 * (plank - 0.5))
        out[0], out[1], out[2] = 196 + light - 60 * key, 152 + light - 90 * key, 100 + light - 40 * key
        if not inside:
            out[0], out[1], out[2] = 60 + light, 40 + light, 90 + light
        white = _court_lines(x, y, fx, fy, hl, hw)
    else:
        band = np.sin(np.pi * x / 5.25) / (fx + 0.25) * 0.6
        stripe = 8.0 * min(max(band, -1.0), 1.0)
        wear = 0.0  # in front of the goals
        if abs(x) > hl - 14 and abs(y) < 18:
            wear = 6 + 8 * _value_noise(x / 1.3, y / 1.9, salt + 9)
            wear *= np.exp(-((abs(x) - hl + 3) ** 2) / 18 - y * y / 30)
        light = grass * (noise + (stripe if inside else 0.0))
        out[0] = 62 + 0.75 * light + wear * 2.0
        out[1] = 118 + light + wear * 0.7
        out[2] = 48 + 0.6 * light + wear * 0.8
        if not inside:
            out[0], out[1], out[2] = out[0] * 0.86, out[1] * 0.84, out[2] * 0.9
        white = _pitch_lines(x, y, fx, fy, hl, hw)
    if white > 0:
        white *= 0.88 + 0.12 * _value_noise(x / 0.5, y / 0.5, salt + 11)
        out[0] += white * (228 - out[0])
        out[1] += white * (236 - out[1])
        out[2] += white * (226 - out[2])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _crowd(s, v, salt, colours, full, out):
    """Rows of people: s along the stand, v up its slope, metres. full: 1 people, 0 a plain cover over the seats."""
    block = int(np.floor(s / 15.0))
    along = s - 15.0 * block
    row = int(np.floor(v / 0.85))
    w = v - 0.85 * row
    grain = _hash(int(np.floor(s * 20)), int(np.floor(v * 20)), salt + 3)
    if along < 1.3 or row % 17 == 16:  # stairs and gangways
        step = 20.0 if (w < 0.25) else 0.0
        g = 120 + step + 14 * (grain - 0.5)
        out[0], out[1], out[2] = g, g, g + 4
        if _hash(int(np.floor(s / 0.9)), row, salt + 4) < 0.12 and 0.1 < w < 0.75:
            out[0], out[1], out[2] = 220, 170 + 40 * grain, 30
    else:
        seat = int(np.floor(along / 0.52))
        du = along - 0.52 * seat - 0.26
        person = _hash(block * 64 + seat, row, salt)
        tint = _hash(block, 5, salt)
        fill = 0.72 + 0.26 * _hash(block, row // 17, salt + 5)
        out[0], out[1], out[2] = 34 + 60 * tint * (0.3 + w), 34 + 20 * w, 44 + 70 * (1 - tint) * (0.3 + w)
        if person < fill:
            a = _hash(block * 64 + seat, row, salt + 1)
            b = _hash(block * 64 + seat, row, salt + 2)
            du -= 0.10 * (a - 0.5)
            top = 0.50 + 0.14 * b
            shirt = int(b * 1e4) % colours.shape[0]
            if a < 0.35 + 0.3 * tint:  # supporters of one side sit together
                shirt = 0 if tint > 0.5 else 1
            bright = 0.72 + 0.4 * _hash(seat, row, salt + 6)
            half = 0.23 - 0.12 * max(0.0, w - top + 0.12)
            dh = w - top - 0.10
            if du * du + dh * dh < 0.0145:
                skin = 105 + 120 * _hash(seat, row + block, salt + 7)
                hair = 0.28 if dh > 0.03 else 1.0
                out[0], out[1], out[2] = skin * hair, skin * 0.78 * hair, skin * 0.62 * hair
            elif abs(du) < half and w < top:
                shade = bright * (0.72 if abs(du) > half - 0.06 else 1.0) * (0.65 + 0.35 * min(1.0, w / 0.3))
                for k in range(3):
                    out[k] = colours[shirt, k] * shade
    if full < 1:
        flat = 92 + 10 * _value_noise(s / 9, v / 6, salt + 8)
        out[0] = full * out[0] + (1 - full) * flat * 0.9
        out[1] = full * out[1] + (1 - full) * flat * 0.95
        out[2] = full * out[2] + (1 - full) * flat * 1.1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _from_strip(strip, s, height_share, out):
    """Bilinear read of a board strip; height_share 0 at the bottom, 1 at the top."""
    h, w = strip.shape[0], strip.shape[1]
    x = (s / (2 * STRIP_HALF_LENGTH_M) + 0.5) * w - 0.5
    y = (1 - height_share) * h - 0.5
    x = min(max(x, 0.0), w - 1.001)
    y = min(max(y, 0.0), h - 1.001)
    i, j = int(x), int(y)
    u, v = x - i, y - j
    for k in range(3):
        top = strip[j, i, k] * (1 - u) + strip[j, i + 1, k] * u
        out[k] = top * (1 - v) + (strip[j + 1, i, k] * (1 - u) + strip[j + 1, i + 1, k] * u) * v


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _structure(stadium, segment, s, z, q, salt, plain, board, ribbon, colours, out):
    """Everything above the pitch. plain: 1 covers all above the middle of the lower tier (texture in a band)."""
    z0, z1 = stadium.profile[segment - 1, 1], stadium.profile[segment - 1, 3]
    share = (z - z0) / (z1 - z0)
    grain = _hash(int(np.floor(s * 12)), int(np.floor(z * 12)), salt + 20)
    if segment == BOARD:
        _from_strip(board, s, share, out)
    elif segment == FRONT_WALL:
        cloth = int(np.floor(s / 3.7))
        c = int(_hash(cloth, 2, salt) * colours.shape[0] * 2)
        hang = 0.25 < share < 0.9 and s / 3.7 - cloth < 0.82
        for k in range(3):
            out[k] = 88 + 16 * (grain - 0.5) - 25 * share
            if hang and c < colours.shape[0]:
                stripe = int(np.floor(s / 0.31)) % 3 == 0
                out[k] = colours[c, k] * (0.6 if stripe else 0.95)
    elif segment in (LOWER_TIER, UPPER_TIER):
        q0, q1 = stadium.profile[segment - 1, 0], stadium.profile[segment - 1, 2]
        slope = np.sqrt((q1 - q0) ** 2 + (z1 - z0) ** 2) / abs(q1 - q0)
        full = 1.0
        if segment == UPPER_TIER or share > 0.5:
            full -= 0.94 * plain
        _crowd(s, (q - q0) * slope, salt + 40 * segment, colours, full, out)
        shade = 1.0 if segment == LOWER_TIER else 0.86
        for k in range(3):
            out[k] *= shade * (1 - 0.25 * max(0.0, share - 0.7))
    elif segment == FACADE:
        if RIBBON_Z_M[0] < share < RIBBON_Z_M[1]:
            _from_strip(ribbon, s, (share - RIBBON_Z_M[0]) / (RIBBON_Z_M[1] - RIBBON_Z_M[0]), out)
        elif 0.6 < share < 0.93:
            pane = int(np.floor(s / 1.9))
            lit = 30 + 130 * _hash(pane, 1, salt + 21) * (0.4 + 0.6 * share)
            if s / 1.9 - pane < 0.07:
                lit = 190.0
            out[0], out[1], out[2] = lit, lit * 0.95, lit * 0.8
        else:
            g = 150 + 10 * (grain - 0.5)
            out[0], out[1], out[2] = g, g, g - 6
        for k in range(3):
            out[k] += 0.8 * plain * (120 - out[k])
    elif segment == BACK_WALL:
        g = 46 + 30 * (1.0 if s / 4 - np.floor(s / 4) < 0.12 else 0.0) + 6 * (grain - 0.5)
        out[0], out[1], out[2] = g, g, g + 6
    elif segment == ROOF:
        g = 70.0 + 8 * (grain - 0.5)
        if s / 7 - np.floor(s / 7) < 0.08 or q / 5 - np.floor(q / 5) < 0.08:
            g = 128.0
        if abs(s / 7 - np.floor(s / 7) - 0.5) < 0.2 and 10 < q < 11.2:
            g = 250.0
        out[0], out[1], out[2] = g, g, g + 4
    else:
        out[0], out[1], out[2] = 168, 190, 214


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def paint_rows(
    image, first_row, lon_left, tan_top, px_per_rad, stadium, salt, grass, plain, board, ribbon, colours
):
    """Fill image (rows, w, 3) float32: texels of the cylinder x = s (lon - lon_left), y = s (tan_top - tan lat).

    Two samples a texel, one above the other: most structure is nearly horizontal. grass, plain: see _ground and
    _structure.
    """
    out = np.zeros(3)
    for col in range(image.shape[1]):
        lon = lon_left + col / px_per_rad
        dx, dy = np.sin(lon), np.cos(lon)
        for row in range(image.shape[0]):
            r = g = b = 0.0
            for sub in range(2):
                tan_up = tan_top - (first_row + row + 0.5 * sub - 0.25) / px_per_rad
                segment, face, rho = intersect(stadium, dx, dy, tan_up)
                if segment == GROUND:
                    lateral, deep = rho / px_per_rad, rho * rho / stadium.camera_height / px_per_rad
                    fx = lateral * abs(dy) + deep * abs(dx)
                    fy = lateral * abs(dx) + deep * abs(dy)
                    _ground(stadium, rho * dx, rho * dy - stadium.camera_back, fx, fy, salt, grass, out)
                elif segment <= ROOF:
                    x, y = rho * dx, rho * dy
                    s = perimeter_coordinate(stadium, face, x, y)
                    q = stadium.faces[face, 0] * x + stadium.faces[face, 1] * y - stadium.faces[face, 2]
                    z = stadium.camera_height + rho * tan_up
                    _structure(stadium, segment, s, z, q, salt, plain, board, ribbon, colours, out)
                else:
                    cloud = 18 * _value_noise(lon * 9, tan_up * 30, salt + 30) + 9 * _value_noise(
                        lon * 31, tan_up * 90, salt + 31
                    )
                    out[0], out[1], out[2] = 176 + cloud, 194 + cloud, 216 + 0.6 * cloud
                r, g, b = r + out[0], g + out[1], b + out[2]
            image[row, col, 0] = 0.5 * r
            image[row, col, 1] = 0.5 * g
            image[row, col, 2] = 0.5 * b
