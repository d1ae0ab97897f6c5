"""Photographs of real grounds as the world of a clip: panoramas turned into frames of known cameras.

The generator's stadiums are painted by us; these pictures are not. Sharp up to about one frame px per photograph px:
`px_per_rad` is the focal length beyond which a frame is blurred. People are cut out of a masked sequence.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tests.synth.camera import SynthCamera

_TILES, _FACE_PX = 4, 2048
# Right, down and forward axis of each face in the world's axes (x right, y down, z forward).
_FACES = {
    "f": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "r": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "b": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "l": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "u": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "d": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photograph:
    """An equirectangular picture rgb (h, 2 h, 3) uint8: longitude to the right, 0 in the middle; latitude upwards."""

    rgb: np.ndarray

    @property
    def px_per_rad(self) -> float:
        return float(self.rgb.shape[1] / (2 * np.pi))

    def view(self, camera: SynthCamera) -> np.ndarray:
        """(h, w, 3) float32: what the camera sees, four samples a pixel."""
        w, h = camera.width, camera.height
        half = np.stack(np.meshgrid(np.arange(2 * w), np.arange(2 * h)), axis=-1) / 2 - 0.25
        rays = camera.pixel_to_ray(half)
        height, width = self.rgb.shape[:2]
        x = (np.arctan2(rays[..., 0], rays[..., 2]) / (2 * np.pi) + 0.5) * width - 0.5
        y = (np.arcsin(np.clip(rays[..., 1], -1, 1)) / np.pi + 0.5) * height - 0.5
        fine = cv2.remap(
            self.rgb, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
        )
        return cv2.resize(fine.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)


def read_photograph(path: Path) -> Photograph:
    """An equirectangular JPEG, or a folder of cube faces f b l r u d in 4 x 4 tiles `face/row/column.jpg`.

    Raises FileNotFoundError for a missing picture."""
    return Photograph(rgb=_from_cube(path) if path.is_dir() else _read(path))


def _read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    return np.ascontiguousarray(image[:, :, ::-1])


def _from_cube(folder: Path) -> np.ndarray:
    """Equirectangular (h, 2 h, 3) at the sampling of the faces' middle."""
    width = 2 * round(np.pi * _FACE_PX / 2)
    height = width // 2
    lon = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    lat = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    out = np.zeros((height, width, 3), np.uint8)
    for name, (right, down, forward) in _FACES.items():
        rows = [
            np.hstack([_read(folder / name / str(r) / f"{c}.jpg") for c in range(_TILES)])
            for r in range(_TILES)
        ]
        face = np.vstack(rows)
        for top in range(0, height, 512):  # by strips: maps of the whole take gigabytes
            la = lat[top : top + 512, None]
            ray = np.stack(
                [np.cos(la) * np.sin(lon), np.broadcast_to(-np.sin(la), (len(la), width)), np.cos(la) * np.cos(lon)], -1
            )  # fmt: skip
            depth = ray @ np.array(forward, float)
            with np.errstate(divide="ignore", invalid="ignore"):
                x, y = (ray @ np.array(axis, float) / depth for axis in (right, down))
            inside = (depth > 0) & (np.abs(x) <= 1.0005) & (np.abs(y) <= 1.0005)
            at = [np.where(inside, (v + 1) * _FACE_PX / 2 - 0.5, -10).astype(np.float32) for v in (x, y)]
            strip = cv2.remap(face, at[0], at[1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
            out[top : top + 512][inside] = strip[inside]
    return out


def read_people(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """People cut out of `rgb/` by `mask/`: (picture (h, w, 3) float32, share (h, w) float32), in the order of time."""
    found = []
    masks = sorted(folder.glob("mask/**/*.png"))
    pictures = sorted(p for p in folder.glob("rgb/**/*") if p.suffix in (".png", ".jpg"))
    for picture, mask_path in zip(pictures, masks, strict=True):
        mask = _read(mask_path)[:, :, 0] > 127
        rows, columns = np.nonzero(mask)
        if len(rows) < 50:
            continue
        cut = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        found.append((_read(picture)[cut].astype(np.float32), mask[cut].astype(np.float32)))
    return found


def paste(
    image: np.ndarray, person: tuple[np.ndarray, np.ndarray], foot_px: np.ndarray, height_px: float
) -> None:
    """Draw a cut-out person into image (h, w, 3) float32, his feet at foot_px (2,)."""
    rgb, share = person
    high = max(round(height_px), 6)
    wide = max(round(high * rgb.shape[1] / rgb.shape[0]), 3)
    move = np.array([[1, 0, foot_px[0] - wide / 2], [0, 1, foot_px[1] - high]], np.float32)
    size = (image.shape[1], image.shape[0])
    small = cv2.resize(rgb, (wide, high), interpolation=cv2.INTER_AREA)
    cover = cv2.resize(share, (wide, high), interpolation=cv2.INTER_AREA)
    over = cv2.warpAffine(cover, move, size)[..., None]
    image *= 1 - over
    image += cv2.warpAffine(small * cover[..., None], move, size)
