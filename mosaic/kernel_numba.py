"""The compiled kernel of the direct estimator for the CPU video path: select, sample, linearise, accumulate.

Every function is pure, releases the GIL and keeps pixels in float32 and sums in float64. `kernel_torch` is the
reference with the same meaning; a test holds the two together.
"""

from __future__ import annotations

import numba as nb
import numpy as np

_jit = nb.njit(cache=True, nogil=True, fastmath=False, boundscheck=False)


@_jit
def select_pixels(level, bin_px, threshold, mask, mask_sx, mask_sy, use_mask):  # type: ignore[no-untyped-def]
    """Strongest gradient of each bin_px x bin_px bin of a level, where it exceeds `threshold` (grey over 2 px).

    mask (uint8, 1 usable) is addressed by level pixel / mask_s. Returns x, y (int32), value, gx, gy (float32; per
    level px), in bin order.
    """
    h, w = level.shape
    n_bx = max(1, w // bin_px)
    n_by = max(1, h // bin_px)
    n = n_bx * n_by
    xs = np.empty(n, np.int32)
    ys = np.empty(n, np.int32)
    values = np.empty(n, np.float32)
    gxs = np.empty(n, np.float32)
    gys = np.empty(n, np.float32)
    count = 0
    square = threshold * threshold
    for by in range(n_by):
        y0 = max(2, by * h // n_by)
        y1 = min(h - 2, (by + 1) * h // n_by)
        for bx in range(n_bx):
            x0 = max(2, bx * w // n_bx)
            x1 = min(w - 2, (bx + 1) * w // n_bx)
            best = square
            best_x = -1
            best_y = -1
            for y in range(y0, y1):
                for x in range(x0, x1):
                    gx = np.float32(level[y, x + 1]) - np.float32(level[y, x - 1])
                    gy = np.float32(level[y + 1, x]) - np.float32(level[y - 1, x])
                    g = gx * gx + gy * gy
                    if g > best:
                        if use_mask:
                            mx = min(mask.shape[1] - 1, int((x + 0.5) * mask_sx))
                            my = min(mask.shape[0] - 1, int((y + 0.5) * mask_sy))
                            if mask[my, mx] == 0:
                                continue
                        best = g
                        best_x = x
                        best_y = y
            if best_x >= 0:
                xs[count] = best_x
                ys[count] = best_y
                values[count] = np.float32(level[best_y, best_x])
                gxs[count] = (
                    np.float32(level[best_y, best_x + 1]) - np.float32(level[best_y, best_x - 1])
                ) * np.float32(0.5)
                gys[count] = (
                    np.float32(level[best_y + 1, best_x]) - np.float32(level[best_y - 1, best_x])
                ) * np.float32(0.5)
                count += 1
    return xs[:count].copy(), ys[:count].copy(), values[:count].copy(), gxs[:count].copy(), gys[:count].copy()


@_jit
def sample(level, sx, sy, dst, mask, mask_sx, mask_sy, use_mask):  # type: ignore[no-untyped-def]
    """Bilinear values of a level at full-size points dst (n, 2); NaN outside or where the mask forbids."""
    n = dst.shape[0]
    h, w = level.shape
    out = np.empty(n, np.float32)
    for i in range(n):
        x = (dst[i, 0] - 0.5 * (sx - 1.0)) / sx
        y = (dst[i, 1] - 0.5 * (sy - 1.0)) / sy
        if not (x >= 1.0 and y >= 1.0 and x < w - 2.0 and y < h - 2.0):
            out[i] = np.nan
            continue
        if use_mask:
            mx = min(mask.shape[1] - 1, int((dst[i, 0] + 0.5) / mask_sx))
            my = min(mask.shape[0] - 1, int((dst[i, 1] + 0.5) / mask_sy))
            if mask[my, mx] == 0:
                out[i] = np.nan
                continue
        ix = int(x)
        iy = int(y)
        fx = np.float32(x - ix)
        fy = np.float32(y - iy)
        top = np.float32(level[iy, ix]) * (1 - fx) + np.float32(level[iy, ix + 1]) * fx
        low = np.float32(level[iy + 1, ix]) * (1 - fx) + np.float32(level[iy + 1, ix + 1]) * fx
        out[i] = top * (1 - fy) + low * fy
    return out


@_jit
def linearise(level, sx, sy, dst, A, values, gradients, gain, offset, mask, mask_sx, mask_sy, use_mask):  # type: ignore[no-untyped-def]
    """Residuals and second-order (ESM) gradients at the warped points.

    dst (n, 2) full px, A (n, 2, 2) = d dst / d src, values (n,) and gradients (n, 2; per full px of src) of the
    template. residual = value - (gain I(dst) + offset); gradient (n, 2) = mean of gain dI/d dst and of the
    template's gradient carried over by A^-T, per full px of dst. NaN residual = outside or masked.
    """
    n = dst.shape[0]
    h, w = level.shape
    residual = np.empty(n, np.float32)
    G = np.zeros((n, 2), np.float32)
    for i in range(n):
        x = (dst[i, 0] - 0.5 * (sx - 1.0)) / sx
        y = (dst[i, 1] - 0.5 * (sy - 1.0)) / sy
        if not (x >= 2.0 and y >= 2.0 and x < w - 3.0 and y < h - 3.0):
            residual[i] = np.nan
            continue
        if use_mask:
            mx = min(mask.shape[1] - 1, int((dst[i, 0] + 0.5) / mask_sx))
            my = min(mask.shape[0] - 1, int((dst[i, 1] + 0.5) / mask_sy))
            if mask[my, mx] == 0:
                residual[i] = np.nan
                continue
        ix = int(x)
        iy = int(y)
        fx = np.float32(x - ix)
        fy = np.float32(y - iy)
        ex = np.float32(1.0) - fx
        ey = np.float32(1.0) - fy
        a00 = np.float32(level[iy, ix])
        a01 = np.float32(level[iy, ix + 1])
        a10 = np.float32(level[iy + 1, ix])
        a11 = np.float32(level[iy + 1, ix + 1])
        value = (a00 * ex + a01 * fx) * ey + (a10 * ex + a11 * fx) * fy
        left0 = np.float32(level[iy, ix - 1])
        left1 = np.float32(level[iy + 1, ix - 1])
        right0 = np.float32(level[iy, ix + 2])
        right1 = np.float32(level[iy + 1, ix + 2])
        up0 = np.float32(level[iy - 1, ix])
        up1 = np.float32(level[iy - 1, ix + 1])
        down0 = np.float32(level[iy + 2, ix])
        down1 = np.float32(level[iy + 2, ix + 1])
        gx = 0.5 * (
            ((a01 - left0) * ex + (right0 - a00) * fx) * ey + ((a11 - left1) * ex + (right1 - a10) * fx) * fy
        )
        gy = 0.5 * (
            ((a10 - up0) * ex + (a11 - up1) * fx) * ey + ((down0 - a00) * ex + (down1 - a01) * fx) * fy
        )
        det = A[i, 0, 0] * A[i, 1, 1] - A[i, 0, 1] * A[i, 1, 0]
        if abs(det) < 1e-12:
            residual[i] = np.nan
            continue
        tx = (A[i, 1, 1] * gradients[i, 0] - A[i, 1, 0] * gradients[i, 1]) / det
        ty = (-A[i, 0, 1] * gradients[i, 0] + A[i, 0, 0] * gradients[i, 1]) / det
        residual[i] = values[i] - (gain * value + offset)
        G[i, 0] = 0.5 * (gain * gx / sx + tx)
        G[i, 1] = 0.5 * (gain * gy / sy + ty)
    return residual, G


@_jit
def robust_weights(residual, scale, tukey):  # type: ignore[no-untyped-def]
    """Tukey (4.685 scale) or Huber (1.345 scale) weights; 0 where the residual is NaN."""
    n = residual.shape[0]
    weight = np.zeros(n, np.float32)
    c = 4.685 * scale if tukey else 1.345 * scale
    for i in range(n):
        r = abs(residual[i])
        if not np.isfinite(r):
            continue
        if tukey:
            if r < c:
                u = 1.0 - (r / c) * (r / c)
                weight[i] = u * u
        else:
            weight[i] = 1.0 if r <= c else c / r
    return weight


@_jit
def accumulate(residual, G, J, weight):  # type: ignore[no-untyped-def]
    """Normal equations N (p, p), b (p,) and cost of sum w (r - G J d)^2; J (n, 2, p)."""
    n = residual.shape[0]
    p = J.shape[2]
    N = np.zeros((p, p))
    b = np.zeros(p)
    row = np.empty(p)
    cost = 0.0
    for i in range(n):
        w = np.float64(weight[i])
        if w <= 0.0:
            continue
        r = np.float64(residual[i])
        g0 = np.float64(G[i, 0])
        g1 = np.float64(G[i, 1])
        for k in range(p):
            row[k] = g0 * J[i, 0, k] + g1 * J[i, 1, k]
        cost += w * r * r
        for k in range(p):
            wk = w * row[k]
            b[k] += wk * r
            for m in range(k + 1):
                N[k, m] += wk * row[m]
    for k in range(p):
        for m in range(k):
            N[m, k] = N[k, m]
    return N, b, cost


@_jit
def accumulate_cells(residual, G, weight, src, dst, cell, n_cells):  # type: ignore[no-untyped-def]
    """Per-cell sums for the residual-flow grid.

    Returns A (c, 2, 2) = sum w g g^T, b (c, 2) = sum w g r, S (c, 5) = sums of t, t x_src, t y_src, t x_dst, t y_dst
    with texture weights t = w |g|^2, counts (c, 2) = pixels inside, pixels with weight > 0.3.
    """
    A = np.zeros((n_cells, 2, 2))
    b = np.zeros((n_cells, 2))
    S = np.zeros((n_cells, 5))
    counts = np.zeros((n_cells, 2))
    for i in range(residual.shape[0]):
        if not np.isfinite(residual[i]):
            continue
        c = cell[i]
        counts[c, 0] += 1.0
        w = np.float64(weight[i])
        if w > 0.3:
            counts[c, 1] += 1.0
        g0 = np.float64(G[i, 0])
        g1 = np.float64(G[i, 1])
        r = np.float64(residual[i])
        A[c, 0, 0] += w * g0 * g0
        A[c, 0, 1] += w * g0 * g1
        A[c, 1, 1] += w * g1 * g1
        b[c, 0] += w * g0 * r
        b[c, 1] += w * g1 * r
        t = w * (g0 * g0 + g1 * g1)
        S[c, 0] += t
        S[c, 1] += t * src[i, 0]
        S[c, 2] += t * src[i, 1]
        S[c, 3] += t * dst[i, 0]
        S[c, 4] += t * dst[i, 1]
    for c in range(n_cells):
        A[c, 1, 0] = A[c, 0, 1]
    return A, b, S, counts


@_jit
def homography_warp(H, centre_x, centre_y, scale, src):  # type: ignore[no-untyped-def]
    """Points of src (n, 2) through H with Jacobian (n, 2, 8) of a left increment and A = d dst / d src.

    The increment acts in coordinates u = (x - centre) / scale: I + [[d0, d1, d2], [d3, d4, d5], [d6, d7, 0]].
    """
    n = src.shape[0]
    dst = np.empty((n, 2))
    J = np.empty((n, 2, 8), np.float32)
    A = np.empty((n, 2, 2))
    for i in range(n):
        x = src[i, 0]
        y = src[i, 1]
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        if w <= 1e-12:
            dst[i, 0] = np.nan
            dst[i, 1] = np.nan
            for k in range(8):
                J[i, 0, k] = 0.0
                J[i, 1, k] = 0.0
            A[i, 0, 0] = 1.0
            A[i, 0, 1] = 0.0
            A[i, 1, 0] = 0.0
            A[i, 1, 1] = 1.0
            continue
        px = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
        py = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
        dst[i, 0] = px
        dst[i, 1] = py
        A[i, 0, 0] = (H[0, 0] - px * H[2, 0]) / w
        A[i, 0, 1] = (H[0, 1] - px * H[2, 1]) / w
        A[i, 1, 0] = (H[1, 0] - py * H[2, 0]) / w
        A[i, 1, 1] = (H[1, 1] - py * H[2, 1]) / w
        u = (px - centre_x) / scale
        v = (py - centre_y) / scale
        J[i, 0, 0] = scale * u
        J[i, 0, 1] = scale * v
        J[i, 0, 2] = scale
        J[i, 0, 3] = 0.0
        J[i, 0, 4] = 0.0
        J[i, 0, 5] = 0.0
        J[i, 0, 6] = -scale * u * u
        J[i, 0, 7] = -scale * u * v
        J[i, 1, 0] = 0.0
        J[i, 1, 1] = 0.0
        J[i, 1, 2] = 0.0
        J[i, 1, 3] = scale * u
        J[i, 1, 4] = scale * v
        J[i, 1, 5] = scale
        J[i, 1, 6] = -scale * u * v
        J[i, 1, 7] = -scale * v * v
    return dst, J, A
