"""The compiled kernel of the direct estimator for the CPU video path: select, sample, linearise, accumulate.

Every function is pure, releases the GIL and keeps pixels in float32 and sums in float64. `kernel_torch` is the
reference with the same meaning; a test holds the two together.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from mosaic.photometric import NORMAL_QUANTILE, SCALE_QUANTILE, TUKEY, TUKEY_VARIANCE

_jit = nb.njit(cache=True, nogil=True, fastmath=False, boundscheck=False)
_ONE, _TWO = np.uint64(1), np.uint64(2)
_INFINITY = np.uint32(0x7F800000)  # the bits of +inf; those of NaN are above


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
    # A row's squared gradients at once, in vectors, then who is the strongest of each bin: a third of the time of doing
    # both pixel by pixel.
    squares = np.zeros(w, np.float32)
    best = np.empty(n_bx, np.float32)
    best_x = np.empty(n_bx, np.int64)
    best_y = np.empty(n_bx, np.int64)
    edges = np.arange(n_bx + 1) * w // n_bx
    edges[0], edges[-1] = 2, w - 2
    for by in range(n_by):
        best[:] = square
        best_x[:] = -1
        for y in range(max(2, by * h // n_by), min(h - 2, (by + 1) * h // n_by)):
            left, right = level[y, : w - 2], level[y, 2:]
            above, below = level[y - 1, 1 : w - 1], level[y + 1, 1 : w - 1]
            for i in range(w - 2):
                gx = np.float32(right[i]) - np.float32(left[i])
                gy = np.float32(below[i]) - np.float32(above[i])
                squares[i + 1] = gx * gx + gy * gy
            for bx in range(n_bx):
                most = best[bx]
                for x in range(edges[bx], edges[bx + 1]):
                    if squares[x] > most:
                        if use_mask:
                            mx = min(mask.shape[1] - 1, int((x + 0.5) * mask_sx))
                            my = min(mask.shape[0] - 1, int((y + 0.5) * mask_sy))
                            if mask[my, mx] == 0:
                                continue
                        most = squares[x]
                        best_x[bx], best_y[bx] = x, y
                best[bx] = most
        for bx in range(n_bx):
            if best_x[bx] < 0:
                continue
            x, y = best_x[bx], best_y[bx]
            xs[count], ys[count] = x, y
            values[count] = np.float32(level[y, x])
            gxs[count] = (np.float32(level[y, x + 1]) - np.float32(level[y, x - 1])) * np.float32(0.5)
            gys[count] = (np.float32(level[y + 1, x]) - np.float32(level[y - 1, x])) * np.float32(0.5)
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
def _cubic(t):  # type: ignore[no-untyped-def]
    """Weights of the pixels at -1, 0, 1, 2 for a value at t in 0..1: cubic convolution with a = -1/2."""
    t2 = t * t
    t3 = t2 * t
    h = np.float32(0.5)
    return (
        h * (np.float32(2.0) * t2 - t3 - t),
        h * (np.float32(3.0) * t3 - np.float32(5.0) * t2) + np.float32(1.0),
        h * (np.float32(4.0) * t2 - np.float32(3.0) * t3 + t),
        h * (t3 - t2),
    )


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
        # Unsigned indices: numba leaves out the test for negative ones.
        ix = np.uint64(x)
        iy = np.uint64(y)
        fx = np.float32(x - np.float64(ix))
        fy = np.float32(y - np.float64(iy))
        ex = np.float32(1.0) - fx
        ey = np.float32(1.0) - fy
        a00 = np.float32(level[iy, ix])
        a01 = np.float32(level[iy, ix + _ONE])
        a10 = np.float32(level[iy + _ONE, ix])
        a11 = np.float32(level[iy + _ONE, ix + _ONE])
        left0 = np.float32(level[iy, ix - _ONE])
        left1 = np.float32(level[iy + _ONE, ix - _ONE])
        right0 = np.float32(level[iy, ix + _TWO])
        right1 = np.float32(level[iy + _ONE, ix + _TWO])
        up0 = np.float32(level[iy - _ONE, ix])
        up1 = np.float32(level[iy - _ONE, ix + _ONE])
        down0 = np.float32(level[iy + _TWO, ix])
        down1 = np.float32(level[iy + _TWO, ix + _ONE])
        # Cubic convolution (Keys 1981): linear sampling blurs by up to a quarter px^2, depending on the fraction, and
        # what it takes from the texture pulls where one fraction holds for the whole picture (a slow pan).
        x0, x1, x2, x3 = _cubic(fx)
        y0, y1, y2, y3 = _cubic(fy)
        corner00 = np.float32(level[iy - _ONE, ix - _ONE])
        corner03 = np.float32(level[iy - _ONE, ix + _TWO])
        corner30 = np.float32(level[iy + _TWO, ix - _ONE])
        corner33 = np.float32(level[iy + _TWO, ix + _TWO])
        value = (
            y0 * (x0 * corner00 + x1 * up0 + x2 * up1 + x3 * corner03)
            + y1 * (x0 * left0 + x1 * a00 + x2 * a01 + x3 * right0)
            + y2 * (x0 * left1 + x1 * a10 + x2 * a11 + x3 * right1)
            + y3 * (x0 * corner30 + x1 * down0 + x2 * down1 + x3 * corner33)
        )
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
    c = TUKEY * scale if tukey else 1.345 * scale
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
def linearise_cells(  # type: ignore[no-untyped-def]
    level, sx, sy, dst, shift, cell, A, values, gradients, gain, offset, mask, mask_sx, mask_sy, use_mask
):
    """`linearise` with the points of each cell moved by its shift (c, 2) px; returns residual, G and the points."""
    moved = np.empty_like(dst)
    for i in range(len(dst)):
        moved[i, 0] = dst[i, 0] + shift[cell[i], 0]
        moved[i, 1] = dst[i, 1] + shift[cell[i], 1]
    residual, G = linearise(
        level, sx, sy, moved, A, values, gradients, gain, offset, mask, mask_sx, mask_sy, use_mask
    )
    return residual, G, moved


@_jit
def robust_scale(residual):  # type: ignore[no-untyped-def]
    """(standard deviation of the agreeing pixels, number that are finite) of residuals (n,), grey levels.

    From a quantile of |residual| (photometric.SCALE_QUANTILE); at least .5, the quantisation; NaN without any.
    """
    # Selection by the bits: floats that are not negative order like their bits as integers. Twelve bits count first,
    # then the few values that share them are sorted: a quarter of the time of a partition.
    absolute = np.abs(residual)
    bits = absolute.view(np.uint32)
    counts = np.zeros(4096, np.int64)
    n = 0
    for i in range(len(bits)):
        if bits[i] < _INFINITY:
            counts[bits[i] >> np.uint32(19)] += 1
            n += 1
    if n == 0:
        return np.nan, 0
    k = int(SCALE_QUANTILE * n)
    chosen = 0
    while k >= counts[chosen]:
        k -= counts[chosen]
        chosen += 1
    few = np.empty(counts[chosen], np.float32)
    m = 0
    for i in range(len(bits)):
        if bits[i] >> np.uint32(19) == chosen:
            few[m] = absolute[i]
            m += 1
    return max(float(np.sort(few)[k]) / NORMAL_QUANTILE, 0.5), n


@_jit
def inlier_scale(residual, scale):  # type: ignore[no-untyped-def]
    """Standard deviation of the pixels that agree, from the robust scale (too large by those that do not).

    Fixed point of the Tukey-weighted variance, from above: what disagrees loses its weight step by step. At least .5.
    """
    for _ in range(8):
        c2 = 1.0 / (TUKEY * TUKEY * scale * scale)
        total = 0.0
        squares = 0.0
        for i in range(len(residual)):
            r2 = np.float64(residual[i]) * np.float64(residual[i])
            u = r2 * c2
            if u < 1.0:  # false for NaN
                w = (1.0 - u) * (1.0 - u)
                total += w
                squares += w * r2
        if not total > 0.0:
            break
        smaller = max(np.sqrt(squares / total / TUKEY_VARIANCE), 0.5)
        done = smaller > 0.98 * scale
        scale = min(smaller, scale)
        if done:
            break
    return scale


@_jit
def tukey_cost(residual, scale):  # type: ignore[no-untyped-def]
    """Tukey's cost over the pixels, 0 (all agree) to 1; a pixel that is not seen costs 1."""
    total = 0.0
    for i in range(len(residual)):
        u = np.float64(residual[i]) / (TUKEY * scale)
        u *= u
        total += 1.0 - (1.0 - u) ** 3 if u < 1.0 else 1.0
    return total / max(len(residual), 1)


@_jit
def shifted_residuals(  # type: ignore[no-untyped-def]
    level, sx, sy, dst, shifts, stride, values, gain, offset, mask, mask_sx, mask_sy, use_mask
):
    """Residuals of every stride-th pixel at points moved by each of shifts (m, 2) px, as one array (m k,)."""
    points = np.ascontiguousarray(dst[::stride])
    chosen = values[::stride]
    k = len(points)
    out = np.empty(len(shifts) * k, np.float32)
    for m in range(len(shifts)):
        seen = sample(level, sx, sy, points + shifts[m], mask, mask_sx, mask_sy, use_mask)
        for i in range(k):
            out[m * k + i] = chosen[i] - np.float32(gain) * seen[i] - np.float32(offset)
    return out


@_jit
def cell_steps(A, b, variance, max_std):  # type: ignore[no-untyped-def]
    """Newton step (c, 2) of each cell in the directions that its texture shows, and what it knows of them.

    A (c, 2, 2), b (c, 2) as accumulate_cells gives them; variance of the residuals. Returns step, eigenvectors
    (c, 2, 2; columns), their variances (c, 2) px^2, and known (c, 2): variance below max_std^2; others do not move.
    """
    n = len(A)
    step = np.zeros((n, 2))
    vectors = np.empty((n, 2, 2))
    std2 = np.empty((n, 2))
    known = np.zeros((n, 2), np.bool_)
    for c in range(n):
        half = 0.5 * (A[c, 0, 0] + A[c, 1, 1])
        skew = 0.5 * (A[c, 0, 0] - A[c, 1, 1])
        root = np.hypot(skew, A[c, 0, 1])
        angle = 0.5 * np.arctan2(A[c, 0, 1], skew)  # of the larger eigenvalue's direction
        ux = np.cos(angle)
        uy = np.sin(angle)
        vectors[c, 0, 0], vectors[c, 1, 0] = -uy, ux
        vectors[c, 0, 1], vectors[c, 1, 1] = ux, uy
        for k in range(2):
            value = max(half - root if k == 0 else half + root, 1e-12)
            std2[c, k] = variance / value
            if std2[c, k] < max_std * max_std:
                known[c, k] = True
                along = (vectors[c, 0, k] * b[c, 0] + vectors[c, 1, k] * b[c, 1]) / value
                step[c, 0] += vectors[c, 0, k] * along
                step[c, 1] += vectors[c, 1, k] * along
    return step, vectors, std2, known


@_jit
def cell_scores(residual, G, J, weight, cell, n_cells):  # type: ignore[no-untyped-def]
    """Gradients (c, p) of half the weighted squares, one a cell: sum w r G J, J (n, 2, p); together accumulate's b."""
    p = J.shape[2]
    out = np.zeros((n_cells, p))
    for i in range(residual.shape[0]):
        w = np.float64(weight[i])
        if w <= 0.0:
            continue
        wr = w * np.float64(residual[i])
        g0 = np.float64(G[i, 0])
        g1 = np.float64(G[i, 1])
        for k in range(p):
            out[cell[i], k] += wr * (g0 * J[i, 0, k] + g1 * J[i, 1, k])
    return out


@_jit
def cell_moments(G, J, weight, cell, n_cells):  # type: ignore[no-untyped-def]
    """Sums (c, p, 2) of w (J^T g) g^T a cell: what accumulate's b becomes when a cell is off by one px in x or y."""
    p = J.shape[2]
    out = np.zeros((n_cells, p, 2))
    for i in range(len(weight)):
        w = np.float64(weight[i])
        if w <= 0.0:
            continue
        g0 = np.float64(G[i, 0])
        g1 = np.float64(G[i, 1])
        for k in range(p):
            row = w * (g0 * J[i, 0, k] + g1 * J[i, 1, k])
            out[cell[i], k, 0] += row * g0
            out[cell[i], k, 1] += row * g1
    return out
