"""Photographs of real grounds as scenes of registration: known cameras, people pasted in up to a share of the picture.

The camera has no lens here, as in scenes.py. What a photograph cannot show is missing: nothing but the people moves.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.photographs import path_of
from tests.synth.camera import SynthCamera
from tests.synth.paths import LensSpec
from tests.synth.photographs import Photograph, paste, read_people, read_photograph

N_PEOPLE = 14
_QUARTER = 4


@cache
def _photograph(path: Path) -> Photograph:
    return read_photograph(path)


@cache
def _people(data: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """The people of the first masked sequence. Raises FileNotFoundError without one."""
    folder = next(iter(sorted(data.glob("*_mask"))), None)
    if folder is None:
        raise FileNotFoundError(f"{data}: no masked sequence *_mask to cut people from")
    return read_people(folder)


class PhotoScene:
    """A move over a photograph, by a seed; players: the people's mean share of the picture.

    data: folder of the photographs and of the masked sequence; picture: the photograph's place in it.
    """

    def __init__(
        self, data: Path, picture: str, seed: int, size_px: tuple[int, int], n_frames: int, players: float
    ) -> None:
        self.seed, self.size_px = seed, size_px
        self._photograph = _photograph(data / picture)
        self._path = dataclasses.replace(path_of(self._photograph, seed, size_px, n_frames), lens=LensSpec())
        self._people = _people(data) if players else []
        rng = np.random.default_rng([seed, 816])
        spec = self._path.spec
        centre = np.deg2rad([spec.pan0_deg, spec.tilt0_deg])
        # About where the camera looks at some time; feet below the middle, for the people stand above them.
        self._feet = centre + rng.uniform(-1, 1, (N_PEOPLE, 2)) * np.deg2rad([spec.pan_deg / 2 + 12, 9.0])
        self._feet[:, 1] -= np.deg2rad(4.0)
        self._speed = rng.normal(0, 0.002, (N_PEOPLE, 2)) * [1.0, 0.25]  # rad a frame
        self._phase = rng.integers(0, 100, N_PEOPLE)
        self._height_rad = self._height_for(players, n_frames) if players else 0.0
        self._views: dict[int, np.ndarray] = {}

    def camera(self, index: int) -> SynthCamera:
        return self._path.camera(index)

    def draw(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """RGB (h, w, 3) uint8 and the people's cover (h, w) uint8 of a frame."""
        if index not in self._views:  # a view takes longer than everything else of a picture
            seen = self._photograph.view(self.camera(index))
            self._views[index] = np.clip(seen + 0.5, 0, 255).astype(np.uint8)
        image = self._views[index].astype(np.float32)
        cover = np.zeros_like(image)
        self._paste(image, cover, self.camera(index), index, self._height_rad)
        return np.clip(image + 0.5, 0, 255).astype(np.uint8), (cover[..., 0] + 0.5).astype(np.uint8)

    def _paste(
        self, image: np.ndarray | None, cover: np.ndarray, camera: SynthCamera, index: int, height_rad: float
    ) -> None:
        """People into image and, white, into cover (h, w, 3) float32."""
        for k in range(N_PEOPLE if self._people else 0):
            lon, lat = self._feet[k] + self._speed[k] * index
            ray = np.array([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)])
            foot = camera.ray_to_pixel(ray)
            high = height_rad * camera.f_px
            if not np.isfinite(foot).all() or (np.abs(foot) > 2 * camera.width + high).any():
                continue
            rgb, share = self._people[(self._phase[k] + index // 2) % len(self._people)]
            if image is not None:
                paste(image, (rgb, share), foot, high)
            paste(cover, (np.full_like(rgb, 255.0), share), foot, high)

    def _height_for(self, players: float, n_frames: int) -> float:
        """Height, rad, at which people cover that mean share of the picture: bisection at a quarter of the size."""
        w, h = (v // _QUARTER for v in self.size_px)
        some = np.linspace(n_frames // 4, 3 * n_frames // 4, 4).astype(int)

        def share(height_rad: float) -> float:
            total = 0.0
            for index in some:
                c = self.camera(int(index))
                small = dataclasses.replace(
                    c, width=w, height=h, f_px=c.f_px / _QUARTER, cx_px=(w - 1) / 2, cy_px=(h - 1) / 2
                )
                cover = np.zeros((h, w, 3), np.float32)
                self._paste(None, cover, small, int(index), height_rad)
                total += float((cover[..., 0] > 127).mean())
            return total / len(some)

        lo, hi = 0.01, 4.0
        for _ in range(10):
            middle = float(np.sqrt(lo * hi))
            lo, hi = (middle, hi) if share(middle) < players else (lo, middle)
        return float(np.sqrt(lo * hi))
