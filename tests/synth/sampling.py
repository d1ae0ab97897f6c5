"""Compiled kernels of the renderer: exact-float bicubic sampling of the environment, sensor, RGB -> YUV.

cv2.remap is not used: its fixed-point weights (1/32 px) would be an error of the truth itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

NODE_MARGIN = 1  # nodes outside the frame on each side, so that every cell has its four neighbours


@njit(cache=True, nogil=True, inline="always")
def _lagrange(t):
    """Weights of the nodes -1, 0, 1, 2 for a cubic through all four, 0 <= t <= 1."""
    a = -t * (t - 1) * (t - 2) / 6
    b = (t + 1) * (t - 1) * (t - 2) / 2
    c = -(t + 1) * t * (t - 2) / 2
    d = (t + 1) * t * (t - 1) / 6
    return a, b, c, d


@njit(cache=True, nogil=True, inline="always")
def _catmull_rom(t):
    """Interpolating cubic convolution (Keys, a = -1/2): reproduces quadratics, so it keeps centroids."""
    a = np.float32(0.5) * t * (t * (np.float32(2.0) - t) - np.float32(1.0))
    b = np.float32(0.5) * (t * t * (np.float32(3.0) * t - np.float32(5.0)) + np.float32(2.0))
    c = np.float32(0.5) * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + np.float32(1.0))
    d = np.float32(0.5) * t * t * (t - np.float32(1.0))
    return a, b, c, d


@njit(cache=True, nogil=True, error_model="numpy")
def expand_row(nodes, step, row, xs, ys):
    """Texel coordinates of one image row from the node grid (gh, gw, 2); nodes at (i - NODE_MARGIN) step."""
    j = row // step + NODE_MARGIN
    wy = _lagrange((row % step) / step)
    gw = nodes.shape[1]
    lx, ly = np.empty(gw), np.empty(gw)
    for i in range(gw):
        lx[i] = (
            wy[0] * nodes[j - 1, i, 0]
            + wy[1] * nodes[j, i, 0]
            + wy[2] * nodes[j + 1, i, 0]
            + wy[3] * nodes[j + 2, i, 0]
        )
        ly[i] = (
            wy[0] * nodes[j - 1, i, 1]
            + wy[1] * nodes[j, i, 1]
            + wy[2] * nodes[j + 1, i, 1]
            + wy[3] * nodes[j + 2, i, 1]
        )
    for col in range(xs.shape[0]):
        i = col // step + NODE_MARGIN
        a, b, c, d = _lagrange((col % step) / step)
        xs[col] = a * lx[i - 1] + b * lx[i] + c * lx[i + 1] + d * lx[i + 2]
        ys[col] = a * ly[i - 1] + b * ly[i] + c * ly[i + 1] + d * ly[i + 2]


class Alive(NamedTuple):
    """What moves in the environment itself. Tables are per level-0 texel column; y and x in level-0 texels.

    led (3, W): top y, bottom y of the hoardings, perimeter s (m); x_of_s (n,): the way back, from s_first in steps of
    s_step; shift_m: how far the content has run; board_source: the hoardings' rows of the level, all columns, from row
    board_y_off. crowd (4, W): top and bottom y of upper and lower tier; sway: amplitude, cell: a person's size, texels.
    """

    led: np.ndarray
    x_of_s: np.ndarray
    s_first: float
    s_step: float
    shift_m: float
    board_source: np.ndarray
    board_y_off: int
    crowd: np.ndarray
    sway: float
    cell: float
    time_s: float


@njit(cache=True, nogil=True, error_model="numpy")
def _sway_row(xs, ys, scale, alive):
    """People lean and wave: a smooth displacement, zero on the border of each person's cell, own phase and pace."""
    width = alive.crowd.shape[1]
    for col in range(xs.shape[0]):
        x, y = xs[col] * scale, ys[col] * scale
        i = int(x)
        if not (0 <= i < width):
            continue
        if alive.crowd[0, i] < y < alive.crowd[1, i] or alive.crowd[2, i] < y < alive.crowd[3, i]:
            a, b = int(x / alive.cell), int(y / alive.cell)
            u, v = x / alive.cell - a, y / alive.cell - b
            z = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
            z = (z ^ (z >> np.uint64(31))) * np.uint64(0xBF58476D1CE4E5B9)
            z ^= z >> np.uint64(29)
            pace = 1.0 + 6.0 * np.float64(z & np.uint64(1023)) / 1024.0
            phase = 6.2832 * np.float64((z >> np.uint64(10)) & np.uint64(1023)) / 1024.0
            angle = 6.2832 * np.float64((z >> np.uint64(20)) & np.uint64(1023)) / 1024.0
            push = alive.sway / scale * 16 * u * (1 - u) * v * (1 - v) * np.sin(pace * alive.time_s + phase)
            xs[col] += push * np.cos(angle)
            ys[col] += push * np.sin(angle)


@njit(cache=True, nogil=True, error_model="numpy")
def _scroll_row(xs, ys, on_board, scale, alive):
    """Address the hoardings' content shift_m further along; on_board marks the pixels to read from board_source."""
    led, x_of_s, s_first, s_step, shift_m = (
        alive.led,
        alive.x_of_s,
        alive.s_first,
        alive.s_step,
        alive.shift_m,
    )
    width, n = led.shape[1], x_of_s.shape[0]
    period = (n - 1) * s_step
    for col in range(xs.shape[0]):
        x, y = xs[col] * scale, ys[col] * scale
        on_board[col] = False
        if not (0 <= x < width - 1):
            continue
        i = int(x)
        u = x - i
        top = led[0, i] * (1 - u) + led[0, i + 1] * u
        bottom = led[1, i] * (1 - u) + led[1, i + 1] * u
        if top < y < bottom:
            s = led[2, i] * (1 - u) + led[2, i + 1] * u + shift_m - s_first
            s = (s % period) / s_step
            k = min(int(s), n - 2)
            x_new = x_of_s[k] * (1 - (s - k)) + x_of_s[k + 1] * (s - k)
            i = min(max(int(x_new), 0), width - 2)
            u = x_new - i
            new_top = led[0, i] * (1 - u) + led[0, i + 1] * u
            new_bottom = led[1, i] * (1 - u) + led[1, i + 1] * u
            ys[col] = (new_top + (y - top) / (bottom - top) * (new_bottom - new_top)) / scale
            xs[col] = x_new / scale
            on_board[col] = True


@njit(cache=True, nogil=True, fastmath=True)
def _read(source, x, y, out, row, col):
    """One pixel of sample_frame; at the rim of the source its last full neighbourhood."""
    x = min(max(x, 1.0), source.shape[1] - 3.0)
    y = min(max(y, 1.0), source.shape[0] - 3.0)
    i, j = int(x), int(y)
    wa, wb, wc, wd = _catmull_rom(np.float32(x - i))
    va, vb, vc, vd = _catmull_rom(np.float32(y - j))
    for k in range(3):
        acc = np.float32(0.5)
        for m, v in ((j - 1, va), (j, vb), (j + 1, vc), (j + 2, vd)):
            acc += v * (
                wa * np.float32(source[m, i - 1, k])
                + wb * np.float32(source[m, i, k])
                + wc * np.float32(source[m, i + 1, k])
                + wd * np.float32(source[m, i + 2, k])
            )
        out[row, col, k] = np.uint8(min(max(acc, np.float32(0.0)), np.float32(255.0)))


@njit(cache=True, nogil=True, fastmath=True)
def sample_frame(source, x_off, y_off, nodes, step, scale, alive, out):
    """Bicubic picture out (h, w, 3) uint8 of source (H, W, 3) uint8, texel (0, 0) at (x_off, y_off) of its level.

    nodes: texel coordinates on the level; scale: level-0 texels per level texel; alive: what moves (0: still).
    """
    h, w = out.shape[0], out.shape[1]
    xs, ys, on_board = np.empty(w), np.empty(w), np.zeros(w, np.bool_)
    for row in range(h):
        expand_row(nodes, step, row, xs, ys)
        if alive.sway != 0.0:
            _sway_row(xs, ys, scale, alive)
        if alive.shift_m != 0.0:
            _scroll_row(xs, ys, on_board, scale, alive)
        for col in range(w):
            if on_board[col]:
                _read(alive.board_source, xs[col], ys[col] - alive.board_y_off, out, row, col)
            else:
                _read(source, xs[col] - x_off, ys[col] - y_off, out, row, col)


@njit(cache=True, nogil=True, error_model="numpy")
def sample_points(source, xs, ys, out):
    """The same bicubic at scattered places xs, ys (n,) -> out (n, 3) float32; NaN outside the source."""
    hs, ws = source.shape[0], source.shape[1]
    for n in range(xs.shape[0]):
        x, y = xs[n], ys[n]
        if not (1 <= x < ws - 2 and 1 <= y < hs - 2):
            out[n] = np.nan
            continue
        i, j = int(x), int(y)
        wx, wy = _catmull_rom(np.float32(x - i)), _catmull_rom(np.float32(y - j))
        for k in range(3):
            acc = np.float32(0)
            for b in range(4):
                for a in range(4):
                    acc += wy[b] * wx[a] * np.float32(source[j - 1 + b, i - 1 + a, k])
            out[n, k] = acc


@njit(cache=True, nogil=True, error_model="numpy")
def expose(image, gain, offset, vignette, noise_grey, seed):
    """In place: image * gain * (1 - vignette (r / r_corner)^2) + offset + noise.

    noise_grey: sigma of the luma; the three channels get independent noise, 1 / .751 of it each (.2126, .7152, .0722
    in quadrature). Sum of four uniform bytes of a hash: normal enough (kurtosis -.3), independent between frames.
    """
    h, w = image.shape[0], image.shape[1]
    corner2 = (0.5 * (w - 1)) ** 2 + (0.5 * (h - 1)) ** 2
    sigma = np.float32(noise_grey / 0.7496 / 147.8)
    base = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
    for row in range(h):
        dy2 = (row - 0.5 * (h - 1)) ** 2
        for col in range(w):
            g = np.float32(gain * (1 - vignette * (dy2 + (col - 0.5 * (w - 1)) ** 2) / corner2))
            z = base + np.uint64(row * w + col) * np.uint64(0xBF58476D1CE4E5B9)
            for k in range(3):
                value = np.float32(image[row, col, k]) * g + np.float32(offset)
                if noise_grey > 0:
                    z += np.uint64(0x9E3779B97F4A7C15)
                    q = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
                    q = (q ^ (q >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
                    q ^= q >> np.uint64(31)
                    total = (q & np.uint64(255)) + ((q >> np.uint64(8)) & np.uint64(255))
                    total += ((q >> np.uint64(16)) & np.uint64(255)) + ((q >> np.uint64(24)) & np.uint64(255))
                    value += sigma * (np.float32(total) - np.float32(510.0))
                image[row, col, k] = np.uint8(
                    min(max(value + np.float32(0.5), np.float32(0)), np.float32(255))
                )


@njit(cache=True, nogil=True, error_model="numpy")
def rgb_to_yuv420(image, y_plane, u_plane, v_plane):
    """8-bit RGB (full range) -> BT.709 limited range 4:2:0, chroma sited left (the H.264 default). Even sizes."""
    h, w = image.shape[0], image.shape[1]
    for row in range(h):
        for col in range(w):
            r, g, b = (
                np.float32(image[row, col, 0]),
                np.float32(image[row, col, 1]),
                np.float32(image[row, col, 2]),
            )
            luma = np.float32(0.2126) * r + np.float32(0.7152) * g + np.float32(0.0722) * b
            y_plane[row, col] = np.uint8(np.float32(16.5) + luma * np.float32(219.0 / 255.0))
    for row in range(h // 2):
        for col in range(w // 2):
            r = g = b = np.float32(0)
            for dx, weight in ((-1, np.float32(0.125)), (0, np.float32(0.25)), (1, np.float32(0.125))):
                x = max(2 * col + dx, 0)
                for dy in range(2):
                    r += weight * image[2 * row + dy, x, 0]
                    g += weight * image[2 * row + dy, x, 1]
                    b += weight * image[2 * row + dy, x, 2]
            luma = np.float32(0.2126) * r + np.float32(0.7152) * g + np.float32(0.0722) * b
            u_plane[row, col] = np.uint8(np.float32(128.5) + (b - luma) * np.float32(224.0 / 255.0 / 1.8556))
            v_plane[row, col] = np.uint8(np.float32(128.5) + (r - luma) * np.float32(224.0 / 255.0 / 1.5748))
