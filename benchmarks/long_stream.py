"""An hour of programme in one run: `python -m benchmarks.long_stream --minutes 60 [--width 1920] [-- settings]`.

A minute of a match, six generator shots with cuts between them, is looped without decoding it. The run is a process of
its own, whose resident memory is looked at every few seconds; afterwards every shot is looked for: as many as were
cut, each with its frames, give or take one. Writes FOLDER/memory.csv and FOLDER/memory.svg.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from benchmarks.memory import loop
from pipelines.archive import read_run
from pipelines.records import RunRecord
from tests.synth.clip import ClipSpec, write_clip
from tests.synth.paths import BROADCAST_LENS, PathSpec

FPS = 25
SHOT_FRAMES = (250, 175, 375, 125, 300, 275)  # a minute
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def make_minute(path: Path, width: int) -> Path:
    """One match as it is cut: the main camera, and between its shots a closer one that stands elsewhere."""
    specs = []
    for k, n in enumerate(SHOT_FRAMES):
        close = k % 2 == 1
        path_spec = PathSpec(
            pan_deg=(8.0 if close else 16.0) + 2 * k, pan0_deg=(-14.0 if close else 6.0) + 3 * k,
            f0_per_width=2.2 if close else 1.2, zoom=1.2 + 0.12 * k, there_and_back=k % 3 == 0,
        )  # fmt: skip
        specs.append(
            ClipSpec(
                seed=700 + k, world_seed=700, width=width, height=width * 9 // 16 // 2 * 2, n_frames=n,
                lens=BROADCAST_LENS, path=path_spec, player_share=0.06,
                camera_moved_m=(6.0 + 2 * k, 3.0) if close else (0.0, 0.0),
            )
        )  # fmt: skip
    write_clip(path, specs)
    return path


def resident_mib(pid: int) -> float:
    """Resident memory of a process, MiB (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE_BYTES / 2**20


def watch(command: list[str], every_s: float, log: Path) -> tuple[list[tuple[float, float]], int]:
    """Run a command; (seconds, MiB) of its memory every few seconds, written as they come, and its exit code."""
    samples: list[tuple[float, float]] = []
    started = time.perf_counter()
    process = subprocess.Popen(command)
    with log.open("w", newline="", encoding="ascii") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(("seconds", "resident_mib"))
        while process.poll() is None:
            sample = (round(time.perf_counter() - started, 1), round(resident_mib(process.pid), 1))
            samples.append(sample)
            writer.writerow(sample)
            handle.flush()
            time.sleep(every_s)
    return samples, process.returncode


def accounted(record: RunRecord, minutes: int) -> list[str]:
    """What is wrong with the run's list of shots; empty: every shot of every minute is there, each with its frames."""
    wrong = []
    shots = [(shot.first_frame, shot.last_frame) for shot in record.shots]
    expected, first = [], 0
    for _ in range(minutes):
        for n in SHOT_FRAMES:
            expected.append((first, first + n - 1))
            first += n
    for a, b in expected:
        if not any(abs(a - c) <= 1 and abs(b - d) <= 1 for c, d in shots):
            wrong.append(f"no shot has the frames {a} to {b}")
    if len(shots) != len(expected):
        wrong.append(f"{len(shots)} shots, {len(expected)} were cut")
    return wrong


def draw(samples: list[tuple[float, float]]) -> str:
    """SVG: resident memory against minutes of the run."""
    width, height, left, bottom = 720, 300, 60, 45
    last = max(samples[-1][0], 60.0)
    top = max(mib for _, mib in samples) * 1.1
    text = 'font-family="sans-serif" font-size="11" fill="#333"'

    def place(seconds: float, mib: float) -> tuple[float, float]:
        return left + seconds / last * (width - left - 20), 15 + (1 - mib / top) * (height - bottom - 15)

    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
             f'<rect width="{width}" height="{height}" fill="white"/>']  # fmt: skip
    for mib in range(0, int(top), 200):
        x, y = place(0, mib)
        parts.append(f'<path d="M{x:.1f},{y:.1f}H{width - 20}" stroke="#ddd"/>'
                     f'<text x="{x - 6:.1f}" y="{y + 4:.1f}" text-anchor="end" {text}>{mib} MiB</text>')  # fmt: skip
    for minute in range(0, int(last // 60) + 1, 10 if last > 1200 else 1):
        x, y = place(60.0 * minute, 0)
        parts.append(f'<text x="{x:.1f}" y="{y + 16:.1f}" text-anchor="middle" {text}>{minute}</text>')
    line = " ".join("{:.1f},{:.1f}".format(*place(*sample)) for sample in samples)
    parts.append(f'<polyline points="{line}" fill="none" stroke="#2563eb" stroke-width="1"/>')
    parts.append(
        f'<text x="{width / 2}" y="{height - 8}" text-anchor="middle" {text}>minutes of the run</text></svg>'
    )
    return "".join(parts)


def main() -> None:
    """Make the stream, run it, say what its memory did and whether all shots are there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--width", type=int, default=1920, help="px")
    parser.add_argument("--folder", type=Path, default=Path("long-stream-out"))
    parser.add_argument("--every", type=float, default=5.0, help="seconds between two looks at the memory")
    parser.add_argument("options", nargs="*", help="settings for the run, after --")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    minute = args.folder / f"minute-{args.width}.mp4"
    if not minute.exists():
        make_minute(minute, args.width)
    clip = loop(minute, args.folder / "stream.mp4", args.minutes, sum(SHOT_FRAMES))
    out = args.folder / "out"
    command = [sys.executable, "-m", "pipelines.cli", "run", str(clip), "-o", str(out), "-q", *args.options]
    samples, code = watch(command, args.every, args.folder / "memory.csv")
    (args.folder / "memory.svg").write_text(draw(samples), encoding="utf-8")
    record = read_run(out)
    seconds = samples[-1][0]
    frames = args.minutes * sum(SHOT_FRAMES)
    print(f"exit {code}; {frames} frames in {seconds:.0f} s ({frames / seconds:.1f} a second)")
    for share in (0.1, 0.25, 0.5, 0.75, 1.0):
        so_far = [mib for s, mib in samples if s <= share * seconds]
        print(f"after {share:4.0%} of the time: largest so far {max(so_far):.0f} MiB, now {so_far[-1]:.0f}")
    wrong = accounted(record, args.minutes)
    print(f"{len(record.shots)} shots: {dict(Counter(shot.status for shot in record.shots))}")
    print("\n".join(wrong) or "every shot of every minute is there")
    sys.exit(1 if wrong or code else 0)


if __name__ == "__main__":
    main()
