"""The states of a panorama's pixels: the colours that frames show at each, and which of them are shown side by side.

Where a hoarding has changed its text or somebody stood, no pixel knows what its neighbour chose, and a picture put
together pixel by pixel is a patchwork that nobody ever saw. So a state is chosen for all pixels at once: the colour
that is likeliest by itself, but next to colours that some frame showed next to it (the seam cost of Agarwala et al.,
"Interactive Digital Photomontage", SIGGRAPH 2004, counted over all frames), by max-product belief propagation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mosaic.views import MOMENT_FRAMES

N_STATES = 4  # the likeliest ones of a pixel; N_STATES ** 2 bits have room in 16
SAME_GREY = 12  # colours that differ by less are one
EVIDENCE_STEP = 1 / 20  # nats per grey level of the evidence plane, 128 = none
# Pairs of pixels (down, right; px of a picture about 320 wide) that are asked whether a frame shows their states
# together, and what it costs, in nats, if none does: next to each other that is a seam; letters of one text and parts
# of one body lie farther apart.
APART = ((0, 1), (1, 0), (0, 5), (5, 0), (0, 12), (12, 0))
UNSEEN = (1.0, 1.0, 1.0, 1.0, 0.5, 0.5)
REACH = max(max(pair) for pair in APART)
# Restless is where no colour was seen at this share of the moments at which a place was seen, of so many at least.
RESTLESS_SHARE, RESTLESS_MOMENTS = 0.6, 4
SWEEPS = 3  # of belief propagation, each to and fro
NEVER = np.float32(-1e6)  # value of a state that a pixel does not have

Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Of each pixel the likeliest states. colour (h, w, N_STATES, 3); value (h, w, N_STATES): log of how likely one is
    by itself, up to a constant, NEVER where there are fewer; moments (h, w, N_STATES): at which it was seen. together
    (h, w, len(APART)) uint16: bit s * N_STATES + t is 1 if a frame shows state s here and t at the pixel APART.
    restless (h, w) bool: where no state comes again often.

    A pixel that is not contested has one state, the composite's."""

    colour: Picture
    value: NDArray[np.float32]
    moments: NDArray[np.uint8]
    together: NDArray[np.uint16]
    restless: NDArray[np.bool_]

    def part(self, x: int, y: int, side: int) -> States:
        """The same arrays, from x, y on, side x side or to their end."""
        box = np.s_[y : y + side, x : x + side]
        return States(
            self.colour[box], self.value[box], self.moments[box], self.together[box], self.restless[box]
        )

    def picture(
        self, chosen: Picture, composite: Picture, contested: NDArray[np.bool_]
    ) -> tuple[Picture, NDArray[np.int16]]:
        """The composite (h, w, 3) with the chosen states (h, w) where it is contested, and at how many moments these
        were seen (h, w), 0 elsewhere."""
        y, x = np.nonzero(contested & (self.value[..., 0] > NEVER))
        state = chosen[y, x]
        image, moments = composite.copy(), np.zeros(contested.shape, np.int16)
        image[y, x], moments[y, x] = self.colour[y, x, state], self.moments[y, x, state]
        return image, moments


def no_states(height: int, width: int) -> States:
    """States of no pixel yet. What is never written takes no memory."""
    return States(
        colour=np.zeros((height, width, N_STATES, 3), np.uint8),
        value=np.zeros((height, width, N_STATES), np.float32),
        moments=np.zeros((height, width, N_STATES), np.uint8),
        together=np.zeros((height, width, len(APART)), np.uint16),
        restless=np.zeros((height, width), np.bool_),
    )


def find_states(
    views: Picture,
    seen: Picture,
    frames: NDArray[np.int64],
    composite: Picture,
    contested: NDArray[np.bool_],
    states: States,
) -> None:
    """Fills `states` (h, w) from the views of a tile that may be larger by REACH to the right and below.

    views (n, h', w', 4): their colours and evidence for ground (EVIDENCE_STEP), in the order of time; seen (n, h', w'):
    0 = not the scene; frames (n,): their numbers; composite (h', w', 3) and contested (h', w')."""
    n, height, width = seen.shape
    colour = np.zeros((height, width, N_STATES, 3), np.uint8)
    value = np.full((height, width, N_STATES), NEVER, np.float32)
    moments = np.zeros((height, width, N_STATES), np.uint8)
    shows = np.full((n, height, width), -1, np.int8)
    restless = np.zeros((height, width), np.bool_)
    _find(views, seen, frames, composite, contested, colour, value, moments, shows, restless)
    h, w = states.moments.shape[:2]
    states.restless[:] = restless[:h, :w]
    states.colour[:], states.value[:], states.moments[:] = colour[:h, :w], value[:h, :w], moments[:h, :w]
    for edge, (down, right) in enumerate(APART):
        _together(shows, down, right, states.together[..., edge])


@numba.njit(cache=True, nogil=True)
def _find(views, seen, frames, composite, contested, colour, value, moments, shows, restless):  # type: ignore[no-untyped-def]
    """Each view's colour is a candidate, and the composite's: log of the moments at which views have it, plus the mean
    of what these views' evidence says. shows (n, h, w): which of the states a view shows, -1: none."""
    n, height, width = seen.shape
    present = np.empty(n, np.int64)
    # A plane a colour, and differences to all of them before any is asked about: these loops run in vectors.
    own = np.empty((3, n + 1), np.int32)
    apart = np.empty(n + 1, np.int32)
    evidence, when = np.empty(n, np.float32), np.empty(n, np.int64)
    worth = np.empty(n + 1, np.float32)
    n_at = np.empty(n + 1, np.int64)
    for i in range(height):
        for j in range(width):
            m = 0
            for k in range(n):
                if seen[k, i, j]:
                    present[m] = k
                    for c in range(3):
                        own[c, m] = views[k, i, j, c]
                    evidence[m], when[m] = np.float32(views[k, i, j, 3]) - np.float32(128), frames[k]
                    m += 1
            for c in range(3):
                own[c, m] = composite[i, j, c]
            if not contested[i, j]:
                value[i, j, 0] = 0
                for c in range(3):
                    colour[i, j, 0, c] = composite[i, j, c]
                _measure(own, m, m, apart)
                for b in range(m):
                    if apart[b] <= 4 * SAME_GREY:
                        shows[present[b], i, j] = 0
                continue
            for a in range(m + 1):
                last, n_moments, n_same, says = -MOMENT_FRAMES, 0, 0, np.float32(0)
                _measure(own, a, m, apart)
                for b in range(m):
                    if apart[b] > 4 * SAME_GREY:
                        continue
                    n_same += 1
                    says += evidence[b]
                    if when[b] - last >= MOMENT_FRAMES:
                        last = when[b]
                        n_moments += 1
                worth[a] = NEVER
                n_at[a] = n_moments
                if n_same > 0:
                    worth[a] = np.log(np.float32(n_moments)) + np.float32(EVIDENCE_STEP) * says / n_same
            last, n_all, n_top = -MOMENT_FRAMES, 0, 0
            for b in range(m):
                n_top = max(n_top, n_at[b])
                if when[b] - last >= MOMENT_FRAMES:
                    last = when[b]
                    n_all += 1
            restless[i, j] = n_all >= RESTLESS_MOMENTS and n_top < RESTLESS_SHARE * n_all
            for s in range(N_STATES):
                best = 0
                for a in range(1, m + 1):
                    if worth[a] > worth[best]:
                        best = a
                if worth[best] <= NEVER:
                    break
                value[i, j, s] = worth[best]
                moments[i, j, s] = min(n_at[best], 255)
                for c in range(3):
                    colour[i, j, s, c] = own[c, best]
                _measure(own, best, m + 1, apart)
                for a in range(m + 1):
                    if apart[a] <= 4 * SAME_GREY:
                        worth[a] = NEVER
                        if a < m:
                            shows[present[a], i, j] = s


@numba.njit(cache=True, nogil=True)
def _measure(own, a, count, apart):  # type: ignore[no-untyped-def]
    """Four times the mean difference of colour a to each of the first `count` of own (3, n), green twice, to apart."""
    red, green, blue = own[0, a], own[1, a], own[2, a]
    for b in range(count):
        apart[b] = abs(own[0, b] - red) + 2 * abs(own[1, b] - green) + abs(own[2, b] - blue)


@numba.njit(cache=True, nogil=True)
def _together(shows, down, right, together):  # type: ignore[no-untyped-def]
    """Which states (n, h', w') views show together at pixels so far apart, as bits (h, w); see States."""
    n, height, width = shows.shape
    for i in range(min(together.shape[0], height - down)):
        for j in range(min(together.shape[1], width - right)):
            bits = 0
            for k in range(n):
                s, t = shows[k, i, j], shows[k, i + down, j + right]
                if s >= 0 and t >= 0:
                    bits |= 1 << (s * N_STATES + t)
            together[i, j] = bits


def settle(states: States, contested: NDArray[np.bool_]) -> Picture:
    """The state (h, w) of each contested pixel that makes the picture likeliest: its own value, less UNSEEN for each
    pixel APART beside whose state no frame shows it."""
    node = np.full(contested.shape, -1, np.int32)
    node[contested] = np.arange(np.count_nonzero(contested), dtype=np.int32)
    apart, cost = np.array(APART, np.int64), np.array(UNSEEN, np.float32)
    return np.asarray(_settle(states.value, states.together, node, apart, cost, SWEEPS))


@numba.njit(cache=True, nogil=True)
def _settle(value, together, node, apart, cost, sweeps):  # type: ignore[no-untyped-def]
    """Messages pass to and fro in the order of the pixels, from what is known at once (sequential updates)."""
    height, width, n = value.shape
    edges = len(apart)
    # To each contested pixel, from the one before it along each edge, and from the one behind it: what is against a
    # state, from 0 to the edge's cost in 255 steps (a quarter of the memory of floats).
    message = np.zeros((node.max() + 1, 2 * edges, n), np.uint8)
    belief = np.empty(n, np.float32)
    for _ in range(sweeps):
        for i in range(height):
            for j in range(width):
                _believe(value[i, j], message, node[i, j], cost, belief)
                for e in range(edges):
                    y, x = i + apart[e, 0], j + apart[e, 1]
                    if y < height and x < width and node[y, x] >= 0:
                        to = message[node[y, x], e]
                        _send(belief, message, node[i, j], edges + e, together[i, j, e], n, 1, cost[e], to)
        for i in range(height - 1, -1, -1):
            for j in range(width - 1, -1, -1):
                _believe(value[i, j], message, node[i, j], cost, belief)
                for e in range(edges):
                    y, x = i - apart[e, 0], j - apart[e, 1]
                    if y >= 0 and x >= 0 and node[y, x] >= 0:
                        to = message[node[y, x], edges + e]
                        _send(belief, message, node[i, j], e, together[y, x, e], 1, n, cost[e], to)
    chosen = np.zeros((height, width), np.uint8)
    for i in range(height):
        for j in range(width):
            if node[i, j] >= 0:
                _believe(value[i, j], message, node[i, j], cost, belief)
                chosen[i, j] = np.argmax(belief)
    return chosen


@numba.njit(cache=True, nogil=True, inline="always")
def _believe(value, message, node, cost, belief):  # type: ignore[no-untyped-def]
    """What a pixel makes of its states (n,), from its own value and the messages to it, into belief. One that is not
    contested (node -1) hears nobody."""
    for s in range(len(belief)):
        belief[s] = value[s]
        if node >= 0:
            for d in range(message.shape[1]):
                belief[s] -= cost[d % len(cost)] / np.float32(255) * message[node, d, s]


@numba.njit(cache=True, nogil=True, inline="always")
def _send(belief, message, node, back, together, own, other, cost, out):  # type: ignore[no-untyped-def]
    """The message of a pixel (node) to another one, into out (n,), but for what that one said (back). together: States'
    bits of the two; own, other: how far apart bits of this pixel's and of the other's states are."""
    n = len(belief)
    step = cost / np.float32(255)
    top = np.float32(-1e9)
    for s in range(n):
        top = max(top, belief[s] + (step * message[node, back, s] if node >= 0 else np.float32(0)))
    for t in range(n):
        best = top - cost
        for s in range(n):
            if (together >> (s * own + t * other)) & 1:
                best = max(best, belief[s] + (step * message[node, back, s] if node >= 0 else np.float32(0)))
        out[t] = np.uint8((top - best) / step + np.float32(0.5))
