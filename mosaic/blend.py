"""From overlapping views of the same surface to one value a pixel: sampling, gains, robust value.

The kernels are numba: they release the GIL, so that two threads work on two tiles. It does not choose which frames
to use (views.py) and holds no picture (framestore.py).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

# --- sampling ----------------------------------------------------------------------------------------------------


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


# --- photometry --------------------------------------------------------------------------------------------------


def solve_log_gains(
    log_samples: NDArray[np.floating],
    weight: NDArray[np.floating],
    *,
    prior_std: float = 0.3,
    noise_std: float = 0.05,
    n_steps: int = 6,
) -> NDArray[np.float64]:
    """Log gain to ADD to each frame so that all agree, from log intensities of the same points in many frames.

    log_samples (n, p): frame i at point j; weight (n, p), 0 where not seen. Minimises sum w rho(y_ij + g_i - b_j) +
    (noise_std / prior_std)^2 sum g_i^2 over frame gains g and point colours b by iteratively reweighted least squares;
    the p colours are eliminated exactly, what is solved is n x n. Huber first, then Tukey: players must not pull.
    Returns (n,), median 0. A frame that shares no point with another gets 0 (before the median is taken off).
    """
    y = np.asarray(log_samples, dtype=np.float32)
    base = np.asarray(weight, dtype=np.float32)
    if y.shape != base.shape or y.ndim != 2:
        raise ValueError(f"samples {y.shape} and weights {base.shape} must be equal and two-dimensional")
    n = len(y)
    gain = np.zeros(n)
    shared = (base > 0).sum(axis=0) >= 2  # a point seen once says nothing
    y, base = y[:, shared], base[:, shared]
    if not shared.any():
        return gain
    ridge = (noise_std / prior_std) ** 2
    robust = base
    for step in range(n_steps):
        total = robust.sum(axis=0)
        share = robust / np.maximum(total, 1e-9)
        colour = (share * y).sum(axis=0)
        normal = -(robust @ share.T).astype(np.float64)
        normal[np.diag_indices(n)] += robust.sum(axis=1, dtype=np.float64) + ridge
        gain = np.linalg.solve(normal, -(robust * (y - colour)).sum(axis=1, dtype=np.float64))
        robust = gain_weights(y + gain[:, None].astype(np.float32), robust, base, step, n_steps)
    return gain - np.median(gain)


def gain_weights(
    adjusted: NDArray[np.float32],
    robust: NDArray[np.float32],
    base: NDArray[np.float32],
    step: int,
    n_steps: int,
) -> NDArray[np.float32]:
    """Weights (n, p) of the next of n_steps from samples as adjusted by this one: Huber, in the second half Tukey.

    robust, base (n, p): this step's weights, and those that the samples came with."""
    share = robust / np.maximum(robust.sum(axis=0), 1e-9)
    residual = adjusted - (share * adjusted).sum(axis=0)
    scale = max(1.4826 * float(np.median(np.abs(residual[base > 0]))), 0.005)
    ratio = np.abs(residual) / scale
    if step < n_steps // 2:
        return np.asarray(base / np.maximum(ratio / 1.5, 1.0), np.float32)
    return np.asarray(base * np.clip(1 - (ratio / 5.0) ** 2, 0.0, 1.0) ** 2, np.float32)


# --- robust value ------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def median_network(n: int) -> NDArray[np.int32]:
    """Comparators (m, 2) of Batcher's odd-even merge sort of n values, pruned to those that element n // 2 needs."""
    pairs: list[tuple[int, int]] = []
    p = 1
    while p < n:
        k = p
        while k >= 1:
            for j in range(k % p, n - k, 2 * k):
                for i in range(min(k, n - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):
                        pairs.append((i + j, i + j + k))
            k //= 2
        p *= 2
    needed, kept = {n // 2}, []
    for a, b in reversed(pairs):
        if a in needed or b in needed:
            needed |= {a, b}
            kept.append((a, b))
    network = np.array(kept[::-1], dtype=np.int32).reshape(-1, 2)
    network.setflags(write=False)
    return network


@lru_cache(maxsize=64)
def median_networks(n: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """median_network of 0, 1 ... n values one after the other (m, 2), and where each begins (n + 2,)."""
    networks = [median_network(count) if count else np.zeros((0, 2), np.int32) for count in range(n + 1)]
    return np.concatenate(networks), np.cumsum([0, *(len(network) for network in networks)])


_BLOCK = 256  # pixels sorted side by side: 48 views x 256 bytes stay in the first-level cache


@numba.njit(cache=True, nogil=True, inline="always")
def _sort(rows, networks, first, last):  # type: ignore[no-untyped-def]
    for m in range(first, last):
        a, b = rows[networks[m, 0]], rows[networks[m, 1]]
        for p in range(len(a)):
            x, y = a[p], b[p]
            a[p] = x if x < y else y
            b[p] = y if x < y else x


@numba.njit(cache=True, nogil=True, inline="always")
def _distance(r0, g0, b0, r1, g1, b1):  # type: ignore[no-untyped-def]
    """Distance of two colours in grey levels: mean of the channels, green twice."""
    d = (
        abs(np.int16(r0) - np.int16(r1))
        + 2 * abs(np.int16(g0) - np.int16(g1))
        + abs(np.int16(b0) - np.int16(b1))
    )
    return np.uint8((d + 2) >> 2)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _weighted_median(values, weights, n):  # type: ignore[no-untyped-def]
    """The smallest value v such that values <= v hold half of the weight, by halving 0..255 eight times: sums
    without branches, where an insertion sort of 20 values costs four times as much."""
    half = np.float32(0)
    for i in range(n):
        half += weights[i]
    half *= np.float32(0.5)
    low, high = np.int32(0), np.int32(255)
    while low < high:
        middle = (low + high) >> 1
        below = np.float32(0)
        for i in range(n):
            below += weights[i] if values[i] <= middle else np.float32(0)
        if below >= half:
            high = middle
        else:
            low = middle + 1
    return low


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _of_16_bits(grey, fine):  # type: ignore[no-untyped-def]
    """0..65535 of a grey level and its 256ths as sample_view gives them."""
    value = (grey + (fine - np.float32(128)) * np.float32(1 / 256)) * np.float32(257) + np.float32(0.5)
    return np.uint16(min(max(value, np.float32(0)), np.float32(65535)))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _densest(colour, votes, n, reach):  # type: ignore[no-untyped-def]
    """The view of n whose colour (3, n) most votes are near: sum of votes x (1 - distance / reach). Against the median
    by votes: .8, .7, -.1 dB where players passed (three generator clips of 120 frames with 20 % players)."""
    best, most = 0, np.float32(-1)
    for k in range(n):
        r, g, b = colour[0, k], colour[1, k], colour[2, k]
        total = np.float32(0)
        for j in range(n):
            d = abs(r - colour[0, j]) + np.float32(2) * abs(g - colour[1, j]) + abs(b - colour[2, j])
            total += votes[j] * max(reach - d, np.float32(0))
        if total > most:
            best, most = k, total
    return best


@numba.njit(cache=True, nogil=True)
def robust_value(  # type: ignore[no-untyped-def]
    stack,
    vote,
    weight,
    networks,
    begin,
    floor,
    cap,
    doubt,
    out,
    n_seen,
    spread,
    support,
    fine=None,
    deep=None,
):
    """One colour a pixel from n views.

    stack (n, 3, N), vote (n, N), weight (n, N) uint8 as sample_view gives them; networks, begin = median_networks(n).
    1. median per channel over the views that see the pixel (a missing one is padded with 0 and 255 in turn);
    2. distance d of each view to it (mean of channels, green twice), spread = 1.4826 median d;
    3. where spread > doubt (grey levels), or where 40 % of the votes are not near the median: instead the colour
       that most votes are near, because then it matters who votes (one moment seen many times, parallax, half-trusted
       views), and a ground that is always the same is denser than what passes over it. Costs several times the plain
       median, hence only there;
    4. weighted mean of the views within 2 min(spread, cap) + floor of the median; the nearest view if none is.
    One view: taken. Two: the one with more votes is the centre.
    Out, uint8: out (N, 3), n_seen (N,), spread (N,), support (N,) = 255 x share of the votes
    that are near the median, less where fewer than four views of some weight are: one trusted view among distrusted
    ones is no majority. deep (N, 3) uint16, where given with fine (n, 3, N) of sample_view: the same colour, 0..65535.
    """
    n_views, _, size = stack.shape
    rest = np.empty((3, _BLOCK), np.float32)
    rows = np.empty((n_views, _BLOCK), np.uint8)
    centre = np.empty((3, _BLOCK), np.uint8)
    apart = np.empty((n_views, _BLOCK), np.uint8)
    missing = np.empty(_BLOCK, np.uint8)
    median = np.empty(_BLOCK, np.uint8)
    pads = np.empty(_BLOCK, np.uint8)
    total = np.empty((7, _BLOCK), np.float32)
    strongest = np.empty(_BLOCK, np.uint8)
    present = np.empty(n_views, np.int64)  # views that see anything of the block: half of a tile's, usually
    who = np.empty(n_views, np.int64)  # of these, the ones that see the pixel
    colour = np.empty((3, n_views), np.float32)
    values = np.empty(n_views, np.int32)
    votes = np.empty(n_views, np.float32)
    reach = np.float32(4 * 20)  # distances here are sums of four
    for start in range(0, size, _BLOCK):
        length = min(_BLOCK, size - start)
        stop = start + length
        n = 0
        missing[:] = 0
        strongest[:] = 0
        for k in range(n_views):
            seen = vote[k, start:stop]
            most = np.uint8(0)
            for p in range(length):
                most = max(most, seen[p])
            if most == 0:
                continue
            present[n] = k
            n += 1
            for p in range(length):
                missing[p] += np.uint8(1) if seen[p] == 0 else np.uint8(0)
                strongest[p] = max(strongest[p], seen[p])
        if n == 0:
            out[start:stop] = 0
            if fine is not None:
                deep[start:stop] = 0
            n_seen[start:stop] = 0
            spread[start:stop] = 0
            support[start:stop] = 0
            continue
        half = n // 2
        # Odd n: the first pad goes high, even n: low, so that the rank stays the middle.
        first_pad = np.uint8(n % 2)
        for c in range(4):
            pads[:] = first_pad
            for i in range(n):
                row = rows[i]
                source = stack[present[i], c, start:stop] if c < 3 else apart[i, :length]
                seen = vote[present[i], start:stop]
                for p in range(length):
                    absent = np.uint8(1) if seen[p] == 0 else np.uint8(0)
                    pad = np.uint8(255) if pads[p] & np.uint8(1) else np.uint8(0)
                    row[p] = pad if absent else source[p]
                    pads[p] += absent
            _sort(rows, networks, begin[n], begin[n + 1])
            if c < 3:
                for p in range(length):
                    centre[c, p] = rows[half, p]
            else:
                for p in range(length):
                    median[p] = rows[half, p]
            if c == 2:
                for i in range(n):
                    k = present[i]
                    r, g, b = stack[k, 0, start:stop], stack[k, 1, start:stop], stack[k, 2, start:stop]
                    for p in range(length):
                        apart[i, p] = _distance(r[p], g[p], b[p], centre[0, p], centre[1, p], centre[2, p])
        total[:] = 0
        for i in range(n):
            seen = vote[present[i], start:stop]
            for p in range(length):
                w = np.float32(seen[p])
                limit = np.float32(2) * min(np.float32(1.4826) * median[p], cap) + floor
                total[0, p] += w if apart[i, p] <= limit else np.float32(0)
                total[1, p] += w
        # Where the plain median may not be the right one: few views, disagreement, votes against it.
        for p in range(length):
            at = start + p
            count = n - missing[p]
            n_seen[at] = count
            sigma = np.float32(1.4826) * median[p]
            if count > 2 and sigma <= doubt and total[0, p] >= np.float32(0.6) * total[1, p]:
                spread[at] = np.uint8(min(sigma + np.float32(0.5), np.float32(255)))
                continue
            if count == 0:
                spread[at] = 0
                continue
            m, best = 0, 0
            for i in range(n):
                k = present[i]
                if vote[k, at] == 0:
                    continue
                who[m], votes[m] = i, vote[k, at]
                for c in range(3):
                    colour[c, m] = stack[k, c, at]
                if votes[m] > votes[best]:
                    best = m
                m += 1
            if count > 2:
                best = _densest(colour, votes, m, reach)
            for c in range(3):
                centre[c, p] = np.uint8(colour[c, best])
            for j in range(m):
                k = present[who[j]]
                d = _distance(
                    stack[k, 0, at],
                    stack[k, 1, at],
                    stack[k, 2, at],
                    centre[0, p],
                    centre[1, p],
                    centre[2, p],
                )
                apart[who[j], p] = d
                values[j] = d
            # Two views have no spread of their own: they count as one place when they differ by noise only.
            median[p] = _weighted_median(values, votes, m) if count > 2 else 0
            spread[at] = np.uint8(min(np.float32(1.4826) * median[p] + np.float32(0.5), np.float32(255)))
        total[:] = 0
        rest[:] = 0
        for i in range(n):
            k = present[i]
            r, g, b = stack[k, 0, start:stop], stack[k, 1, start:stop], stack[k, 2, start:stop]
            seen, share = vote[k, start:stop], weight[k, start:stop]
            for p in range(length):
                limit = np.float32(2) * min(np.float32(1.4826) * median[p], cap) + floor
                near = (seen[p] > 0) & (apart[i, p] <= limit)
                w = np.float32(share[p]) if near else np.float32(0)
                total[0, p] += w * r[p]
                total[1, p] += w * g[p]
                total[2, p] += w * b[p]
                total[3, p] += w
                total[4, p] += np.float32(seen[p]) if near else np.float32(0)
                total[5, p] += np.float32(seen[p])
                strong = near & (np.int32(seen[p]) * 8 >= np.int32(strongest[p]))
                total[6, p] += np.float32(1) if strong else np.float32(0)
                if fine is not None:
                    for c in range(3):
                        rest[c, p] += w * fine[k, c, start + p]
        for p in range(length):
            at = start + p
            share = total[4, p] / max(total[5, p], np.float32(1))
            support[at] = np.uint8(
                np.float32(255) * share * min(total[6, p] * np.float32(0.25), np.float32(1))
            )
            if total[3, p] > 0:
                for c in range(3):
                    out[at, c] = np.uint8(total[c, p] / total[3, p] + np.float32(0.5))
                    if fine is not None:
                        deep[at, c] = _of_16_bits(total[c, p] / total[3, p], rest[c, p] / total[3, p])
            elif missing[p] < n:
                nearest = -1
                for i in range(n):
                    if vote[present[i], at] > 0 and (nearest < 0 or apart[i, p] < apart[nearest, p]):
                        nearest = i
                for c in range(3):
                    out[at, c] = stack[present[nearest], c, at]
                    if fine is not None:
                        k = present[nearest]
                        deep[at, c] = _of_16_bits(np.float32(stack[k, c, at]), np.float32(fine[k, c, at]))
            else:
                for c in range(3):
                    out[at, c] = 0
                    if fine is not None:
                        deep[at, c] = 0


class Blended(NamedTuple):
    """What the views of a tile make: image (h, w, 3), n_seen, spread, support (h, w) uint8, see robust_value; deep
    (h, w, 3) uint16: the image with more than 8 bits, where the views have them."""

    image: NDArray[np.uint8]
    n_seen: NDArray[np.uint8]
    spread: NDArray[np.uint8]
    support: NDArray[np.uint8]
    deep: NDArray[np.uint16] | None


def blend_stack(
    stack: NDArray[np.uint8],
    vote: NDArray[np.uint8],
    weight: NDArray[np.uint8],
    fine: NDArray[np.uint8] | None = None,
    *,
    floor: float = 3.0,
    cap: float = 10.0,
    doubt: float = 6.0,
) -> Blended:
    """robust_value for a tile: stack (n, 3, h, w), vote, weight (n, h, w), and fine, shaped as stack, where the sources
    have more than 8 bits.

    floor, cap, doubt in grey levels, see robust_value. Raises ValueError for no view or more than 255.
    """
    n, _, height, width = stack.shape
    if not 1 <= n <= 255:
        raise ValueError(f"{n} views of a tile, need 1 to 255")
    image: NDArray[Any] = np.empty((height * width, 3), np.uint8)
    n_seen: NDArray[Any] = np.empty(height * width, np.uint8)
    spread: NDArray[Any] = np.empty(height * width, np.uint8)
    support: NDArray[Any] = np.empty(height * width, np.uint8)
    deep: NDArray[Any] | None = None if fine is None else np.empty((height * width, 3), np.uint16)
    robust_value(
        stack.reshape(n, 3, -1), vote.reshape(n, -1), weight.reshape(n, -1), *median_networks(n),
        np.float32(floor), np.float32(cap), np.float32(doubt), image, n_seen, spread, support,
        None if fine is None else fine.reshape(n, 3, -1), deep,
    )  # fmt: skip
    plane = (height, width)
    return Blended(
        image=image.reshape(*plane, 3), n_seen=n_seen.reshape(plane), spread=spread.reshape(plane),
        support=support.reshape(plane), deep=None if deep is None else deep.reshape(*plane, 3),
    )  # fmt: skip
