"""Where a pixel of a frame looks, and where a direction is seen: frame pixel, ray, pan and tilt, for whole arrays.

Everything is in the world of the frame's own shot (README, conventions): x right, y down, z forward; pan positive to
the right, tilt up. Lens distortion is undone and applied. A frame without a camera gives NaN, never a guess.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.distortion import undistorted_radius
from calib.rotation import from_pan_tilt_roll
from pipelines.records import CameraTable

FloatArray = NDArray[np.float64]


def pixel_to_ray(table: CameraTable, frame: ArrayLike, xy_px: ArrayLike) -> FloatArray:
    """Unit rays (..., 3) in the shot world of pixels (..., 2), each in its frame (...).

    frame broadcasts against the leading axes of xy_px. NaN where the frame has no camera or the lens model no such
    point. Raises ValueError: a frame that is not in the table, shapes that do not broadcast or do not end in 2.
    """
    row, points = _broadcast(table, frame, xy_px, 2, "pixels")
    f, aspect = table.f_px[row], table.aspect[row]
    x = (points[..., 0] - table.cx_px[row]) / f
    y = (points[..., 1] - table.cy_px[row]) * aspect / f
    radius = np.hypot(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        # One radius at the axis stands for "no stretch": there both radii are 0.
        stretch = np.where(radius > 0, undistorted_radius(radius, table.k1[row]) / radius, 1.0)
    camera = np.stack([x * stretch, y * stretch, np.ones_like(x)], axis=-1)
    world = np.einsum("...ji,...j->...i", _rotations(table, row), camera)
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def ray_to_pixel(table: CameraTable, frame: ArrayLike, rays: ArrayLike) -> FloatArray:
    """Pixels (..., 2) of directions (..., 3) in the shot world, inside the picture or not. Inverse of `pixel_to_ray`.

    NaN where the frame has no camera, behind it, and where the lens model folds over. Raises ValueError as there.
    """
    row, directions = _broadcast(table, frame, rays, 3, "rays")
    camera = np.einsum("...ij,...j->...i", _rotations(table, row), directions)
    f, aspect, k1 = table.f_px[row], table.aspect[row], table.k1[row]
    with np.errstate(invalid="ignore", divide="ignore"):
        front = np.where(camera[..., 2] > 0, camera[..., 2], np.nan)
        x, y = camera[..., 0] / front, camera[..., 1] / front
        r2 = x * x + y * y
        bend = np.where(1 + 3 * k1 * r2 > 0, 1 + k1 * r2, np.nan)
    return np.stack([table.cx_px[row] + f * x * bend, table.cy_px[row] + f / aspect * y * bend], axis=-1)


def pixel_to_pan_tilt(table: CameraTable, frame: ArrayLike, xy_px: ArrayLike) -> FloatArray:
    """(..., 2) pan and tilt in degrees of the rays of pixels (..., 2); pan in -180..180. NaN, errors: as there."""
    return ray_to_pan_tilt(pixel_to_ray(table, frame, xy_px))


def pan_tilt_to_pixel(table: CameraTable, frame: ArrayLike, pan_tilt_deg: ArrayLike) -> FloatArray:
    """Pixels (..., 2) of directions given by pan and tilt (..., 2) in degrees. NaN, errors: `ray_to_pixel`."""
    return ray_to_pixel(table, frame, pan_tilt_to_ray(pan_tilt_deg))


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
