"""One frame over one tile of the panorama: samples between its pixels, with the vote and weight of each.

A numba kernel: it releases the GIL, so that two threads work on two tiles. What the votes are for: blend.py.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _catmull_rom(t: float) -> Any:
    """Weights of the four neighbours for a position t in 0..1 between the middle two."""
    half, t2 = np.float32(0.5) * t, t * t
    t3 = half * t2  # every constant is float32: one float64 among them halves the speed
    a0 = t2 - half - t3
    a3 = t3 - np.float32(0.5) * t2
    a1 = np.float32(1) - np.float32(2.5) * t2 + np.float32(3) * t3
    return a0, a1, np.float32(1) - a0 - a1 - a3, a3


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _dot2(flat, at, a0, a1):  # type: ignore[no-untyped-def]
    # Unsigned indices: numba then leaves out the test for negative ones, a third of the time of this kernel.
    return a0 * np.float32(flat[at]) + a1 * np.float32(flat[at + np.uintp(3)])


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _dot4(flat, at, a0, a1, a2, a3):  # type: ignore[no-untyped-def]
    return _dot2(flat, at, a0, a1) + _dot2(flat, at + np.uintp(6), a2, a3)


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _cubic(flat, stride, xi, yi, s, t):  # type: ignore[no-untyped-def]
    """The three channels between pixels (xi, yi) and (xi + 1, yi + 1), Catmull-Rom."""
    a0, a1, a2, a3 = _catmull_rom(s)
    b0, b1, b2, b3 = _catmull_rom(t)
    at = np.uintp((yi - 1) * stride + 3 * (xi - 1))
    one, two = np.uintp(1), np.uintp(2)
    r = b0 * _dot4(flat, at, a0, a1, a2, a3)
    g = b0 * _dot4(flat, at + one, a0, a1, a2, a3)
    b = b0 * _dot4(flat, at + two, a0, a1, a2, a3)
    for k in (b1, b2, b3):
        at += np.uintp(stride)
        r += k * _dot4(flat, at, a0, a1, a2, a3)
        g += k * _dot4(flat, at + one, a0, a1, a2, a3)
        b += k * _dot4(flat, at + two, a0, a1, a2, a3)
    return r, g, b


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _linear(flat, stride, xi, yi, s, t):  # type: ignore[no-untyped-def]
    """The three channels between pixels (xi, yi) and (xi + 1, yi + 1), bilinear."""
    one = np.float32(1)
    k00, k01, k10, k11 = (one - s) * (one - t), s * (one - t), (one - s) * t, s * t
    at = np.uintp(yi * stride + 3 * xi)
    under = at + np.uintp(stride)
    r = _dot2(flat, at, k00, k01) + _dot2(flat, under, k10, k11)
    g = _dot2(flat, at + np.uintp(1), k00, k01) + _dot2(flat, under + np.uintp(1), k10, k11)
    b = _dot2(flat, at + np.uintp(2), k00, k01) + _dot2(flat, under + np.uintp(2), k10, k11)
    return r, g, b


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _light(x, y, width, height, falloff):  # type: ignore[no-untyped-def]
    """What undoes the falloff at px (x, y) of a frame, which may lie far outside: there it must be finite only."""
    half = np.float32(0.5)
    off_x, off_y = (x - half * np.float32(width - 1)), (y - half * np.float32(height - 1))
    wide, high = half * np.float32(width), half * np.float32(height)
    r2 = min(off_x * off_x + off_y * off_y, np.float32(2) * (wide * wide + high * high)) / (wide * wide)
    return np.exp(-(falloff[0] + falloff[1] * r2) * r2)


@numba.njit(cache=True, nogil=True, fastmath=True)
def sample_view(  # type: ignore[no-untyped-def]
    image,
    top,
    height,
    trust,
    still,
    grid,
    step,
    gain,
    falloff,
    margin,
    feather,
    cubic,
    out,
    out_vote,
    out_weight,
    fine=None,
):
    """Sample one frame over one tile.

    image (H, W, 3) uint8, or uint16 with a gain smaller by 257: the rows from `top` on of a frame `height` px high, all
    that the grid can reach. trust and
    still: uint8 planes over the same frame at any resolution, 255 = the scene at
    rest, nearest pixel taken; a (1, 1) plane holds for the whole frame. grid (rows, columns, 4) float32: frame x, y,
    vote and weight 0..1 at every `step`-th tile pixel, linear in between. gain (3,) multiplies the channels. falloff
    (2,): the lens's (vignetting.py), divided out, linear between the same points. A sample nearer than `margin` px to
    the frame's border, or of trust, still or vote 0, is not seen; from there vote and weight rise over `feather` px, so
    that no frame edge shows. Both are multiplied by trust / 255 and by still / 255.
    Out, uint8: out (3, h, w); out_vote (h, w), 0 = not seen, else at least 1; out_weight (h, w), likewise; fine
    (3, h, w), where given: the sample less out, in 256ths of a grey level, 128 = none.
    Catmull-Rom (cubic) or linear, with float weights (cv2.remap rounds positions to 1/32 px).
    """
    width = image.shape[1]
    rows, columns = out_vote.shape
    flat, stride = image.reshape(-1), 3 * width
    x_last, y_last = width - 1 - margin, height - 1 - margin
    gain_r, gain_g, gain_b = gain[0], gain[1], gain[2]
    zero, one, rounding, full = np.float32(0), np.float32(1), np.float32(0.5), np.float32(255)
    per = one / np.float32(step)
    lit, dl, l0 = falloff[0] != zero or falloff[1] != zero, zero, one
    trust_x, trust_y = np.float32(trust.shape[1] / width), np.float32(trust.shape[0] / height)
    still_x, still_y = np.float32(still.shape[1] / width), np.float32(still.shape[0] / height)
    for row in range(rows):
        i = row // step
        v = np.float32(row - i * step) * per
        for j in range((columns + step - 1) // step):
            left = j * step
            right = min(left + step, columns)
            x0 = grid[i, j, 0] * (one - v) + grid[i + 1, j, 0] * v
            x1 = grid[i, j + 1, 0] * (one - v) + grid[i + 1, j + 1, 0] * v
            y0 = grid[i, j, 1] * (one - v) + grid[i + 1, j, 1] * v
            y1 = grid[i, j + 1, 1] * (one - v) + grid[i + 1, j + 1, 1] * v
            c0 = full * (grid[i, j, 2] * (one - v) + grid[i + 1, j, 2] * v)
            c1 = full * (grid[i, j + 1, 2] * (one - v) + grid[i + 1, j + 1, 2] * v)
            w0 = full * (grid[i, j, 3] * (one - v) + grid[i + 1, j, 3] * v)
            w1 = full * (grid[i, j + 1, 3] * (one - v) + grid[i + 1, j + 1, 3] * v)
            # The map is linear along these pixels: when both ends are out on one side, all are. A corner that the
            # frame does not see is at -1e9, and so far outside is any mix with it.
            if (
                max(x0, x1) < margin or min(x0, x1) > x_last or max(y0, y1) < margin or min(y0, y1) > y_last
                or max(c0, c1) <= zero
            ):  # fmt: skip
                out_vote[row, left:right] = 0
                out_weight[row, left:right] = 0
                continue
            dx, dy, dc, dw = (x1 - x0) * per, (y1 - y0) * per, (c1 - c0) * per, (w1 - w0) * per
            if lit:
                l0 = _light(x0, y0, width, height, falloff)
                dl = (_light(x1, y1, width, height, falloff) - l0) * per
            for column in range(left, right):
                u = np.float32(column - left)
                x, y, c = x0 + dx * u, y0 + dy * u, c0 + dc * u
                out_vote[row, column] = 0
                out_weight[row, column] = 0
                edge = min(min(x - margin, x_last - x), min(y - margin, y_last - y))
                if not (edge >= zero and c > zero):
                    continue
                ramp = min((edge + one) / feather, one)
                xi, yi = int(x), int(y)
                sure = trust[int((y + rounding) * trust_y), int((x + rounding) * trust_x)]
                if sure == 0:
                    continue
                rest = still[int((y + rounding) * still_y), int((x + rounding) * still_x)]
                if rest == 0:
                    continue
                ramp *= np.float32(sure) * np.float32(rest) * (one / (full * full))
                s, t = x - np.float32(xi), y - np.float32(yi)
                if cubic:
                    r, g, b = _cubic(flat, stride, xi, yi - top, s, t)
                else:
                    r, g, b = _linear(flat, stride, xi, yi - top, s, t)
                light = l0 + dl * u
                r, g, b = r * (gain_r * light), g * (gain_g * light), b * (gain_b * light)
                out[0, row, column] = np.uint8(min(max(r + rounding, zero), full))
                out[1, row, column] = np.uint8(min(max(g + rounding, zero), full))
                out[2, row, column] = np.uint8(min(max(b + rounding, zero), full))
                if fine is not None:
                    top_fine, n = np.float32(255), np.float32(256)
                    for channel, value in ((0, r), (1, g), (2, b)):
                        part = min(max(value, zero), full) + rounding - np.float32(out[channel, row, column])
                        fine[channel, row, column] = np.uint8(min(max(part * n, zero), top_fine))
                out_vote[row, column] = np.uint8(min(max(c * ramp + rounding, one), full))
                out_weight[row, column] = np.uint8(min(max((w0 + dw * u) * ramp + rounding, one), full))
