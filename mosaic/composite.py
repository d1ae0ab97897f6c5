"""Placements and stored frames -> Panorama, tile by tile.

plan_views (first, with approximate placements) -> a pass over the clip that puts the planned frames into a
FrameStore -> composite (with the final placements). Memory: the panorama, one stack of views per thread, the
store's cache; nothing grows with the clip.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mosaic.canvas import Canvas
from mosaic.detail import give_back_detail
from mosaic.framestore import COARSE, FrameStore
from mosaic.gains import solve_log_gains
from mosaic.moving import find_still, shown_clear
from mosaic.surface import Placement, Surface
from mosaic.tile_maps import Scene
from mosaic.tiles import paint
from mosaic.views import (
    CompositeOptions,
    Lattice,
    Rating,
    ViewPlan,
    lattice_of,
    plan_views,
    rate_views,
    share_views,
)
from mosaic.vignetting import N_BLOCKS, NONE, corner, log_falloff, radius_squared, solve_falloff

__all__ = ["Canvas", "CompositeOptions", "FrameStore", "Panorama", "ViewPlan", "composite", "plan_views"]

STRIP_ROWS = 1024  # of a picture that are looked at together
DARK_GREY, BURNT_GREY = 8, 247  # beyond them a gain does not act as a factor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panorama:
    """The picture and where each pixel looks.

    image (h, w, 3) uint8 RGB; alpha (h, w) uint8, 0 where nothing was seen, else 255. n_seen (h, w) uint8: views
    that saw the pixel. spread (h, w) uint8: 1.4826 times the median distance of the views from the value, in grey
    levels (0 where fewer than 3 views). frames: those used. placements: of every frame of the shot, by number.
    gains (len(frames), 3): what each frame's channels were multiplied by. falloff (2,): a, b of the lens's
    (vignetting.py), zeros where none was found. deep (h, w, 3) uint16 of 0..65535: image
    with more than 8 bits, where the frames have them.
    """

    image: NDArray[np.uint8]
    alpha: NDArray[np.uint8]
    surface: Surface
    n_seen: NDArray[np.uint8]
    spread: NDArray[np.uint8]
    frames: tuple[int, ...]
    placements: Mapping[int, Placement]
    gains: NDArray[np.float64]
    falloff: NDArray[np.float64] = field(default_factory=lambda: NONE)
    deep: NDArray[np.uint16] | None = None
    canvas: Canvas | None = field(default=None, repr=False)

    def pixel_to_ray(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Panorama pixels (..., 2) -> unit rays (..., 3) in the shot world."""
        return self.surface.pixel_to_ray(xy)

    def ray_to_pixel(self, rays: ArrayLike) -> NDArray[np.float64]:
        """Rays (..., 3) in the shot world -> panorama pixels (..., 2), NaN where the surface has none."""
        return self.surface.ray_to_pixel(rays)

    def frame_to_pixel(self, frame: int, xy: ArrayLike) -> NDArray[np.float64]:
        """Raw pixels (..., 2) of a frame -> panorama pixels (..., 2). Raises KeyError for a frame without placement."""
        return self.surface.ray_to_pixel(
            self.placements[frame].pixel_to_ray(np.asarray(xy, dtype=np.float64))
        )

    def pixel_to_frame(self, frame: int, xy: ArrayLike) -> NDArray[np.float64]:
        """Panorama pixels (..., 2) -> raw pixels (..., 2) of a frame, inside it or not; NaN where it cannot look."""
        return self.placements[frame].ray_to_pixel(self.surface.pixel_to_ray(xy))

    def release(self) -> None:
        """Give back memory that the picture's file occupies; it is read again when touched. For long writers."""
        if self.canvas is not None:
            self.canvas.release()


def composite(
    plan: ViewPlan,
    store: FrameStore,
    placements: Sequence[Placement],
    surface: Surface,
    options: CompositeOptions | None = None,
    *,
    scratch: str | os.PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Panorama:
    """The panorama of the stored frames on a surface.

    placements: the final ones of the shot; frames of the plan that are not in the store, or lost since, are left out.
    scratch: folder for a picture too large for memory (default: the system's). progress: called with 0..1 from
    worker threads, one at a time. Raises ValueError when no stored frame sees the surface.
    """
    options = options or CompositeOptions()
    by_frame = {p.frame: p for p in placements}
    stored = [
        by_frame[k]
        for k in plan.frames
        if k in store and k in by_frame and np.isfinite(by_frame[k].px_per_rad)
    ]
    scene, rating, light = scene_of(store, stored, surface, options)
    views = scene.views
    if options.motion_rounds > 0:
        still, quiet = find_still(scene)
        clear = shown_clear(still, views, scene.lattice, surface)
        vote = share_views(views, rating, scene.lattice, surface.scale_px, options, clear)
        scene = replace(scene, still=still, quiet=quiet, vote=vote)
    canvas = Canvas(scratch or tempfile.gettempdir(), options.memory_bytes)
    layers = paint(replace(scene, deep=store.deep), canvas, progress)
    give_back_detail(
        layers.image, layers.deep, layers.n_seen, canvas,
        share=options.detail, sigma_px=surface.scale_px / max(p.px_per_rad for p in views),
    )  # fmt: skip
    alpha = canvas.zeros(layers.n_seen.shape)
    for top in range(0, surface.height, STRIP_ROWS):  # not at once: both may be larger than memory
        rows = np.s_[top : top + STRIP_ROWS]
        np.multiply(layers.n_seen[rows] > 0, np.uint8(255), out=alpha[rows], casting="unsafe")
        canvas.release()
    return Panorama(
        image=layers.image, alpha=alpha, surface=surface, n_seen=layers.n_seen, spread=layers.spread,
        frames=tuple(p.frame for p in views), placements=by_frame, gains=light.gains, falloff=light.falloff,
        deep=layers.deep, canvas=canvas,
    )  # fmt: skip


def scene_of(
    store: FrameStore, stored: Sequence[Placement], surface: Surface, options: CompositeOptions
) -> tuple[Scene, Rating, Light]:
    """What find_still and paint work on: the views of these frames of a store, their votes and their light.

    Raises ValueError when none of them sees the surface."""
    lattice = lattice_of(surface)
    views, rating, vote = _final_views(stored, lattice, surface, options)
    light = solve_light(store, views, surface) if options.gains else Light(np.ones((len(views), 3)), NONE)
    scene = Scene(
        surface=surface, store=store, views=views, gains=light.gains.astype(np.float32),
        falloff=light.falloff, lattice=lattice, floor=rating.floor.reshape(vote.shape[1:]), vote=vote, options=options,
        still=tuple(store.still(p.frame) for p in views),
    )  # fmt: skip
    return scene, rating, light


def _final_views(
    stored: Sequence[Placement], lattice: Lattice, surface: Surface, options: CompositeOptions
) -> tuple[tuple[Placement, ...], Rating, NDArray[np.float32]]:
    """Views in use, their rating and votes (n, ny, nx), with the final placements."""
    if not stored:
        raise ValueError("no stored frame has a placement: nothing to composite")
    rating = rate_views(stored, lattice, options)
    vote = share_views(stored, rating, lattice, surface.scale_px, options)
    if not vote.any():
        raise ValueError(f"none of {len(stored)} stored frames sees the panorama")
    # Also those without a vote: a strip between lattice points may have nobody else.
    return tuple(stored), rating, vote


class Light(NamedTuple):
    """gains (n, 3) per frame and channel, median 1; falloff (2,) of the lens, see vignetting.py."""

    gains: NDArray[np.float64]
    falloff: NDArray[np.float64]


def solve_light(
    store: FrameStore, views: Sequence[Placement], surface: Surface, n_points: int = 3000
) -> Light:
    """What makes the views agree, from the coarse pictures.

    store, views, surface: as of `composite`; n_points: of the panorama that are looked at. Dark and burnt blocks are
    left out. The falloff is the same for all channels.
    """
    lattice = lattice_of(surface, n_points)
    samples = np.zeros((3, len(views), len(lattice.rays)), np.float32)
    weight = np.zeros(samples.shape[1:], np.float32)
    r2 = np.zeros(samples.shape[1:])
    for row, placement in enumerate(views):
        picture, trust = store.coarse(placement.frame)
        xy = placement.ray_to_pixel(lattice.rays)
        at = (xy - (COARSE - 1) / 2) / COARSE
        height, width = trust.shape
        with np.errstate(invalid="ignore"):
            inside = ((at >= 0) & (at <= [width - 1.001, height - 1.001])).all(axis=-1)
        if not inside.any() or min(width, height) < 2:
            continue
        value, sure = _coarse_samples(picture, trust, at[inside])
        usable = sure * ((value > DARK_GREY) & (value < BURNT_GREY)).all(axis=-1)
        samples[:, row, inside] = np.log(np.maximum(value, 1.0)).T
        weight[row, inside] = usable
        r2[row, inside] = radius_squared(xy[inside], placement.size_px)
    n_columns = len(lattice.x_px)
    block = np.arange(len(lattice.rays)) % n_columns * N_BLOCKS // n_columns
    falloff = solve_falloff(samples.mean(axis=0), weight, r2, block, corner(views[0].size_px))
    samples -= log_falloff(falloff, r2).astype(np.float32)
    gains: list[Any] = [np.exp(solve_log_gains(channel, weight)) for channel in samples]
    return Light(np.stack(gains, axis=1), falloff)


def _coarse_samples(
    picture: NDArray[np.uint8], trust: NDArray[np.uint8], at: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bilinear colour (m, 3) and least trust 0..1 (m,) of a coarse picture at px (m, 2) inside it."""
    low = at.astype(np.intp)
    (u, v), (x, y) = (at - low).T[..., None], low.T
    corners = [
        (y, x, (1 - u) * (1 - v)),
        (y, x + 1, u * (1 - v)),
        (y + 1, x, (1 - u) * v),
        (y + 1, x + 1, u * v),
    ]
    value = sum(picture[i, j] * share for i, j, share in corners)
    sure = np.min([trust[i, j] for i, j, _ in corners], axis=0) / 255.0
    return np.asarray(value), sure * (sure > 0.5)
