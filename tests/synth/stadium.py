"""The geometry of the procedural ground: where a ray from the pan axis meets pitch, hoardings, stands and roof.

One closed surface, star-shaped about the pan axis: the pitch plane, then a profile (hoarding, wall, lower tier, facade,
upper tier, back wall, roof) extruded along a convex polygon around the pitch. Metres. Colours are painted in paint.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

# what a ray hits; the segments of the profile follow in this order from the pitch upwards
GROUND, BOARD, FRONT_WALL, LOWER_TIER, FACADE, UPPER_TIER, BACK_WALL, ROOF, SKY = range(9)


class Stadium(NamedTuple):
    """Numbers of one venue, all in metres. The pan axis stands at (0, -camera_back) from the centre spot."""

    camera_back: float
    camera_height: float
    half_length: float
    half_width: float
    faces: np.ndarray  # (5, 3): nx, ny, c with n . p = c on the hoarding line, p from the pan axis
    tangents: np.ndarray  # (5, 4): start x, start y, direction x, direction y of the perimeter coordinate
    s_start: np.ndarray  # (5,) perimeter coordinate at the start point
    profile: np.ndarray  # (7, 4): q0, z0, q1, z1 of BOARD .. ROOF; q outward from the hoarding line, z up
    arena: bool


def make_stadium(*, arena: bool = False, board_height_m: float = 1.6) -> Stadium:
    """A football ground, or a basketball-like arena on the same plan."""
    if arena:
        back, height, half_l, half_w, margin_y, margin_x, cut = 24.0, 8.0, 14.0, 7.5, 2.5, 4.0, 5.0
        tiers = [
            (1.5, 0.0, 1.5, 1.3),
            (1.5, 1.3, 14, 7.5),
            (14, 7.5, 14, 10),
            (14, 10, 28, 21),
            (28, 21, 28, 23),
        ]
        roof = (28, 23, -8, 26)
    else:
        back, height, half_l, half_w, margin_y, margin_x, cut = 70.0, 15.0, 52.5, 34.0, 4.0, 5.5, 12.0
        tiers = [(4, 0.0, 4, 2.6), (4, 2.6, 22, 12), (22, 12, 22, 16), (22, 16, 44, 33), (44, 33, 44, 37)]
        roof = (44, 37, 10, 41)
    x1, y1 = half_l + margin_x, half_w + margin_y + back
    r = np.sqrt(0.5)
    faces = np.array(
        [[0, 1, y1], [r, r, r * (x1 - cut + y1)], [1, 0, x1], [-r, r, r * (x1 - cut + y1)], [-1, 0, x1]],
        dtype=np.float64,
    )
    tangents = np.array(
        [
            [0, y1, 1, 0],
            [x1 - cut, y1, r, -r],
            [x1, y1 - cut, 0, -1],
            [-(x1 - cut), y1, r, r],
            [-x1, y1 - cut, 0, 1],
        ],
        dtype=np.float64,
    )
    s_corner = x1 - cut
    s_side = s_corner + cut / r
    s_start = np.array([0, s_corner, s_side, -s_corner, -s_side], dtype=np.float64)
    profile = np.array([(0, 0, 0, board_height_m), *tiers, roof], dtype=np.float64)
    return Stadium(back, height, half_l, half_w, faces, tangents, s_start, profile, arena)


def seen_from(stadium: Stadium, closer_m: float, up_m: float) -> Stadium:
    """The same ground from a pan axis that stands closer to the pitch and higher: another camera position."""
    faces, tangents = stadium.faces.copy(), stadium.tangents.copy()
    faces[:, 2] -= closer_m * faces[:, 1]
    tangents[:, 1] -= closer_m
    return stadium._replace(
        camera_back=stadium.camera_back - closer_m, camera_height=stadium.camera_height + up_m,
        faces=faces, tangents=tangents,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _nearest_face(stadium, dx, dy, tan_up, segment):
    """Smallest positive horizontal distance at which the ray crosses the segment's (extended) surface, and its face."""
    profile, faces = stadium.profile, stadium.faces
    q0, z0 = profile[segment - 1, 0], profile[segment - 1, 1]
    q1, z1 = profile[segment - 1, 2], profile[segment - 1, 3]
    best, best_face = np.inf, -1
    for face in range(faces.shape[0]):
        nd = faces[face, 0] * dx + faces[face, 1] * dy
        c = faces[face, 2]
        if q0 == q1:
            rho = (c + q0) / nd if nd > 1e-9 else np.inf
        else:
            m = (z1 - z0) / (q1 - q0)
            denominator = tan_up - m * nd
            if abs(denominator) < 1e-12:
                continue
            rho = (z0 - stadium.camera_height - m * (c + q0)) / denominator
        if 0 < rho < best:
            best, best_face = rho, face
    return best, best_face


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def intersect(stadium, dx, dy, tan_up):
    """Ray with horizontal unit direction (dx right, dy forward) and slope tan_up -> (segment, face, rho_m).

    rho_m: horizontal distance of the first surface; inf for SKY.
    """
    rho_board, face = _nearest_face(stadium, dx, dy, tan_up, BOARD)
    if tan_up < 0:
        rho = -stadium.camera_height / tan_up
        if rho < rho_board:
            return GROUND, 0, rho
    for segment in range(BOARD, SKY):
        rho, face = _nearest_face(stadium, dx, dy, tan_up, segment)
        if face < 0:
            continue
        if segment == ROOF:
            q = stadium.faces[face, 0] * rho * dx + stadium.faces[face, 1] * rho * dy - stadium.faces[face, 2]
            if q >= stadium.profile[segment - 1, 2]:
                return segment, face, rho
        elif stadium.camera_height + rho * tan_up <= stadium.profile[segment - 1, 3]:
            return segment, face, rho
    return SKY, 0, np.inf


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def perimeter_coordinate(stadium, face, x, y):
    """Metres along the hoarding line of the point (x, y) from the pan axis, 0 opposite the camera, right positive."""
    t = stadium.tangents
    return stadium.s_start[face] + (x - t[face, 0]) * t[face, 2] + (y - t[face, 1]) * t[face, 3]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def depth_along(stadium, x, y, z):
    """Distance in metres from the pan axis to the surface along the world direction (x right, y down, z forward)."""
    horizontal = np.sqrt(x * x + z * z)
    tan_up = -y / horizontal
    _, _, rho = intersect(stadium, x / horizontal, z / horizontal, tan_up)
    if rho > 2000.0:
        rho = 2000.0  # the sky: far enough that a pupil of a metre does not matter
    return rho * np.sqrt(1 + tan_up * tan_up)


@njit(cache=True, nogil=True)
def depths_along(stadium, rays):
    """depth_along for directions (n, 3) -> (n,) m."""
    out = np.empty(rays.shape[0])
    for i in range(rays.shape[0]):
        out[i] = depth_along(stadium, rays[i, 0], rays[i, 1], rays[i, 2])
    return out


def profile_edges(stadium: Stadium, lon_rad: np.ndarray) -> np.ndarray:
    """Where the profile's corners are seen: (8, n) tan of elevation of the foot of BOARD and the top of each segment.

    A corner is a line at offset q and height z along the polygon; lon_rad (n,) are directions from the pan axis.
    """
    corners = np.vstack([stadium.profile[:1, :2], stadium.profile[:, 2:]])
    along = stadium.faces[:, :2] @ np.stack([np.sin(lon_rad), np.cos(lon_rad)])
    along = np.where(along > 1e-9, along, np.nan)
    rho = np.nanmin((stadium.faces[:, 2, None] + corners[:, 0, None, None]) / along, axis=1)
    return (corners[:, 1, None] - stadium.camera_height) / rho
