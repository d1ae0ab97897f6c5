"""How clean the panorama is: generator clips through `process`, against the true environment without players.

    python -m benchmarks.clean_plate [--seeds 7 12] [--players 0.10 0.25] [--frames 160] [--out FOLDER] [--reuse]

PSNR (dB) of the panorama where anything was seen, where players passed, where they passed and at least FIVE of the
frames used show the ground, and elsewhere. One gain per channel is taken off (exposure is not the question). Twice:
`aligned`, where each panorama pixel is followed back through the frames that made it to the ray that it truly shows,
so that a wrong focal length does not count; and `placed`, with nothing but the world's rotation at the reference frame
taken off. `left` is the share of those five-view pixels that differ from the truth by more than 60 grey levels:
visible remains.
With --out the panoramas and error pictures stay there as PNG; --reuse measures runs that are there already.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.records import Lens
from calib.rotation import from_pan_tilt_roll
from mosaic.surface import Surface
from pipelines.archive import read_camera_csv, read_run
from pipelines.bridge import CameraPlacement, CameraPose
from pipelines.run import process
from tests.synth.clip import ClipSpec, SynthClip, write_clip
from tests.synth.presets import preset

FIVE = 5
STEP_PX = 8  # panorama px between exact points of a map
REMAINS_GREY = 60.0
BORDER_PX = 4
COLUMNS = ("clip", "players", "way", "seen dB", "passed dB", "five dB", "elsewhere dB", "left %", "seconds")

Mask = NDArray[np.bool_]
Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """On the panorama's pixels: aligned, placed (h, w, 3) true colours, NaN where nothing was painted. passed (h, w): a
    player stood there in a frame used; n_clear (h, w): frames used that show the ground. clear: of each of them, where
    (frame h, w) the ground is seen. turn (3, 3): the panorama's world to the true one."""

    aligned: Image
    placed: Image
    passed: Mask
    n_clear: NDArray[np.int32]
    clear: dict[int, Mask]
    turn: NDArray[np.float64]


def clip_spec(seed: int, players: float, n_frames: int) -> ClipSpec:
    """A clip like the sample, 720p, there and back for odd seeds."""
    spec = preset("sample", seed=seed)
    path = replace(spec.path, there_and_back=bool(seed % 2))
    return replace(spec, path=path, player_share=players, n_frames=n_frames, x264_preset="veryfast")


def true_picture(clip: SynthClip, run: Path) -> Truth:
    """What the panorama of a finished run should show."""
    facts = json.loads((run / "shot-000" / "panorama.json").read_text())
    surface = Surface(
        kind=facts["projection"], scale_px=facts["scale_px_per_rad"], cx=facts["centre_px"][0],
        cy=facts["centre_px"][1], width=facts["size_px"][0], height=facts["size_px"][1],
    )  # fmt: skip
    placed = {p.frame: p for p in placements_of_run(run)}
    used = [k for k in facts["frames"] if k in placed]
    x = np.arange(0, surface.width + STEP_PX, STEP_PX)
    y = np.arange(0, surface.height + STEP_PX, STEP_PX)
    nodes = surface.pixel_to_ray(np.stack(np.meshgrid(x, y), axis=-1))
    rays, weight = np.zeros(nodes.shape), np.zeros(nodes.shape[:2])
    shape = (surface.height, surface.width)
    n_clear, passed = np.zeros(shape, np.int32), np.zeros(shape, bool)
    clear: dict[int, Mask] = {}
    for k in used:
        at, frame = placed[k].ray_to_pixel(nodes), clip.frame(k)
        clear[k] = ~frame.player_mask & ~frame.overlay_mask
        height, width = frame.player_mask.shape
        known = np.asarray(np.isfinite(at).all(axis=-1))
        at = np.where(known[..., None], at, -1e5)
        off = np.abs(at / [(width - 1) / 2, (height - 1) / 2] - 1).max(axis=-1)
        share = np.where(
            off < 1.1, (1.1 - off) ** 2, 0.0
        )  # the frame in whose middle a pixel lies tells best
        rays += share[..., None] * np.nan_to_num(
            clip.camera(k).pixel_to_ray(np.where(off[..., None] < 1.1, at, 0.0))
        )
        weight += share
        xy = _expanded(at, shape)
        last = np.array([width, height]) - 1 - BORDER_PX
        inside = np.asarray((xy >= BORDER_PX) & (xy <= last)).all(axis=-1)
        player, other = (_looked_up(mask, xy) & inside for mask in (frame.player_mask, frame.overlay_mask))
        passed |= player
        n_clear += inside & ~player & ~other
    mean = _expanded(rays / np.maximum(weight, 1e-9)[..., None], shape)
    wanted = int(read_run(run).shots[0].reference_frame)
    reference = min(placed, key=lambda k: abs(k - wanted))  # its own camera may be one that the run withdrew
    turn = clip.camera(reference).R_cam_world.T @ placed[reference].pose.R
    plain = (
        surface.pixel_to_ray(np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1))
        @ turn.T
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        aligned = clip.renderer.sample_environment(mean, surface.scale_px)
        return Truth(
            aligned=np.where(_expanded(weight, shape)[..., None] > 0, aligned, np.nan),
            placed=clip.renderer.sample_environment(plain, surface.scale_px), passed=passed, n_clear=n_clear,
            clear=clear, turn=turn,
        )  # fmt: skip


def placements_of_run(run: Path) -> list[CameraPlacement]:
    """The run's cameras, from its camera.csv alone."""
    table, size_px = read_camera_csv(run / "camera.csv"), read_run(run).clip["size_px"]
    columns = {
        name: np.array(getattr(table, name), dtype=np.float64)
        for name in ("f_px", "pan_deg", "tilt_deg", "roll_deg", "cx_px", "cy_px", "aspect", "k1")
    }
    found = []
    for i, frame in enumerate(table.frame):
        row = {name: float(column[i]) for name, column in columns.items()}
        if not np.isfinite(row["f_px"]):
            continue
        k1_half = row["k1"] * (size_px[0] / (2 * row["f_px"])) ** 2
        lens = Lens(
            size_px=(size_px[0], size_px[1]), pp_px=np.array([row["cx_px"], row["cy_px"]]), aspect=row["aspect"],
            c0=k1_half, c1=0.0,
        )  # fmt: skip
        R = from_pan_tilt_roll(*np.radians([row["pan_deg"], row["tilt_deg"], row["roll_deg"]]))
        pose = CameraPose(log_f=float(np.log(row["f_px"])), R=R)
        found.append(CameraPlacement(frame=int(frame), size_px=lens.size_px, lens=lens, pose=pose))
    return found


def _expanded(nodes: NDArray[np.floating[Any]], shape: tuple[int, int]) -> Image:
    """Linear between nodes STEP_PX apart, at all pixels."""
    x, y = (np.arange(n, dtype=np.float32) / STEP_PX for n in (shape[1], shape[0]))
    at = np.meshgrid(x, y)
    return np.asarray(cv2.remap(nodes.astype(np.float32), at[0], at[1], cv2.INTER_LINEAR), np.float32)


def _looked_up(mask: Mask, xy: Image) -> Mask:
    return cv2.remap(mask.astype(np.uint8), xy[..., 0], xy[..., 1], cv2.INTER_NEAREST) > 0


def measure(image: NDArray[np.uint8], seen: Mask, truth: Truth) -> dict[str, dict[str, float]]:
    """way -> figure -> value; see the module's first lines. image (h, w, 3) RGB, seen (h, w)."""
    result = {}
    for way, target in (("aligned", truth.aligned), ("placed", truth.placed)):
        where = seen & np.isfinite(target).all(axis=-1)
        gain = [np.median(target[where][:, i] / np.maximum(image[where][:, i], 8)) for i in range(3)]
        error = np.clip(image * np.array(gain, np.float32), 0, 255) - target
        five = where & truth.passed & (truth.n_clear >= FIVE)
        result[way] = {
            "seen dB": _psnr(error[where]),
            "passed dB": _psnr(error[where & truth.passed]),
            "five dB": _psnr(error[five]),
            "elsewhere dB": _psnr(error[where & ~truth.passed]),
            "left %": 100 * float((np.abs(error[five]).max(axis=-1) > REMAINS_GREY).mean()),
        }
    return result


def _psnr(error: Image) -> float:
    return (
        float(10 * np.log10(255**2 / np.mean(error.astype(np.float64) ** 2))) if len(error) else float("nan")
    )


def run_one(spec: ClipSpec, folder: Path, reuse: bool) -> dict[str, dict[str, float]]:
    """One clip written, processed and measured; leaves panorama.png and error.png in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    video, out = folder / "clip.mp4", folder / "run"
    if not (reuse and (out / "run.json").exists()):
        write_clip(video, spec)
        process(video, out)
    picture = cv2.imread(str(out / "shot-000" / "panorama.tif"), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape[-1] != 4:
        raise SystemExit(f"{out}: no panorama with an alpha channel to measure")
    image, seen = cv2.cvtColor(picture, cv2.COLOR_BGRA2RGB), picture[..., 3] > 0
    truth = true_picture(SynthClip(spec), out)
    error = np.abs(image - np.nan_to_num(truth.aligned)).max(axis=-1) * seen
    cv2.imwrite(str(folder / "panorama.png"), picture)
    cv2.imwrite(str(folder / "error.png"), np.clip(2 * error, 0, 255).astype(np.uint8))
    result = measure(np.asarray(image, np.uint8), seen, truth)
    seconds = float(read_run(out).timings_s["total"])
    return {way: {**figures, "seconds": seconds} for way, figures in result.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8])
    parser.add_argument("--players", type=float, nargs="+", default=[0.10, 0.25])
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--reuse", action="store_true", help="measure runs that lie in --out already")
    chosen = parser.parse_args(arguments)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for players in chosen.players:
            for seed in chosen.seeds:
                folder = (chosen.out or Path(scratch)) / f"{seed}-{round(100 * players)}"
                result = run_one(clip_spec(seed, players, chosen.frames), folder, chosen.reuse)
                for way, figures in result.items():
                    values = [
                        format(figures[name], ".2f" if name == "left %" else ".1f") for name in COLUMNS[3:]
                    ]
                    print("| " + " | ".join([str(seed), f"{players:.0%}", way, *values]) + " |", flush=True)


if __name__ == "__main__":
    main()
