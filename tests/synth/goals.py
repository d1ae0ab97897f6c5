"""Goals (or backboards), drawn into the painted environment: frame, and a net one sees through.

Geometry is that of the pitch; seen from the pan axis, so under a displaced pupil they move with what is behind them.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from tests.synth.stadium import Stadium

_SHIFT = 6  # fractional bits of cv2's line ends
ToTexel = Callable[[np.ndarray], np.ndarray]


def _lines(
    image: np.ndarray, ends_m: np.ndarray, to_texel: ToTexel, colour: tuple[int, int, int], px: int
) -> None:
    """Straight 3-D segments (n, 2, 3) m as polylines of eight pieces: straight in space is curved on a cylinder."""
    t = np.linspace(0, 1, 9)[:, None]
    for a, b in ends_m:
        at = to_texel(a + t * (b - a))
        if np.isfinite(at).all() and (at > -500).all() and (at < np.array(image.shape[1::-1]) + 500).all():
            cv2.polylines(
                image, [np.round(at * 2**_SHIFT).astype(np.int32)], False, colour, px, cv2.LINE_AA, _SHIFT
            )


def _moved(to_texel: ToTexel, x0: int, y0: int) -> ToTexel:
    """The same address in a part of the picture that begins at (x0, y0)."""
    return lambda points: to_texel(points) - np.array([x0, y0])


def _goal(side: int, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Frame (n, 2, 3) and net (m, 2, 3) of one goal: x along the pitch, y away from the camera, z up."""
    x, back, w, h = half_length, half_length + 2.0, 3.66, 2.44
    posts = [((x, -w, 0), (x, -w, h)), ((x, w, 0), (x, w, h)), ((x, -w, h), (x, w, h))]
    net = []
    for y in np.arange(-w, w + 0.01, 0.305):
        net += [((back, y, 0), (back - 0.4, y, h)), ((back - 0.4, y, h), (x, y, h))]
    for z in np.arange(0.0, h + 0.01, 0.305):
        at = back - 0.4 * z / h
        net += [((at, -w, z), (at, w, z)), ((x, -w, z), (at, -w, z)), ((x, w, z), (at, w, z))]
    for share in np.arange(0, 1, 0.15):
        at = x + share * (back - x)
        net += [((at, -w, 0), (at, -w, h)), ((at, w, 0), (at, w, h))]
    sign = np.array([side, 1, 1])
    return np.array(posts) * sign, np.array(net) * sign


def draw_goals(image: np.ndarray, stadium: Stadium, to_texel: ToTexel, px_per_rad: float) -> None:
    """Into image (h, w, 3) uint8, level 0. to_texel maps world directions (n, 3) to texel coordinates (n, 2)."""

    def world(points: np.ndarray) -> np.ndarray:
        """Pitch metres -> world axes from the pan axis."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([x, stadium.camera_height - z, y + stadium.camera_back], axis=-1)

    for side in (-1, 1):
        distance = float(np.hypot(stadium.half_length, stadium.camera_back))
        px = max(1, round(0.12 * px_per_rad / distance))
        if stadium.arena:
            x, z0, z1 = side * (stadium.half_length - 1.2), 2.9, 3.95
            board = np.array([(x, -0.9, z0), (x, 0.9, z0), (x, 0.9, z1), (x, -0.9, z1)])
            stand = np.array(
                [[(x + side * 2.2, 0, 0), (x + side * 2.2, 0, 3.2)], [(x + side * 2.2, 0, 3.2), (x, 0, 3.2)]]
            )
            _lines(image, world(stand), to_texel, (40, 44, 60), 2 * px)
            corners = np.round(to_texel(world(board)) * 2**_SHIFT).astype(np.int32)
            cv2.fillPoly(image, [corners], (226, 230, 234), cv2.LINE_AA, _SHIFT)
            _lines(image, world(np.stack([board, np.roll(board, -1, 0)], 1)), to_texel, (200, 60, 40), px)
            continue
        posts, net = _goal(side, stadium.half_length)
        at = to_texel(world(net)).reshape(-1, 2)
        x0, y0 = np.maximum(np.floor(at.min(0)).astype(int) - 2, 0)
        x1, y1 = np.minimum(np.ceil(at.max(0)).astype(int) + 3, image.shape[1::-1])
        if x0 >= x1 or y0 >= y1:
            continue
        part = image[y0:y1, x0:x1]
        netted = part.copy()
        _lines(netted, world(net), _moved(to_texel, x0, y0), (225, 228, 230), 1)
        part[:] = cv2.addWeighted(part, 0.55, netted, 0.45, 0)
        _lines(image, world(posts), to_texel, (244, 245, 245), px)
