"""Simulated tracks of a rotating, zooming camera: graphs without pictures, with the truth. Noise is drawn apart.

Points run on an 8 x 5 grid, with independent noise and a smooth error field per edge (a random mix of 1, x, y, x^2,
xy, y^2, x^3, xy^2 per component), as calibration.md 7.3 draws it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import dlt, rotation
from calib.camera import infinite_homography
from calib.records import HomographyEdge, HomographyGraph, Lens

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Cameras that made a graph: frames (n,), log_f (n,), R (n, 3, 3), lens."""

    frames: NDArray[np.int64]
    log_f: Array
    R: Array
    lens: Lens


def path(
    rng: np.random.Generator, n: int, *, pan_deg: float, tilt_deg: float = 2.0, zoom: float = 1.0, f_w: float = 1.3,
    roll_deg: float = 0.2, c0: float = 0.04, c1: float = -0.015, pp_offset_px: tuple[float, float] = (6.0, -12.0),
    size_px: tuple[int, int] = (1280, 720), tilt0_deg: float = -8.0,
) -> Truth:  # fmt: skip
    """A pan with tilt and zoom along it; f from f_w W to f_w zoom W. n frames."""
    t = np.linspace(0, 1, n)
    pan = np.deg2rad(pan_deg) * t
    tilt = np.deg2rad(tilt0_deg + tilt_deg * np.sin(2 * np.pi * t * rng.uniform(0.5, 1.2)))
    roll = np.deg2rad(roll_deg * rng.standard_normal(n))
    log_f = np.log(f_w * size_px[0]) + np.log(zoom) * 0.5 * (1 - np.cos(np.pi * t))
    R = rotation.from_pan_tilt_roll(pan, tilt, roll)
    centre = (np.array(size_px) - 1) / 2
    lens = Lens(size_px=size_px, pp_px=centre + pp_offset_px, c0=c0, c1=c1)
    return Truth(frames=np.arange(n) * 10, log_f=log_f, R=R @ R[0].T, lens=lens)


def project(truth: Truth, a: int, b: int, points: Array) -> Array:
    """Raw points (m, 2) of row a seen in row b."""
    ideal = truth.lens.undistort(points, truth.log_f[a])
    rays = (
        np.concatenate([ideal, np.ones((len(ideal), 1))], 1) @ np.linalg.inv(truth.lens.K(truth.log_f[a])).T
    )
    w = rays @ (truth.R[b] @ truth.R[a].T).T @ truth.lens.K(truth.log_f[b]).T
    out = truth.lens.distort(w[:, :2] / w[:, 2:], truth.log_f[b])
    return np.where(w[:, 2:] > 0, out, np.nan)


def parallax(truth: Truth, a: int, b: int, points: Array, pupil_m: float, tilt0_deg: float = -8.0) -> Array:
    """Displacement (m, 2) px in row b of points of row a by a pupil in front of the pan axis.

    The scene: a pitch 15 m below the axis, a stand 95 m away all around. truth made by `path` with this tilt0_deg.
    """
    lens, level = truth.lens, rotation.from_pan_tilt_roll(0.0, np.deg2rad(tilt0_deg), 0.0)
    R_a, R_b = truth.R[a] @ level, truth.R[b] @ level
    ideal = lens.undistort(points, truth.log_f[a])
    rays = (
        np.concatenate([ideal, np.ones((len(ideal), 1))], 1) @ np.linalg.inv(lens.K(truth.log_f[a])).T @ R_a
    )
    down = np.where(rays[:, 1] > 1e-6, rays[:, 1], 1e-6)
    scene = rays * np.minimum(15 / down, 95 / np.hypot(rays[:, 0], rays[:, 2]))[:, None]

    def seen(pupil: float) -> Array:
        # The ray of a starts at a's pupil; the scene is far away, so its point is taken from the axis.
        w = (scene + pupil * (R_a[2] - R_b[2])) @ R_b.T @ lens.K(truth.log_f[b]).T
        return lens.distort(w[:, :2] / w[:, 2:], truth.log_f[b])

    return seen(pupil_m) - seen(0.0)


def grid(size_px: tuple[int, int]) -> Array:
    """Centres (40, 2) of the 8 x 5 cells, row by row."""
    x, y = np.meshgrid((np.arange(8) + 0.5) / 8, (np.arange(5) + 0.5) / 5)
    return np.stack([x.ravel() * size_px[0], y.ravel() * size_px[1]], 1) - 0.5


def smooth_field(rng: np.random.Generator, points: Array, size_px: tuple[int, int], rms_px: float) -> Array:
    """A smooth error (m, 2) of the given rms per component."""
    x, y = (points / np.array(size_px) * 2 - 1).T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * y * y], 1)
    field = basis @ rng.standard_normal((8, 2))
    return field * rms_px / np.sqrt(np.mean(field**2, 0))


def edge(
    rng: np.random.Generator, truth: Truth, a: int, b: int, *, noise_px: float = 0.1, smooth_px: float = 0.0,
    rows: tuple[int, ...] = (0, 1, 2, 3, 4), shift_px: float = 0.0, min_points: int = 10,
) -> HomographyEdge | None:  # fmt: skip
    """The edge a -> b (rows of truth), or None when fewer than min_points cells overlap. shift_px: a wrong edge."""
    size = truth.lens.size_px
    points = grid(size)[np.isin(np.arange(40) // 8, rows)]
    seen = project(truth, a, b, points)
    inside = ((seen >= 0) & (seen <= np.array(size) - 1)).all(1)
    if inside.sum() < min_points:
        return None
    points, seen = points[inside], seen[inside]
    seen = seen + noise_px * rng.standard_normal(seen.shape)
    if smooth_px:
        seen = seen + smooth_field(rng, points, size, smooth_px)
    if shift_px:
        seen = seen + shift_px * np.array([1.0, -0.7]) + smooth_field(rng, points, size, shift_px / 3)
    K_a, K_b = truth.lens.K(truth.log_f[a]), truth.lens.K(truth.log_f[b])
    H = infinite_homography(K_b, K_a, truth.R[b] @ truth.R[a].T)
    if shift_px:
        H = dlt.dlt(points, seen)
    info = np.broadcast_to(np.eye(2) / 0.1**2, (len(points), 2, 2))
    return HomographyEdge(
        a=int(truth.frames[a]), b=int(truth.frames[b]), H=H, grid_a=points, grid_b=seen, info=info
    )


def graph(
    rng: np.random.Generator, truth: Truth, *, max_span: int = 6, min_overlap: float = 0.4, noise_px: float = 0.1,
    smooth_px: float = 0.1, outliers: float = 0.0, rows: tuple[int, ...] = (0, 1, 2, 3, 4),
) -> HomographyGraph:  # fmt: skip
    """All pairs up to max_span apart whose overlap is at least min_overlap; a share of the longer ones is wrong."""
    edges = []
    n = len(truth.frames)
    need = max(10, int(min_overlap * 8 * len(rows)))
    for a in range(n):
        for b in range(a + 1, min(n, a + max_span + 1)):
            wrong = outliers > 0 and b > a + 1 and rng.uniform() < outliers
            e = edge(
                rng, truth, a, b, noise_px=noise_px, smooth_px=smooth_px, rows=rows,
                shift_px=25.0 if wrong else 0.0, min_points=need if b > a + 1 else 10,
            )  # fmt: skip
            if e is not None:
                edges.append(e)
    return HomographyGraph(frames=truth.frames, edges=tuple(edges), size_px=truth.lens.size_px)
