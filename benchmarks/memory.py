"""Peak memory and processor time of a run against the clip's length: `python -m benchmarks.memory --seconds 5 30`.

One generator shot that ends where it begins is looped without decoding it, so that a longer clip is a longer shot of
the same scene (one long shot is the worst case: shots are let go of one by one). Each run is a process of its own.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import av

from pipelines.archive import read_run
from tests.synth.clip import ClipSpec, write_clip
from tests.synth.paths import PathSpec

FPS = 25
LOOP_FRAMES = 125


def make_loop(path: Path, width: int) -> Path:
    """Five seconds: pan there and back by 14 degrees, zoom in and out by 1.4; the last frame fits before the first."""
    spec = ClipSpec(
        seed=2,
        width=width,
        height=width * 9 // 16 // 2 * 2,
        n_frames=LOOP_FRAMES,
        path=PathSpec(pan_deg=14, zoom=1.4, there_and_back=True, jitter_px=0.1),
        player_share=0.05,
    )
    write_clip(path, spec)
    return path


def loop(source: Path, target: Path, times: int, n_frames: int = LOOP_FRAMES) -> Path:
    """The packets of `source`, a clip of n_frames, again and again, time stamps moved on."""
    with av.open(str(target), "w") as output:
        stream = None
        for turn in range(times):
            with av.open(str(source)) as container:
                video = container.streams.video[0]
                if stream is None:
                    stream = output.add_stream_from_template(video)
                assert video.time_base is not None
                shift = round(turn * n_frames / FPS / video.time_base)
                for packet in container.demux(video):
                    if packet.dts is None or packet.pts is None:
                        continue  # the flush at the end
                    packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                    packet.stream = stream
                    output.mux(packet)
    return target


def measure_run(clip: Path, out: Path, options: list[str]) -> tuple[float, float, float]:
    """Peak resident memory in MiB, wall and processor seconds of `broadcast-mosaic run`, as the system counted them."""
    command = [sys.executable, "-m", "pipelines.cli", "run", str(clip), "-o", str(out), "-q", *options]
    started = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    unit = 2**20 if sys.platform == "darwin" else 2**10  # ru_maxrss: bytes there, KiB elsewhere
    return usage.ru_maxrss / unit, time.perf_counter() - started, usage.ru_utime + usage.ru_stime


def main() -> None:
    """Print a line a length, then by how much the longest takes more than the shortest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=int, nargs="+", default=[5, 30], help="lengths, multiples of 5")
    parser.add_argument("--width", type=int, default=1280, help="px")
    parser.add_argument("options", nargs="*", help="settings for the runs, after --")
    args = parser.parse_args()
    peaks: dict[int, float] = {}
    print(
        f"{'seconds':>8} {'frames':>7} {'shots':>6} {'keyframes':>10} {'panorama px':>12} {'of frames':>10} "
        f"{'peak MiB':>9} {'frames/s':>9} {'CPU ms a frame':>15}"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = make_loop(folder / "loop.mp4", args.width)
        for seconds in sorted(args.seconds):
            turns = max(1, seconds * FPS // LOOP_FRAMES)
            clip = loop(source, folder / f"{seconds}.mp4", turns)
            out = folder / f"out-{seconds}"
            peak, wall_s, processor_s = measure_run(clip, out, args.options)
            record = read_run(out)
            frames = turns * LOOP_FRAMES
            keyframes = sum(len(shot.calibration["keyframes"]) for shot in record.shots)
            peaks[seconds] = peak
            panoramas = [
                shot.panorama for shot in record.shots if shot.panorama and "size_px" in shot.panorama
            ]
            sizes = " ".join("{}x{}".format(*panorama["size_px"]) for panorama in panoramas) or "-"
            used = sum(panorama["frames"] for panorama in panoramas)
            print(
                f"{seconds:8d} {frames:7d} {len(record.shots):6d} {keyframes:10d} {sizes:>12} {used:10d} {peak:9.0f} "
                f"{frames / wall_s:9.1f} {1e3 * processor_s / frames:15.1f}",
                flush=True,
            )
    shortest, longest = peaks[min(peaks)], peaks[max(peaks)]
    print(
        f"{max(peaks)} s against {min(peaks)} s: {longest - shortest:+.0f} MiB ({longest / shortest - 1:+.1%})"
    )


if __name__ == "__main__":
    main()
