"""What moves in a picture, and what is stuck to the screen: from small pictures before and after it, warped onto it.

An object at this moment differs from what is seen there both earlier and later, and those two agree: that is the
ground it covers. Ground that it has just left, or will cover soon, differs from one side only. So neighbours of both
sides vote, each with its colour, and the nearer ones less: a slow player agrees with himself a moment ago. Who stands
still for longer than the farthest neighbour is not seen here (mosaic.moving compares with the composite).

Pictures only: where the neighbours lie comes in as a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """noise_grey: mean difference of the channels that noise and coding explain at the small size. detail: share of
    the contrast of a 3 x 3 neighbourhood that a misregistration explains (a quarter: one full px at a quarter of the
    size). alternative: weight of the neighbours that agree on another colour, over that of those which agree with
    the picture, from which the picture is taken for an object. slow_frames: a neighbour so far away counts fully.
    low, halo, doubtful: trust (of 255) of what moves, of what lies close round it or is enclosed by it, and of pixels
    that nobody confirms. grow_px: small px by
    which what moves is widened (shadow, motion blur, coding ringing). min_area_px: smaller specks are noise."""

    noise_grey: float = 9.0
    detail: float = 0.3
    alternative: float = 0.65
    slow_frames: float = 50.0
    low: int = 2
    halo: int = 24
    doubtful: int = 100
    grow_px: int = 2
    min_area_px: int = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neighbour:
    """A small picture rgb (h, w, 3) uint8 of another moment, frames later (negative: earlier), and where the pixels of
    the picture in question lie in it: at_px (h, w, 2) float32, anything outside where it does not see them."""

    rgb: Plane
    frames: float
    at_px: NDArray[np.float32]


def expand_map(nodes: NDArray[np.float64], step: int, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """A map given at every step-th pixel (rows, columns, 2), one beyond each end, at all pixels (h, w, 2)."""
    far = np.where(np.isfinite(nodes), nodes, -1e6).astype(np.float32)
    at = np.empty((size_px[1], size_px[0], 2), np.float32)
    _interpolate(far, step, at)
    return at


@numba.njit(cache=True, nogil=True)
def _interpolate(nodes, step, at):  # type: ignore[no-untyped-def]
    """Bilinear between nodes (rows, columns, 2) `step` apart, into at (h, w, 2)."""
    height, width = at.shape[:2]
    per = np.float32(1) / np.float32(step)
    one = np.float32(1)
    for i in range(height):
        row = i // step
        v = np.float32(i - row * step) * per
        for left in range(0, width, step):
            column = left // step
            for c in range(2):
                start = nodes[row, column, c] * (one - v) + nodes[row + 1, column, c] * v
                end = nodes[row, column + 1, c] * (one - v) + nodes[row + 1, column + 1, c] * v
                slope = (end - start) * per
                for j in range(left, min(left + step, width)):
                    at[i, j, c] = start + slope * np.float32(j - left)


def tolerance(rgb: Plane, options: MotionOptions) -> NDArray[np.float32]:
    """Difference (h, w), grey levels, that noise and a slight misregistration explain at each pixel."""
    return np.float32(options.noise_grey) + np.float32(options.detail) * local_contrast(rgb)


def local_contrast(rgb: Plane) -> NDArray[np.float32]:
    """Range of each 3 x 3 neighbourhood (h, w), mean of the channels."""
    contrast = cv2.morphologyEx(rgb, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    # numpy's mean over three channels takes ten times as long
    return np.asarray(cv2.transform(contrast, np.full((1, 3), 1 / 3)), np.float32)


@numba.njit(cache=True, nogil=True, inline="always")
def _apart(r0, g0, b0, r1, g1, b1):  # type: ignore[no-untyped-def]
    """Mean difference of the channels; the largest counts twice (white on green differs in red and blue only)."""
    d0 = abs(np.float32(r0) - np.float32(r1))
    d1 = abs(np.float32(g0) - np.float32(g1))
    d2 = abs(np.float32(b0) - np.float32(b1))
    return np.float32(0.25) * (d0 + d1 + d2 + max(d0, max(d1, d2)))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _judge(now, others, seen, frames, weight, allowed, alternative, verdict):  # type: ignore[no-untyped-def]
    """Per pixel: 2 = moves, 1 = nobody confirms it, 0 = at rest or nothing known.

    now (3, h, w), others (k, 3, h, w) and seen (k, h, w): neighbours on the picture's pixels; frames, weight (k,);
    allowed (h, w). Planes, not pixels: so the first loop, which settles nearly all of a picture, runs in vectors.
    """
    n, height, width = seen.shape
    off = np.empty(n, np.int32)
    own, against = np.empty(width, np.float32), np.empty(width, np.float32)
    sides = np.empty((2, width), np.float32)
    zero = np.float32(0)
    for i in range(height):
        own[:] = 0
        against[:] = 0
        sides[:] = 0
        limit = allowed[i]
        red, green, blue = now[0, i], now[1, i], now[2, i]
        for k in range(n):
            share = weight[k]
            side = sides[0 if frames[k] < 0 else 1]
            known, r, g, b = seen[k, i], others[k, 0, i], others[k, 1, i], others[k, 2, i]
            for j in range(width):
                d = _apart(red[j], green[j], blue[j], r[j], g[j], b[j])
                counts = np.float32(known[j])
                away = counts if d > np.float32(1.5) * limit[j] else zero
                own[j] += share * (counts if d <= limit[j] else zero)
                against[j] += share * away
                side[j] += away
        for j in range(width):
            verdict[i, j] = 0
            if sides[0, j] == 0 or sides[1, j] == 0:
                continue
            if own[j] > 0 and not against[j] > alternative * own[j]:
                continue  # even if all of them agreed
            n_off = 0
            for k in range(n):
                if seen[k, i, j]:
                    o = others[k, :, i, j]
                    if _apart(red[j], green[j], blue[j], o[0], o[1], o[2]) > np.float32(1.5) * limit[j]:
                        off[n_off] = k
                        n_off += 1
            best = zero
            for a in range(n_off):
                support, earlier, later = zero, False, False
                mine = others[off[a], :, i, j]
                for b in range(n_off):
                    kb = off[b]
                    o = others[kb, :, i, j]
                    if _apart(mine[0], mine[1], mine[2], o[0], o[1], o[2]) <= limit[j]:
                        support += weight[kb]
                        earlier = earlier or frames[kb] < 0
                        later = later or frames[kb] > 0
                if earlier and later:
                    best = max(best, support)
            if best > alternative * own[j]:
                verdict[i, j] = 2
            elif own[j] == 0:
                verdict[i, j] = 1


def still_plane(now: Plane, neighbours: Sequence[Neighbour], options: MotionOptions | None = None) -> Plane:
    """Trust (h, w) uint8 that a pixel of `now` (h, w, 3) shows the scene at rest: 255, or low where it moves.

    With neighbours of one side only nothing can be said, and all of it is 255. Exposure is levelled by one gain per
    neighbour and channel."""
    options = options or MotionOptions()
    height, width = now.shape[:2]
    others, seen, frames = align_neighbours(now, neighbours)
    if not (frames < 0).any() or not (frames > 0).any():
        return np.full((height, width), 255, np.uint8)
    weight = (0.35 + 0.65 * np.minimum(np.abs(frames) / options.slow_frames, 1.0)).astype(np.float32)
    allowed = tolerance(now, options)
    verdict = np.empty((height, width), np.uint8)
    _judge(_planes(now), others, seen, frames, weight, allowed, np.float32(options.alternative), verdict)
    core, body = _solid((verdict == 2).astype(np.uint8), options)
    still = np.where(verdict == 1, np.uint8(options.doubtful), np.uint8(255))
    still[body > 0] = options.halo
    still[core > 0] = options.low
    return still


def align_neighbours(
    now: Plane, neighbours: Sequence[Neighbour]
) -> tuple[Plane, NDArray[np.bool_], NDArray[np.float32]]:
    """Neighbours on the pixels of `now`, levelled to its exposure: planes (k, 3, h, w), seen (k, h, w), frames (k,)."""
    height, width = now.shape[:2]
    others = np.empty((len(neighbours), 3, height, width), np.uint8)
    seen = np.empty((len(neighbours), height, width), bool)
    frames = np.array([n.frames for n in neighbours], np.float32)
    sparse = np.s_[::6, ::6]
    few = _planes(now[sparse])
    some, usable = np.empty_like(few), np.empty(few.shape[1:], bool)
    levels = np.arange(256, dtype=np.float32)
    as_it_is = np.tile(levels.astype(np.uint8), (3, 1))
    for k, neighbour in enumerate(neighbours):
        at = neighbour.at_px
        packed = np.asarray(cv2.cvtColor(neighbour.rgb, cv2.COLOR_RGB2RGBA)).view(np.uint32)[..., 0]
        _warp(packed, np.ascontiguousarray(at[sparse]), as_it_is, some, usable)
        table = as_it_is
        if usable.any():
            ratio = (few[:, usable].astype(np.float32) + 4.0) / (some[:, usable].astype(np.float32) + 4.0)
            gain = np.clip(np.median(ratio, axis=1), 0.5, 2.0).astype(np.float32)
            table = np.minimum(gain[:, None] * levels + 0.5, 255).astype(np.uint8)
        _warp(packed, at, table, others[k], seen[k])
    return others, seen, frames


def _planes(rgb: Plane) -> Plane:
    """(h, w, 3) to (3, h, w)."""
    return np.ascontiguousarray(rgb.transpose(2, 0, 1))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _warp(packed, at, table, out, seen):  # type: ignore[no-untyped-def]
    """packed (H, W) uint32 RGBA at the places at (h, w, 2), bilinear, through table (3, 256): out (3, h, w), seen.

    Fixed point, a 256th of a pixel: red and blue are weighted in one multiplication, 16 bits each."""
    height, width = packed.shape
    flat = packed.reshape(-1)
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    scale, two, eight = np.float32(256), np.uint64(0x00FF00FF), np.uint64(8)
    one, low = np.uint64(1), np.uint64(0xFF)
    for i in range(seen.shape[0]):
        red, green, blue = out[0, i], out[1, i], out[2, i]
        for j in range(seen.shape[1]):
            x, y = at[i, j, 0], at[i, j, 1]
            inside = (x >= 0) and (x <= last_x) and (y >= 0) and (y <= last_y)
            seen[i, j] = inside
            if not inside:
                red[j], green[j], blue[j] = 0, 0, 0
                continue
            fine_x, fine_y = int(x * scale), int(y * scale)
            xi, yi = min(fine_x >> 8, width - 2), min(fine_y >> 8, height - 2)
            u, v = fine_x - (xi << 8), fine_y - (yi << 8)
            k11 = (u * v + 128) >> 8
            w11, w01, w10 = np.uint64(k11), np.uint64(u - k11), np.uint64(v - k11)
            w00 = np.uint64(256 - u - v + k11)
            p = np.uint64(yi * width + xi)
            q = p + np.uint64(width)
            p00, p01, p10, p11 = (
                np.uint64(flat[p]),
                np.uint64(flat[p + one]),
                np.uint64(flat[q]),
                np.uint64(flat[q + one]),
            )
            rb = (p00 & two) * w00 + (p01 & two) * w01 + (p10 & two) * w10 + (p11 & two) * w11
            rb += np.uint64(0x00800080)
            g = ((p00 >> eight) & low) * w00 + ((p01 >> eight) & low) * w01
            g += ((p10 >> eight) & low) * w10 + ((p11 >> eight) & low) * w11 + np.uint64(128)
            red[j] = table[0, (rb >> eight) & low]
            green[j] = table[1, g >> eight]
            blue[j] = table[2, (rb >> np.uint64(24)) & low]


def _solid(moves: Plane, options: MotionOptions) -> tuple[Plane, Plane]:
    """Without specks; and the same with holes of bodies closed, widened."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(moves, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= options.min_area_px
    large[0] = False
    kept = large[labels].astype(np.uint8)
    closed = cv2.morphologyEx(kept, cv2.MORPH_CLOSE, _disc(5), borderValue=0)
    flood = np.pad(closed, 1)
    cv2.floodFill(flood, None, (0, 0), 2)
    holes = (flood[1:-1, 1:-1] == 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= moves.size // 500  # a ring of players round free grass stays a ring
    small[0] = False
    filled = np.maximum(closed, small[labels].astype(np.uint8))
    return kept, np.asarray(cv2.dilate(filled, _disc(2 * options.grow_px + 1)), np.uint8)


def _disc(side: int) -> Plane:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


class ScreenFixed:
    """What stays at its place on the screen while the scene moves, counted over a shot.

    A pixel that agrees with its neighbour in time as it is, and not when the neighbour is moved as the camera moved,
    votes for a graphic; one that only agrees when moved votes against it; grass agrees both ways and says nothing.
    """

    def __init__(self, size_px: tuple[int, int], options: MotionOptions | None = None) -> None:
        self.options = options or MotionOptions()
        self.fixed: NDArray[np.float32] = np.zeros(size_px[::-1], np.float32)
        self.told: NDArray[np.float32] = np.zeros(size_px[::-1], np.float32)
        self.looked: NDArray[np.float32] = np.zeros(size_px[::-1], np.float32)
        self.n_looks = 0

    def look(self, now: Plane, neighbour: Neighbour, min_shift_px: float = 3.0) -> bool:
        """Take one pair into account; says whether the camera moved enough between the two to tell."""
        height, width = now.shape[:2]
        rest = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        if np.median(np.abs(neighbour.at_px - rest)[::8, ::8].max(axis=-1)) < min_shift_px:
            return False
        moved, seen, _ = align_neighbours(now, [neighbour])
        allowed = tolerance(now, self.options)
        here = _planes(now)
        as_it_is, as_moved = _difference(here, _planes(neighbour.rgb)), _difference(here, moved[0])
        # Where the neighbour does not look, nothing says that the scene would have been different.
        stays = (as_it_is <= allowed) & (as_moved > 1.5 * allowed) & seen[0]
        goes = (as_it_is > 1.5 * allowed) & seen[0]
        self.fixed += stays
        self.told += stays | goes
        self.looked += seen[0]
        self.n_looks += 1
        return True

    def mask(self, min_looks: int = 5, share: float = 0.7) -> NDArray[np.bool_] | None:
        """(h, w) bool, True = scene, or None: no graphic, or too few looks to say."""
        if self.n_looks < min_looks:
            return None
        seeds = (self.fixed > share * self.told) & (self.fixed >= np.maximum(4, 0.5 * self.looked))
        against = self.told - self.fixed > 0.5 * self.told
        closed = cv2.morphologyEx(seeds.astype(np.uint8), cv2.MORPH_CLOSE, _disc(7), borderValue=0)
        filled = (closed > 0) & (seeds | ~against)
        found = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        _, labels, stats, _ = cv2.connectedComponentsWithStats(found, connectivity=8)
        large = stats[:, cv2.CC_STAT_AREA] >= 12
        large[0] = False
        if not large.any() or large[labels].mean() > 0.3:  # so much of a picture is not a graphic
            return None
        return cv2.dilate(large[labels].astype(np.uint8), _disc(2 * self.options.grow_px + 1)) == 0


@numba.njit(cache=True, nogil=True)
def _difference(a, b):  # type: ignore[no-untyped-def]
    """The measure of _apart for whole pictures (3, h, w)."""
    out = np.empty(a.shape[1:], np.float32)
    for i in range(a.shape[1]):
        for j in range(a.shape[2]):
            out[i, j] = _apart(a[0, i, j], a[1, i, j], a[2, i, j], b[0, i, j], b[1, i, j], b[2, i, j])
    return out
