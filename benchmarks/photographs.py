"""Accuracy on photographs of real grounds: clips of known cameras rendered from panoramas, through the whole job.

    python -m benchmarks.photographs DATA [--seeds 1 2] [--sizes 640x360] [--out FOLDER]

DATA holds pano/ (an equirectangular picture, cubes of tiles) and, for the people, a masked sequence. Pan, zoom, tilt,
lens, exposure and people come from the seed; focal lengths are what the photograph bears. A row per clip, as in
benchmarks.accuracy.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from pipelines.compare import compare_run
from pipelines.config import Config
from pipelines.run import process
from tests.synth.clip import TRUTH_COLUMNS, truth_path, truth_row
from tests.synth.paths import BROADCAST_LENS, CameraPath, LensSpec, PathSpec
from tests.synth.photographs import Photograph, paste, read_people, read_photograph

FPS = 25
SHARPEST = 1.1  # frame px a photograph px at the longest focal
PICTURES = {
    "football pitch": "pano/cube_sanbongda",
    "grass field": "pano/cube_grassfield1",
    "place": "pano/examplepano.jpg",
}


def path_of(photograph: Photograph, seed: int, size: tuple[int, int], n_frames: int) -> CameraPath:
    """A pan with a zoom in and out; every other seed with the lens of a broadcast camera."""
    rng = np.random.default_rng([seed, 4711])
    zoom = float(rng.uniform(1.15, 1.5))
    widest = SHARPEST * photograph.px_per_rad / zoom / size[0]
    spec = PathSpec(
        pan_deg=float(rng.uniform(15, 40)), pan0_deg=float(rng.uniform(-170, 170)), tilt_deg=2.0,
        tilt0_deg=float(rng.uniform(-10, -2)), zoom=zoom, f0_per_width=min(widest, 1.354), jitter_px=0.15,
        there_and_back=bool(rng.integers(2)),
    )  # fmt: skip
    lens = BROADCAST_LENS if seed % 2 else LensSpec()
    return CameraPath(spec=spec, lens=lens, width=size[0], height=size[1], n_frames=n_frames, seed=seed)


def write_photo_clip(
    clip: Path,
    photograph: Photograph,
    people: list[tuple[np.ndarray, np.ndarray]],
    path: CameraPath,
    n_people: int,
) -> None:
    """Encode the clip (H.264, CRF 23) and its truth beside it."""
    rng = np.random.default_rng([path.seed, 815])
    centre = np.deg2rad([path.spec.pan0_deg, path.spec.tilt0_deg])
    reach = np.deg2rad([path.spec.pan_deg / 2 + 15, 8.0])
    places = centre + rng.uniform(-1, 1, (n_people, 2)) * reach
    speed = rng.normal(0, 0.002, (n_people, 2)) * [1.0, 0.25]
    phase = rng.integers(0, 100, n_people)
    w, h = path.width, path.height
    with (
        av.open(str(clip), "w") as container,
        open(truth_path(clip), "w", newline="", encoding="ascii") as handle,
    ):
        stream = container.add_stream(
            "libx264", rate=Fraction(FPS), options={"crf": "23", "preset": "veryfast"}
        )
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = w, h, "yuv420p"
        truth = csv.DictWriter(handle, TRUTH_COLUMNS, lineterminator="\n")
        truth.writeheader()
        for index in range(path.n_frames):
            camera = path.camera(index)
            image = photograph.view(camera)
            for k in range(n_people if people else 0):
                lon, lat = places[k] + speed[k] * index
                ray = np.array([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)])
                foot = camera.ray_to_pixel(ray)
                if np.isfinite(foot).all() and (np.abs(foot) < 2 * w).all():
                    one = people[(phase[k] + index // 2) % len(people)]
                    paste(image, one, foot, 0.13 * h * camera.f_px / path.camera(0).f_px)
            image *= 1 + 0.05 * np.sin(index / 30)
            image += rng.normal(0, 2.0, (h, w, 1)).astype(np.float32)
            frame = av.VideoFrame.from_ndarray(np.clip(image + 0.5, 0, 255).astype(np.uint8), format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            container.mux(stream.encode(frame))
            truth.writerow(truth_row(camera, frame=index, pts_s=index / FPS, shot=0))
        container.mux(stream.encode(None))


def main() -> None:
    """Render, run, compare; print a Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sizes", nargs="+", default=["640x360"])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    folder = arguments.out or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    people_folder = next(iter(sorted(arguments.data.glob("*_mask"))), None)
    people = read_people(people_folder) if people_folder is not None else []
    config = Config.model_validate({"panorama": {"enabled": False}})
    print(
        "| photograph | seed | size | lens | frames with focal | focal error, median % | stated sigma % | corner px |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, place in PICTURES.items():
        photograph = read_photograph(arguments.data / place)
        for size_name in arguments.sizes:
            width, height = (int(v) for v in size_name.split("x"))
            for seed in arguments.seeds:
                path = path_of(photograph, seed, (width, height), arguments.frames)
                clip = folder / f"{place.rpartition('/')[2]}-{seed}-{size_name}.mp4"
                if not clip.exists():  # one that was broken off has another name
                    unfinished = clip.with_name(f"unfinished-{clip.name}")
                    write_photo_clip(unfinished, photograph, people, path, arguments.people)
                    truth_path(unfinished).replace(truth_path(clip))
                    unfinished.replace(clip)
                run = folder / f"run-{clip.stem}"
                process(clip, run, config)
                shots = compare_run(run, truth_path(clip))["shots"]
                known = [s for s in shots if s.get("focal_median") is not None]
                one = known[0] if known else {}
                cells = [
                    name, str(seed), size_name, "broadcast" if seed % 2 else "none",
                    f"{one.get('with_focal', 0)} of {path.n_frames}",
                    *(f"{100 * one[k]:.2f}" if k in one else "-" for k in ("focal_median", "focal_std_claimed")),
                    f"{one['corner_px']:.2f}" if one.get("corner_px") is not None else "-",
                ]  # fmt: skip
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
