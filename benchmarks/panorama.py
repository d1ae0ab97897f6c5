"""The panorama against an oracle and against other compositors: the same frames, the same surface, known truth.

    python -m benchmarks.panorama [--seeds 7 8] [--players 0.10 0.25] [--frames 120] [--crops FOLDER] [--out FOLDER]

Clips of the generator, 720p, with a player who stands still for 40 % of the shot, an exposure ramp of one stop, flicker
of 3 %, a scoreboard. `oracle` is our composite with the true player masks and the true cameras; the others have the
cameras of our run (panorama_peers.py says what they are). PSNR (dB) and SSIM to the clean environment where players
passed and five of the frames used show the ground, and elsewhere; one gain per channel is taken off each. SSIM is the
mean over all that the method and the run have seen. Where the run makes several shots of a clip, the first one is
measured (see the column of frames). With --crops a strip of crops per clip is written there as JPEG.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import panorama_peers as peers
from benchmarks.clean_plate import FIVE, Image, Mask, Truth, clip_spec, placements_of_run, true_picture
from calib import rotation
from mosaic.composite import composite
from mosaic.framestore import FrameStore
from mosaic.surface import Surface
from mosaic.views import CompositeOptions, ViewPlan
from pipelines.bridge import CameraPlacement
from pipelines.config import Config
from pipelines.decode import open_clip
from pipelines.exports.panorama_json import read_surface
from pipelines.exports.pto import PtoFrame
from pipelines.run import process
from tests.synth.camera import SynthCamera
from tests.synth.clip import ClipSpec, SynthClip, write_clip

COLUMNS = ("clip", "players", "method", "frames", "five dB", "elsewhere dB", "SSIM", "left %", "seconds")
REMAINS_GREY = 60.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePlacement:
    """A true camera as mosaic's Placement, in the world of the run: turn (3, 3) leads from there to the true one."""

    frame: int
    size_px: tuple[int, int]
    camera: SynthCamera
    turn: NDArray[np.float64]
    blur_px: float = 0.0

    @property
    def px_per_rad(self) -> float:
        return self.camera.f_px

    def ray_to_pixel(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.camera.ray_to_pixel(rays @ self.turn.T))

    def pixel_to_ray(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.camera.pixel_to_ray(xy) @ self.turn)


def panorama_spec(seed: int, players: float, n_frames: int) -> ClipSpec:
    """What the module's first lines say."""
    spec = clip_spec(seed, players, n_frames)
    return replace(spec, standing_players=1, exposure_ramp_stops=1.0, flicker=0.03)


def oracle(
    clip: SynthClip, truth: Truth, surface: Surface, pictures: dict[int, NDArray[np.uint8]], folder: Path
) -> tuple[NDArray[np.uint8], Mask]:
    """Our composite with true masks and true cameras."""
    frames = sorted(truth.clear)
    size_px = (clip.spec.width, clip.spec.height)
    placements = [
        TruePlacement(frame=k, size_px=size_px, camera=clip.camera(k), turn=truth.turn) for k in frames
    ]
    with FrameStore(folder, size_px) as store:
        for k in frames:
            store.put(k, pictures[k], truth.clear[k])
        plan = ViewPlan(frames=tuple(frames), n_views=np.zeros((1, 1), np.int32), n_candidates=0, limit=0)
        options = CompositeOptions(motion_rounds=0)
        panorama = composite(plan, store, placements, surface, options, scratch=folder)
    return np.asarray(panorama.image), np.asarray(panorama.alpha) > 0


def figures(
    image: NDArray[np.uint8], seen: Mask, target: Image, truth: Truth, common: Mask
) -> tuple[dict[str, float], NDArray[np.uint8]]:
    """The row's figures, and the picture with its gain taken off."""
    where = seen & common & np.isfinite(target).all(axis=-1)
    gain = [np.median(target[where][:, i] / np.maximum(image[where][:, i], 8)) for i in range(3)]
    levelled = np.clip(image.astype(np.float32) * np.array(gain, np.float32), 0, 255)
    error = levelled - np.nan_to_num(target)
    five = where & truth.passed & (truth.n_clear >= FIVE)
    result = {
        "five dB": _psnr(error[five]),
        "elsewhere dB": _psnr(error[where & ~truth.passed]),
        "SSIM": float(ssim(levelled, np.nan_to_num(target), where)),
        "left %": 100 * float((np.abs(error[five]).max(axis=-1) > REMAINS_GREY).mean()),
    }
    return result, levelled.astype(np.uint8)


def _psnr(error: Image) -> float:
    return float(10 * np.log10(255**2 / np.mean(error.astype(np.float64) ** 2))) if len(error) else np.nan


def ssim(a: Image, b: Image, where: Mask) -> float:
    """Mean structural similarity of the luma (Wang and others 2004: Gaussian of 1.5 px, K .01 and .03) over `where`
    less what lies within the window of its border."""
    x, y = (np.asarray(p, np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) for p in (a, b))

    def blur(picture: Image) -> Image:
        return np.asarray(cv2.GaussianBlur(picture, (11, 11), 1.5), np.float32)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    value = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    inner = cv2.erode(where.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
    return float(value[inner].mean())


def pto_frames(placements: dict[int, CameraPlacement], numbers: list[int]) -> list[PtoFrame]:
    """The frames as Hugin cameras."""
    found = []
    for k in numbers:
        p = placements[k]
        pan, tilt, roll = rotation.to_pan_tilt_roll(p.pose.R)
        found.append(
            PtoFrame(
                name=f"frame_{k:06d}.png", size_px=p.size_px, f_px=p.px_per_rad, pan_rad=float(pan),
                tilt_rad=float(tilt), roll_rad=float(roll), cx_px=float(p.lens.pp_px[0]),
                cy_px=float(p.lens.pp_px[1]), k1=float(p.lens.k1_opencv(p.pose.log_f)),
            )
        )  # fmt: skip
    return found


def run_one(
    spec: ClipSpec, folder: Path, crops: Path | None, name: str
) -> list[tuple[str, int, dict[str, float]]]:
    """Rows (method, frames, figures) of one clip."""
    folder.mkdir(parents=True, exist_ok=True)
    video, out = folder / "clip.mp4", folder / "run"
    if not (out / "run.json").exists():
        write_clip(video, spec)
        process(video, out, Config.model_validate({"panorama": {"max_megapixels": 2.0}}))
    clip = SynthClip(spec)
    truth = true_picture(clip, out)
    surface = read_surface(out / "shot-000" / "panorama.json")
    placements = {p.frame: p for p in placements_of_run(out)}
    frames = sorted(truth.clear)
    with open_clip(video, Config().decode) as opened:
        pictures = {f.index: f.picture() for f in opened if f.index in truth.clear}
    ours = cv2.imread(str(out / "shot-000" / "panorama.tif"), cv2.IMREAD_UNCHANGED)
    if ours is None or ours.shape[-1] != 4:
        raise SystemExit(f"{out}: no panorama with an alpha channel to measure")
    common = ours[..., 3] > 0
    few = peers.spread_over(frames)
    timings = json.loads((out / "run.json").read_text())["timings_s"]
    made: dict[str, tuple[NDArray[np.uint8], Mask] | None] = {}
    used = {method: len(frames) for method in ("ours", "oracle", "mean", "feather")} | {"opencv": len(few)}
    seconds: dict[str, float] = {"ours": float(timings["composite"])}
    made["ours"] = np.asarray(cv2.cvtColor(ours, cv2.COLOR_BGRA2RGB), np.uint8), common
    for method in ("oracle", "mean", "feather", "opencv", "hugin"):
        start = time.perf_counter()
        if method == "oracle":
            made[method] = oracle(clip, truth, surface, pictures, folder)
        elif method == "hugin":
            found = peers.hugin(surface, pto_frames(placements, few), pictures, few, folder / "hugin")
            made[method] = None if found is None else found[:2]
            used[method] = 0 if found is None else found[2]
        else:
            use = few if method == "opencv" else frames
            make = {"mean": peers.mean, "feather": peers.feather, "opencv": peers.opencv}[method]
            made[method] = make(surface, peers.warped(surface, placements, pictures, use))
        seconds[method] = time.perf_counter() - start
    rows, levelled = [], {}
    for method, result in made.items():
        if result is None:
            print(f"{method}: nona or enblend is not installed, skipped")
            continue
        target = truth.placed if method == "oracle" else truth.aligned
        row, levelled[method] = figures(*result, target, truth, common)
        rows.append((method, used[method], row | {"seconds": seconds[method]}))
        cv2.imwrite(str(folder / f"{method}.png"), cv2.cvtColor(levelled[method], cv2.COLOR_RGB2BGR))
    if crops is not None:
        crops.mkdir(parents=True, exist_ok=True)
        write_crops(levelled, truth, crops / f"{name}.jpg")
    return rows


def write_crops(
    pictures: dict[str, NDArray[np.uint8]], truth: Truth, path: Path, size: tuple[int, int] = (300, 200)
) -> None:
    """The place where players passed most, from each method and the truth, side by side in two rows."""
    width, height = size
    busy = cv2.boxFilter((truth.passed & (truth.n_clear >= FIVE)).astype(np.float32), -1, (width, height))
    inner = busy[height // 2 : -height // 2, width // 2 : -width // 2]
    y, x = np.unravel_index(int(np.argmax(inner)), inner.shape)
    everything = {"truth": np.clip(np.nan_to_num(truth.aligned), 0, 255).astype(np.uint8), **pictures}
    cells = []
    for method, picture in everything.items():
        cell = np.ascontiguousarray(picture[y : y + height, x : x + width])
        cv2.putText(cell, method, (6, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 2)
        cells.append(cell)
    while len(cells) % 4:
        cells.append(np.full((height, width, 3), 255, np.uint8))
    sheet = np.vstack([np.hstack(cells[i : i + 4]) for i in range(0, len(cells), 4)])
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8])
    parser.add_argument("--players", type=float, nargs="+", default=[0.10, 0.25])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--crops", type=Path)
    parser.add_argument(
        "--out", type=Path, help="keep clips, runs and pictures there; runs found there are used"
    )
    chosen = parser.parse_args(arguments)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for players in chosen.players:
            for seed in chosen.seeds:
                name = f"{seed}-{round(100 * players)}"
                folder = (chosen.out or Path(scratch)) / name
                spec = panorama_spec(seed, players, chosen.frames)
                for method, n, row in run_one(spec, folder, chosen.crops, name):
                    digits = {"SSIM": ".3f", "left %": ".2f"}
                    values = [format(row[c], digits.get(c, ".1f")) for c in COLUMNS[4:]]
                    print(
                        f"| {seed} | {players:.0%} | {method} | {n} | " + " | ".join(values) + " |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
