"""What a pupil in front of the pan axis sees of a level pitch and a stand round about, against what the axis would see.

The scene: a level plane below the axis and a vertical wall around it. A world ray is the direction of a scene point
from the pan axis; a camera whose pupil lies on its optical axis, in front of the pan axis, sees that point elsewhere.
Lengths are in units of the pupil's offset. Source: real-footage.md 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parallax:
    """Offset of the pupil over the axis' height above the pitch and over the distance of the stand.

    R_head_world (3, 3): world axes into those of the head (y along the pan axis, downwards).
    """

    over_height: float
    over_stand: float
    R_head_world: Array

    def of_axes(self, R_new_world: ArrayLike) -> Parallax:
        """The same scene for rays in other axes; R_new_world (3, 3) turns world axes into the new ones."""
        return Parallax(
            over_height=self.over_height,
            over_stand=self.over_stand,
            R_head_world=self.R_head_world @ np.asarray(R_new_world, float).T,
        )

    def nearness(self, head_rays: ArrayLike) -> Array:
        """Pupil offset over the distance of what is seen along head_rays (..., 3), times their length; (...)."""
        rays = np.asarray(head_rays, float)
        below = self.over_height * np.maximum(rays[..., 1], 0.0)
        return np.maximum(below, self.over_stand * np.hypot(rays[..., 0], rays[..., 2]))

    def from_pupil(self, rays: ArrayLike, axis: ArrayLike) -> Array:
        """Directions (..., 3), not unit, from the pupil to what the pan axis sees along `rays` (..., 3).

        axis (3,) or (..., 3): the camera's optical axis, unit, in the axes of the rays.
        """
        rays = np.asarray(rays, float)
        near = self.nearness(rays @ self.R_head_world.T)
        return rays - near[..., None] * np.asarray(axis, float)

    def from_axis(self, rays: ArrayLike, axis: ArrayLike) -> Array:
        """Unit directions (..., 3) from the pan axis to what the pupil sees along rays (..., 3): from_pupil undone."""
        seen = np.asarray(rays, float) @ self.R_head_world.T
        pupil = np.asarray(axis, float) @ self.R_head_world.T
        with np.errstate(divide="ignore", invalid="ignore"):
            to_pitch = np.where(
                seen[..., 1] > 0, (1 / self.over_height - pupil[..., 1]) / seen[..., 1], np.inf
            )
            a = seen[..., 0] ** 2 + seen[..., 2] ** 2
            b = pupil[..., 0] * seen[..., 0] + pupil[..., 2] * seen[..., 2]
            c = pupil[..., 0] ** 2 + pupil[..., 2] ** 2 - 1 / self.over_stand**2
            to_stand = np.where(a > 0, (np.sqrt(b * b - a * c) - b) / a, np.inf)
        point = pupil + np.minimum(to_pitch, to_stand)[..., None] * seen
        return (point / np.linalg.norm(point, axis=-1, keepdims=True)) @ self.R_head_world
