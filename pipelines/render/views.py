"""One view: a camera that turns about a point, real or invented, and the warp from one view to another.

A view maps directions of the shot world (x right, y down, z forward) to pixels: homography, then radial distortion.
The conventions are those of rays.py, which does the same for whole columns of camera.csv.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.distortion import undistorted_radius
from calib.parallax import Parallax
from calib.rotation import from_pan_tilt_roll, turned
from pipelines.frame_geometry import FARTHEST, MOST_ROUNDS, SETTLED_PX, FrameGeometry
from pipelines.records import CameraTable

FloatArray = NDArray[np.float64]
Picture = NDArray[np.uint8]

# Warps are computed at every 8th pixel and are linear between: the curvature of a view onto another is about 1 / f,
# so that the error is below 8^2 / (8 f), 0.01 px at f = 800. cv2.remap mixes in steps of 1/32: exact for eighths.
STEP = 8
OUTSIDE = -1e6  # px; what remap gets for "nowhere": NaN is undefined there


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """What a camera does while its rows are read: rate (4,), change of log f and left rotation vector a picture.

    A row at y px is read slope * y + offset pictures' time after the middle one, within +-limit.
    """

    rate: FloatArray
    slope: float
    offset: float
    limit: float

    def turn(self, y_px: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Factor of the focal length (...) and left rotation vector (..., 3) at y_px (...); none where y is NaN."""
        late = np.clip(np.nan_to_num(self.slope * np.asarray(y_px) + self.offset), -self.limit, self.limit)
        return np.exp(self.rate[0] * late), self.rate[1:] * late[..., None]

    def of_pixels(self, factor: float, shift_px: float) -> Motion:
        """For pixels whose y is factor * y + shift_px."""
        slope = self.slope / factor
        return replace(self, slope=slope, offset=self.offset - slope * shift_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A camera: size_px (w, h), M (3, 3) world direction to homogeneous ideal pixel, and the lens.

    The lens bends about pp_px (2,): an ideal offset d becomes d (1 + k1 |(dx / f_px, dy aspect / f_px)|^2). With k1 = 0
    and no motion, pp_px, f_px and aspect do not matter to the map; f_px is the scale in px per radian, NaN where nobody
    knows it. parallax: of a pupil that lies on the optical axis `axis` (3,), unit, in front of the point that the
    directions start from; None: the camera turns about its pupil. motion: M is the middle row's; None: all rows'.
    """

    size_px: tuple[int, int]
    M: FloatArray
    f_px: float
    aspect: float = 1.0
    pp_px: tuple[float, float] = (0.0, 0.0)
    k1: float = 0.0
    parallax: Parallax | None = None
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    motion: Motion | None = None

    def ray_to_pixel(self, rays: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of directions (..., 3), inside the picture or not; NaN behind it or where the lens folds."""
        directions = np.asarray(rays, np.float64)
        xy = self._seen_by_row(directions, None)
        if self.motion is not None:  # which row sees it depends on where it is seen: a fixed point
            for _ in range(MOST_ROUNDS):
                before, xy = xy, self._seen_by_row(directions, xy[..., 1])
                if not np.nanmax(np.abs(xy - before), initial=0.0) > SETTLED_PX:
                    break
        return xy

    def _seen_by_row(self, directions: FloatArray, y_px: FloatArray | None) -> FloatArray:
        """Pixels of directions as the rows at y_px (...) see them; None: as the middle row does."""
        factor: ArrayLike = 1.0
        vector: FloatArray | None = None
        if y_px is not None and self.motion is not None:
            factor, vector = self.motion.turn(y_px)
        if self.parallax is not None:
            directions = self.parallax.from_pupil(directions, self._axis(vector))
        q = directions @ self.M.T
        if vector is not None:
            K = self.K
            q = turned(q @ np.linalg.inv(K).T, vector) @ K.T
        with np.errstate(invalid="ignore", divide="ignore"):
            front = np.where(q[..., 2] > 0, q[..., 2], np.nan)
            ideal = q[..., :2] / front[..., None]
            if self.k1 == 0 and vector is None:
                return ideal
            # In the middle row's focal lengths: the lens bends the same pixels by the same share at any of them.
            d = np.asarray(ideal - self.pp_px) * np.asarray(factor)[..., None]
            r2 = (d[..., 0] / self.f_px) ** 2 + (d[..., 1] * self.aspect / self.f_px) ** 2
            bend = np.where(1 + 3 * self.k1 * r2 > 0, 1 + self.k1 * r2, np.nan)
        return np.asarray(self.pp_px + d * bend[..., None])

    def pixel_to_ray(self, xy_px: ArrayLike) -> FloatArray:
        """Directions (..., 3) of pixels (..., 2), not of unit length; NaN where the lens model has no such point."""
        xy = raw = np.asarray(xy_px, np.float64)
        if self.k1 != 0:
            d = xy - self.pp_px
            radius = np.hypot(d[..., 0] / self.f_px, d[..., 1] * self.aspect / self.f_px)
            with np.errstate(invalid="ignore", divide="ignore"):
                stretch = np.where(radius > 0, undistorted_radius(radius, self.k1) / radius, 1.0)
            xy = self.pp_px + d * stretch[..., None]
        vector: FloatArray | None = None
        if self.motion is not None:
            factor, vector = self.motion.turn(raw[..., 1])
            xy = self.pp_px + (xy - self.pp_px) / factor[..., None]
        homogeneous = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        if vector is not None:
            K = self.K
            homogeneous = turned(homogeneous @ np.linalg.inv(K).T, -vector) @ K.T
        directions = homogeneous @ np.linalg.inv(self.M).T
        return (
            directions if self.parallax is None else self.parallax.from_axis(directions, self._axis(vector))
        )

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera axes to ideal pixels, of the middle row."""
        return np.array(
            [[self.f_px, 0, self.pp_px[0]], [0, self.f_px / self.aspect, self.pp_px[1]], [0, 0, 1.0]]
        )

    def _axis(self, vector: FloatArray | None) -> FloatArray:
        """Optical axis (3,), or (..., 3) of a camera turned on by left rotation vectors (..., 3)."""
        if vector is None:
            return np.array(self.axis)
        R = np.linalg.inv(self.K) @ self.M
        return np.asarray(turned(np.array([0.0, 0.0, 1.0]), -vector) @ R)

    def still(self) -> View:
        """The view as if all rows were read with the middle one."""
        return replace(self, motion=None)

    def scaled(self, factor: float) -> View:
        """The same direction with a focal length `factor` times as long, about the picture's middle."""
        w, h = self.size_px
        x, y = (w - 1) / 2, (h - 1) / 2
        return self._changed(factor, ((1 - factor) * x, (1 - factor) * y), self.size_px)

    def cropped(self, rows: slice, columns: slice) -> View:
        """The view of a part of the picture, given by its rows and columns (start and stop)."""
        size = (columns.stop - columns.start, rows.stop - rows.start)
        return self._changed(1.0, (-float(columns.start), -float(rows.start)), size)

    def reduced(self, n: int) -> View:
        """The view of the picture with every n x n px made one; a rest at the right and at the bottom goes."""
        # The centre of a block of n lies (n - 1) / 2 px behind its first pixel's centre.
        shift = (1 / n - 1) / 2
        return self._changed(1 / n, (shift, shift), (self.size_px[0] // n, self.size_px[1] // n))

    def _changed(self, factor: float, shift: tuple[float, float], size_px: tuple[int, int]) -> View:
        """The view whose pixels are factor * pixel + shift."""
        S = np.array([[factor, 0, shift[0]], [0, factor, shift[1]], [0, 0, 1.0]])
        pp = (factor * self.pp_px[0] + shift[0], factor * self.pp_px[1] + shift[1])
        motion = None if self.motion is None else self.motion.of_pixels(factor, shift[1])
        return replace(self, size_px=size_px, M=S @ self.M, f_px=self.f_px * factor, pp_px=pp, motion=motion)


def camera_view(
    size_px: tuple[int, int],
    f_px: float,
    pan_tilt_roll_rad: ArrayLike,
    *,
    pp_px: tuple[float, float] | None = None,
    aspect: float = 1.0,
    k1: float = 0.0,
    parallax: Parallax | None = None,
    motion: Motion | None = None,
) -> View:
    """The view of a camera with focal length f_px = fx, aspect fx / fy; pp_px None: the picture's middle."""
    x, y = pp_px or ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    K = np.array([[f_px, 0, x], [0, f_px / aspect, y], [0, 0, 1.0]])
    R = from_pan_tilt_roll(*np.asarray(pan_tilt_roll_rad, np.float64))
    return View(
        size_px=size_px, M=K @ R, f_px=f_px, aspect=aspect, pp_px=(x, y), k1=k1, parallax=parallax,
        axis=(float(R[2, 0]), float(R[2, 1]), float(R[2, 2])), motion=motion,
    )  # fmt: skip


def frame_view(
    table: CameraTable, row: int, size_px: tuple[int, int], geometry: FrameGeometry | None = None
) -> View | None:
    """The view of a row of camera.csv; None where the row has no whole camera. geometry: of the run."""
    values = [
        float(column[row])
        for column in (
            table.f_px, table.pan_deg, table.tilt_deg, table.roll_deg, table.cx_px, table.cy_px, table.aspect, table.k1,
        )
    ]  # fmt: skip
    if not np.isfinite(values).all():
        return None
    f, pan, tilt, roll, x, y, aspect, k1 = values
    motion = None
    if geometry is not None and geometry.share[row] > 0 and np.any(geometry.rates[row]):
        share, h = float(geometry.share[row]), size_px[1]
        motion = Motion(
            rate=geometry.rates[row], slope=share / h, offset=share * (0.5 / h - 0.5), limit=share * FARTHEST
        )
    parallax = None if geometry is None else geometry.parallax.get(int(table.shot[row]))
    return camera_view(
        size_px, f, np.radians([pan, tilt, roll]), pp_px=(x, y), aspect=aspect, k1=k1, parallax=parallax,
        motion=motion,
    )  # fmt: skip


def homography_view(table: CameraTable, row: int, size_px: tuple[int, int]) -> View | None:
    """The view of a row that has a homography only: 'directions' are then undistorted pixels of the reference frame.

    None where the row has none. For shots whose focal length is not known: frames can be laid over each other all the
    same, but nothing has an angle. The lens, which is not known either, is taken as straight.
    """
    H = table.homography[row]
    if not np.isfinite(H).all():
        return None
    return View(size_px=size_px, M=np.linalg.inv(H), f_px=float("nan"))


def warp_map(source_of_ray: View, target: View) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of `target` (h, w) lies in the source view: x and y (h, w) float32; OUTSIDE where nowhere."""
    return dense_map(
        source_of_ray.ray_to_pixel(target.pixel_to_ray(node_grid(target.size_px))), target.size_px
    )


def node_grid(size_px: tuple[int, int]) -> FloatArray:
    """Every STEP-th pixel (rows, columns, 2) of a picture of size (w, h), one more than covers it."""
    w, h = size_px
    x = np.arange((w - 1) // STEP + 2, dtype=np.float64) * STEP
    y = np.arange((h - 1) // STEP + 2, dtype=np.float64) * STEP
    return np.stack(np.meshgrid(x, y), axis=-1)


def dense_map(nodes: FloatArray, size_px: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x and y (h, w) float32 of a map given at `node_grid`; OUTSIDE where a node of the cell is NaN."""
    w, h = size_px
    ix, iy = np.meshgrid(np.arange(w, dtype=np.float32) / STEP, np.arange(h, dtype=np.float32) / STEP)
    dense = cv2.remap(nodes.astype(np.float32), ix, iy, cv2.INTER_LINEAR)
    if not np.isfinite(nodes).all():
        dense[~np.isfinite(dense).all(axis=-1)] = OUTSIDE
    return np.ascontiguousarray(dense[..., 0]), np.ascontiguousarray(dense[..., 1])


def seen(
    map_x: NDArray[np.float32], map_y: NDArray[np.float32], size_px: tuple[int, int]
) -> NDArray[np.bool_]:
    """(h, w) which pixels of a warp fall on the source picture of size (w, h)."""
    w, h = size_px
    return (map_x > -0.5) & (map_x < w - 0.5) & (map_y > -0.5) & (map_y < h - 0.5)
