"""Where a pixel of a frame looks, and where a direction is seen: frame pixel, ray, pan and tilt, for whole arrays.

Everything is in the world of the frame's own shot (README, conventions): x right, y down, z forward; pan positive to
the right, tilt up. Lens distortion is undone and applied. `geometry` adds what camera.csv does not say (rows read at
different times, a pupil before the pan axis): with it rays and panorama agree; without it a pixel's ray is that of the
frame's one camera, at its middle row. A frame without a camera gives NaN, never a guess.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.distortion import undistorted_radius
from calib.rotation import from_pan_tilt_roll, turned
from pipelines.frame_geometry import MOST_ROUNDS, SETTLED_PX, FrameGeometry
from pipelines.records import CameraTable

FloatArray = NDArray[np.float64]


def pixel_to_ray(
    table: CameraTable, frame: ArrayLike, xy_px: ArrayLike, geometry: FrameGeometry | None = None
) -> FloatArray:
    """Unit rays (..., 3) in the shot world of pixels (..., 2), each in its frame (...).

    frame broadcasts against the leading axes of xy_px. NaN where the frame has no camera or the lens model no such
    point. Raises ValueError: a frame that is not in the table, shapes that do not broadcast or do not end in 2.
    """
    row, points = _broadcast(table, frame, xy_px, 2, "pixels")
    f, k1, aspect = table.f_px[row], table.k1[row], table.aspect[row]
    vector: FloatArray | None = None
    if geometry is not None and geometry.rolling:
        factor, vector = geometry.turn(row, geometry.late(row, points[..., 1]))
        f, k1 = f * factor, k1 * factor**2
    x = (points[..., 0] - table.cx_px[row]) / f
    y = (points[..., 1] - table.cy_px[row]) * aspect / f
    radius = np.hypot(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        # One radius at the axis stands for "no stretch": there both radii are 0.
        stretch = np.where(radius > 0, undistorted_radius(radius, k1) / radius, 1.0)
    camera = np.stack([x * stretch, y * stretch, np.ones_like(x)], axis=-1)
    if vector is not None:
        camera = turned(camera, -vector)
    R = _rotations(table, row)
    world = np.einsum("...ji,...j->...i", R, camera)
    if geometry is not None:
        world = _from_axis(geometry, table, row, world, _axes(R, vector))
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def ray_to_pixel(
    table: CameraTable, frame: ArrayLike, rays: ArrayLike, geometry: FrameGeometry | None = None
) -> FloatArray:
    """Pixels (..., 2) of directions (..., 3) in the shot world, inside the picture or not. Inverse of `pixel_to_ray`.

    NaN where the frame has no camera, behind it, and where the lens model folds over. Raises ValueError as there.
    """
    row, directions = _broadcast(table, frame, rays, 3, "rays")
    R = _rotations(table, row)
    if geometry is None or not (geometry.rolling or geometry.parallax):
        return _projected(table, row, R, directions)
    xy = _seen(geometry, table, row, R, directions, None)
    if (
        geometry.rolling
    ):  # which row sees it depends on where it is seen: a fixed point, found in a few rounds
        for _ in range(MOST_ROUNDS):
            before, xy = xy, _seen(geometry, table, row, R, directions, geometry.late(row, xy[..., 1]))
            if not np.nanmax(np.abs(xy - before), initial=0.0) > SETTLED_PX:
                break
    return xy


def pixel_to_pan_tilt(
    table: CameraTable, frame: ArrayLike, xy_px: ArrayLike, geometry: FrameGeometry | None = None
) -> FloatArray:
    """(..., 2) pan and tilt in degrees of the rays of pixels (..., 2); pan in -180..180. NaN, errors: as there."""
    return ray_to_pan_tilt(pixel_to_ray(table, frame, xy_px, geometry))


def pan_tilt_to_pixel(
    table: CameraTable, frame: ArrayLike, pan_tilt_deg: ArrayLike, geometry: FrameGeometry | None = None
) -> FloatArray:
    """Pixels (..., 2) of directions given by pan and tilt (..., 2) in degrees. NaN, errors: `ray_to_pixel`."""
    return ray_to_pixel(table, frame, pan_tilt_to_ray(pan_tilt_deg), geometry)


def ray_to_pan_tilt(rays: ArrayLike) -> FloatArray:
    """(..., 2) pan and tilt in degrees of directions (..., 3), any length: those of a camera that looks along them."""
    ray = np.asarray(rays, np.float64)
    x, y, z = ray[..., 0], ray[..., 1], ray[..., 2]
    return np.degrees(np.stack([np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))], axis=-1))


def pan_tilt_to_ray(pan_tilt_deg: ArrayLike) -> FloatArray:
    """Unit directions (..., 3) of pan and tilt (..., 2) in degrees. Inverse of `ray_to_pan_tilt`."""
    pan, tilt = np.moveaxis(np.radians(np.asarray(pan_tilt_deg, np.float64)), -1, 0)
    return np.stack([np.cos(tilt) * np.sin(pan), -np.sin(tilt), np.cos(tilt) * np.cos(pan)], axis=-1)


def axis_angle_std_deg(table: CameraTable, frame: ArrayLike, xy_px: ArrayLike) -> FloatArray:
    """One-sigma error (...,) in degrees of the angle between a pixel's ray and the optical axis, by f_std_px alone.

    An angle a has tan a = r / f, so its error is sin a cos a of the relative error of f: 0 on the axis. What the
    camera's own pan and tilt are wrong by comes on top, and is common to all pixels of the frame.
    """
    row, points = _broadcast(table, frame, xy_px, 2, "pixels")
    rays = pixel_to_ray(table, frame, points)
    forward = _rotations(table, row)[..., 2, :]
    cosine = np.sum(rays * forward, axis=-1)
    sine = np.linalg.norm(np.cross(rays, forward), axis=-1)
    return np.degrees(sine * cosine * table.f_std_px[row] / table.f_px[row])


def rows_of(table: CameraTable, frame: ArrayLike) -> NDArray[np.int64]:
    """Rows (...) of frame numbers (...). Raises ValueError: not whole numbers, or a frame that is not in the table."""
    wanted = np.asarray(frame)
    if not np.issubdtype(wanted.dtype, np.integer):
        raise ValueError(f"frames are whole numbers, got {wanted.dtype}")
    order = np.argsort(table.frame, kind="stable")
    place = np.searchsorted(table.frame, wanted, sorter=order)
    row = order[np.minimum(place, len(order) - 1)] if len(order) else np.full(wanted.shape, -1)
    missing = (row < 0) | (table.frame[row] != wanted) if len(order) else np.ones(wanted.shape, bool)
    if np.any(missing):
        raise ValueError(f"frame {np.atleast_1d(wanted)[np.atleast_1d(missing)][0]} is not in the table")
    return np.asarray(row, np.int64)


def _broadcast(
    table: CameraTable, frame: ArrayLike, values: ArrayLike, size: int, noun: str
) -> tuple[NDArray[np.int64], FloatArray]:
    points = np.asarray(values, np.float64)
    if points.shape[-1:] != (size,):
        raise ValueError(f"{noun} have shape {points.shape}, need (..., {size})")
    row = rows_of(table, frame)
    try:
        shape = np.broadcast_shapes(row.shape, points.shape[:-1])
    except ValueError:
        raise ValueError(f"frames {row.shape} do not broadcast against {noun} {points.shape[:-1]}") from None
    return np.broadcast_to(row, shape), np.broadcast_to(points, (*shape, size))


def _rotations(table: CameraTable, row: NDArray[np.int64]) -> FloatArray:
    """R_cam_world (..., 3, 3) of rows; computed once per frame, however many points it has."""
    used, back = np.unique(row, return_inverse=True)
    angles = [np.radians(a[used]) for a in (table.pan_deg, table.tilt_deg, table.roll_deg)]
    return from_pan_tilt_roll(*angles)[back.reshape(row.shape)]


def _projected(
    table: CameraTable, row: NDArray[np.int64], R: FloatArray, directions: FloatArray
) -> FloatArray:
    camera = np.einsum("...ij,...j->...i", R, directions)
    return _through_lens(table, row, camera, table.f_px[row], table.k1[row])


def _seen(
    geometry: FrameGeometry,
    table: CameraTable,
    row: NDArray[np.int64],
    R: FloatArray,
    directions: FloatArray,
    late: FloatArray | None,
) -> FloatArray:
    """Pixels of directions as rows that are `late` (...) see them; None: as the middle row does."""
    f, k1 = table.f_px[row], table.k1[row]
    vector: FloatArray | None = None
    if late is not None:
        factor, vector = geometry.turn(row, late)
        f, k1 = f * factor, k1 * factor**2
    if geometry.parallax:
        axis, seen = _axes(R, vector), np.array(directions)
        for shot, parallax in geometry.parallax.items():
            of_shot = table.shot[row] == shot
            seen[of_shot] = parallax.from_pupil(directions[of_shot], axis[of_shot])
        directions = seen
    camera = np.einsum("...ij,...j->...i", R, directions)
    return _through_lens(table, row, camera if vector is None else turned(camera, vector), f, k1)


def _from_axis(
    geometry: FrameGeometry,
    table: CameraTable,
    row: NDArray[np.int64],
    directions: FloatArray,
    axis: FloatArray,
) -> FloatArray:
    """Directions from the pan axis to what pupils see along `directions`."""
    found = np.array(directions)
    for shot, parallax in geometry.parallax.items():
        of_shot = table.shot[row] == shot
        found[of_shot] = parallax.from_axis(directions[of_shot], axis[of_shot])
    return found


def _axes(R: FloatArray, vector: FloatArray | None) -> FloatArray:
    """Optical axes (..., 3) in world axes of cameras R (..., 3, 3), turned on by left rotation vectors (..., 3)."""
    if vector is None:
        return R[..., 2, :]
    return np.asarray(np.einsum("...ji,...j->...i", R, turned(np.array([0.0, 0.0, 1.0]), -vector)))


def _through_lens(
    table: CameraTable, row: NDArray[np.int64], camera: FloatArray, f: FloatArray, k1: FloatArray
) -> FloatArray:
    """Pixels (..., 2) of points (..., 3) in camera axes; NaN behind it and where the lens model folds over."""
    with np.errstate(invalid="ignore", divide="ignore"):
        front = np.where(camera[..., 2] > 0, camera[..., 2], np.nan)
        x, y = camera[..., 0] / front, camera[..., 1] / front
        r2 = x * x + y * y
        bend = np.where(1 + 3 * k1 * r2 > 0, 1 + k1 * r2, np.nan)
    return np.stack(
        [table.cx_px[row] + f * x * bend, table.cy_px[row] + f / table.aspect[row] * y * bend], axis=-1
    )
