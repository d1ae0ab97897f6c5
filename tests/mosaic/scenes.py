"""A world that is a formula, and pictures of it by Placements: what the composite tests compare with."""

from __future__ import annotations

import numpy as np

from mosaic.composite import CompositeOptions, FrameStore, composite
from mosaic.views import ViewPlan


def world_colour(rays, fine=60.0, height=45.0):
    """Colours (..., 3), 40..215, of a smooth world: waves (fine: phase per radian, height: grey levels) on colour."""
    lon = np.arctan2(rays[..., 0], rays[..., 2])
    lat = -np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    wave = np.sin(fine * lon + 9 * lat) * np.cos(fine * lat - 5 * lon)
    base = np.stack([np.sin(7 * lon + 1), np.cos(5 * lat - 3 * lon), np.sin(6 * lat + 4 * lon)], axis=-1)
    return 127.5 + height * wave[..., None] + 40 * base


def picture(placement, *, fine=60.0, height=45.0, gain=1.0, noise=0.0, seed=0, corner_loss=0.0):
    """What the placement sees, uint8 RGB (h, w, 3); its light falls with r^2, by corner_loss in the corners."""
    xy = np.stack(np.meshgrid(*(np.arange(n) for n in placement.size_px)), axis=-1).astype(float)
    colour = world_colour(placement.pixel_to_ray(xy), fine, height) * gain
    if corner_loss:
        off = xy - (np.array(placement.size_px) - 1) / 2
        colour *= (
            1 - corner_loss * ((off / off[0, 0]) ** 2 @ (off[0, 0] ** 2 / (off[0, 0] ** 2).sum()))[..., None]
        )
    colour += np.random.default_rng([seed, placement.frame]).normal(0, noise, colour.shape) if noise else 0
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def clean_plate(surface, fine=60.0):
    """The true panorama, float (h, w, 3)."""
    xy = np.stack(np.meshgrid(np.arange(surface.width), np.arange(surface.height)), axis=-1)
    return world_colour(surface.pixel_to_ray(xy), fine)


def plan_of(placements):
    """A plan that keeps every frame."""
    frames = tuple(p.frame for p in placements)
    return ViewPlan(
        frames=frames, n_views=np.zeros((1, 1), np.int32), n_candidates=len(frames), limit=len(frames)
    )


def composite_of(folder, placements, surface, pictures=None, masks=None, trusts=None, **options):
    """Store a picture per placement (default: the world's) and composite them all."""
    with FrameStore(folder, placements[0].size_px) as store:
        for i, placement in enumerate(placements):
            rgb = picture(placement) if pictures is None else pictures[i]
            store.put(placement.frame, rgb, masks[i] if masks else None, trusts[i] if trusts else None)
        return composite(
            plan_of(placements), store, placements, surface, CompositeOptions(**({"tile_px": 128} | options)),
            scratch=folder,
        )  # fmt: skip


def psnr(image, truth, where):
    error = (image.astype(float) - np.clip(truth, 0, 255))[where]
    return float(10 * np.log10(255**2 / np.mean(error**2)))
