"""From overlapping views of the same surface to one robust value a pixel.

The kernels are numba: they release the GIL, so that two threads work on two tiles. It does not choose which frames
to use (views.py), samples none (sampling.py), and holds no picture (framestore.py).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray


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
