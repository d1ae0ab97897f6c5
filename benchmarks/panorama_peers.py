"""Other ways to make one picture of the same frames on the same surface, for benchmarks.panorama.

mean and feather: every frame warped with our geometry. opencv: its stitcher's own compositing (gains, graph-cut
seams, multi-band) fed with our warps, because its registration of such frames returns no picture that could be laid
over the truth. hugin: nona and enblend fed with our .pto. The last two get FEW frames spread over the shot: they are
made for a handful of photographs.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mosaic.surface import Surface
from pipelines.bridge import CameraPlacement
from pipelines.exports.pto import PtoFrame, panorama_line, write_pto

FEW = 13
STEP_PX = 8

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def spread_over(frames: list[int], n: int = FEW) -> list[int]:
    """n of them, evenly."""
    return [
        frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, min(n, len(frames))).round().astype(int))
    ]


def warped(
    surface: Surface,
    placements: Mapping[int, CameraPlacement],
    pictures: Mapping[int, Picture],
    frames: list[int],
) -> Iterator[tuple[Picture, NDArray[np.float32]]]:
    """Each frame on the surface (h, w, 3) and its distance to the frame's border in px (h, w), 0 outside."""
    x, y = np.arange(0, surface.width + STEP_PX, STEP_PX), np.arange(0, surface.height + STEP_PX, STEP_PX)
    rays = surface.pixel_to_ray(np.stack(np.meshgrid(x, y), axis=-1))
    pixel = np.meshgrid(*(np.arange(n, dtype=np.float32) / STEP_PX for n in (surface.width, surface.height)))
    for k in frames:
        nodes = np.nan_to_num(placements[k].ray_to_pixel(rays), nan=-1e5).astype(np.float32)
        at = cv2.remap(nodes, pixel[0], pixel[1], cv2.INTER_LINEAR)
        height, width = pictures[k].shape[:2]
        border = np.minimum(
            np.minimum(at[..., 0], width - 1 - at[..., 0]), np.minimum(at[..., 1], height - 1 - at[..., 1])
        )
        picture = cv2.remap(pictures[k], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        yield np.asarray(picture, np.uint8), np.maximum(border - 2, 0).astype(np.float32)


def mean(surface: Surface, views: Iterator[tuple[Picture, NDArray[np.float32]]]) -> tuple[Picture, Mask]:
    """The plain mean of all frames."""
    total = np.zeros((surface.height, surface.width, 3), np.float32)
    count = np.zeros((surface.height, surface.width, 1), np.float32)
    for picture, border in views:
        seen = (border > 0)[..., None]
        total += picture * seen
        count += seen
    return np.rint(total / np.maximum(count, 1)).astype(np.uint8), count[..., 0] > 0


def feather(surface: Surface, views: Iterator[tuple[Picture, NDArray[np.float32]]]) -> tuple[Picture, Mask]:
    """The last frame wins, faded in over 40 px from its border."""
    image = np.zeros((surface.height, surface.width, 3), np.float32)
    seen = np.zeros((surface.height, surface.width), bool)
    for picture, border in views:
        share = np.where(seen, np.minimum(border / 40, 1), border > 0)[..., None].astype(np.float32)
        image += share * (picture - image)
        seen |= border > 0
    return np.rint(image).astype(np.uint8), seen


def opencv(surface: Surface, views: Iterator[tuple[Picture, NDArray[np.float32]]]) -> tuple[Picture, Mask]:
    """OpenCV's exposure compensation, seams and blender as its stitcher uses them."""
    detail: Any = cv2.detail
    pictures, masks = [], []
    for picture, border in views:
        pictures.append(picture)
        masks.append(np.where(border > 0, 255, 0).astype(np.uint8))
    corners = [(0, 0)] * len(pictures)
    # One gain per frame and channel: gains of blocks, its default, need 11 GiB for these sizes (a dense matrix).
    compensator = detail.ExposureCompensator_createDefault(detail.ExposureCompensator_CHANNELS)
    compensator.feed(corners, [_umat(p) for p in pictures], [_umat(m) for m in masks])
    # Seams at a third of the size, as the stitcher does: a graph cut over all pixels takes minutes.
    size = (surface.width // 3, surface.height // 3)
    finder = detail.GraphCutSeamFinder("COST_COLOR")
    small = [_umat(cv2.resize(p, size, interpolation=cv2.INTER_AREA).astype(np.float32)) for p in pictures]
    small_masks = [_umat(cv2.resize(m, size, interpolation=cv2.INTER_NEAREST)) for m in masks]
    cut = finder.find(small, corners, small_masks)
    blender = detail.MultiBandBlender()
    blender.setNumBands(5)
    blender.prepare((0, 0, surface.width, surface.height))
    for i, (picture, mask) in enumerate(zip(pictures, masks, strict=True)):
        levelled = compensator.apply(i, (0, 0), picture, mask)
        levelled = picture if levelled is None else np.asarray(levelled)
        part = cv2.resize(
            cv2.dilate(cut[i].get(), np.ones((3, 3), np.uint8)), (surface.width, surface.height)
        )
        blender.feed(levelled.astype(np.int16), cv2.bitwise_and(part, mask), (0, 0))
    image, seen = blender.blend(None, None)
    return np.clip(image, 0, 255).astype(np.uint8), np.asarray(seen) > 0


def _umat(picture: NDArray[Any]) -> cv2.UMat:
    return cv2.UMat(picture)  # type: ignore[call-overload]  # OpenCV takes arrays; its types do not say so


def hugin(
    surface: Surface,
    frames: list[PtoFrame],
    pictures: Mapping[int, Picture],
    numbers: list[int],
    folder: Path,
) -> tuple[Picture, Mask, int] | None:
    """nona and enblend from our project, and how many frames they took; None where they are not installed.

    Where enblend refuses frames that overlap too much, every second one is taken, until it does not."""
    if shutil.which("nona") is None or shutil.which("enblend") is None:
        return None
    folder.mkdir(exist_ok=True)
    for frame, number in zip(frames, numbers, strict=True):
        cv2.imwrite(str(folder / frame.name), cv2.cvtColor(pictures[number], cv2.COLOR_RGB2BGR))
    write_pto(folder / "p.pto", surface, frames)
    quiet: dict[str, Any] = {"cwd": folder, "check": True, "capture_output": True}
    subprocess.run(["nona", "--ignore-exposure", "-m", "TIFF_m", "-o", "view", "p.pto"], **quiet)
    x0, x1, y0, y1 = (int(v) for v in panorama_line(surface).split(" S")[1].split()[0].split(","))
    views = sorted(p.name for p in folder.glob("view*.tif"))
    place = f"-f{x1 - x0}x{y1 - y0}+{x0}+{y0}"
    while True:
        done = subprocess.run(
            ["enblend", place, "-o", "out.tif", *views], cwd=folder, capture_output=True, text=True
        )
        if done.returncode == 0:
            break
        if "excessive image overlap" not in done.stderr or len(views) < 3:
            raise RuntimeError(f"enblend: {done.stderr.strip()}")
        views = views[::2]
    picture = cv2.imread(str(folder / "out.tif"), cv2.IMREAD_UNCHANGED)
    assert picture is not None and picture.shape[:2] == (surface.height, surface.width)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGRA2RGB), np.uint8), picture[..., 3] > 0, len(views)
