"""The running calibrator against the batch result, its time a frame, its memory over a very long shot.

    python -m benchmarks.calib_running [--frames 100000] [--out docs/calibration-running.md]

Simulated tracks as in calibration.md 8.5 (W = 1920, principal point off by 13 px, k1(f) = -.03 + .02 log(f / W)); a new
keyframe when the picture's centre has moved by .15 W or the zoom changed by 15 %, edges to the last frame and to the
keyframe, and from a keyframe to the three before it and to older ones that show the same view. Times are processor
time of this process, so that other work on the machine does not count.
"""

from __future__ import annotations

import argparse
import platform
import resource
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import HomographyEdge, HomographyGraph, Lens, RunningCalibrator, refine, rotation
from tests.calib import tracks

Array = NDArray[np.float64]
SIZE = (1920, 1080)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A line of calibration.md 8.5. gap: frames without any edge; back: the camera returns to where it began.

    f_px: at the start; at 4400 and 130 degrees there are more keyframes than the window of 24 holds.
    """

    name: str
    pan_deg: float
    zoom: float
    noise_px: float = 0.1
    smooth_px: float = 0.0
    outliers: float = 0.0
    n: int = 300
    gap: int = 0
    back: bool = False
    seed: int = 0
    f_px: float = 2200.0


CASES = (
    Case(name="pan 20, zoom 2, sigma .1", pan_deg=20, zoom=2),
    Case(name="the same, another seed", pan_deg=20, zoom=2, seed=1),
    Case(name="the same, sigma .3", pan_deg=20, zoom=2, noise_px=0.3),
    Case(name="the same, 5 % outliers of 8 px", pan_deg=20, zoom=2, outliers=0.05),
    Case(name="pan 8, zoom 1.3", pan_deg=8, zoom=1.3),
    Case(name="pan 40, no zoom", pan_deg=40, zoom=1),
    Case(name="pan 20, zoom 2, correlated .1 px", pan_deg=20, zoom=2, smooth_px=0.1),
    Case(name="pan 10, zoom 1.5, correlated .1 px", pan_deg=10, zoom=1.5, smooth_px=0.1),
    Case(name="800 frames, pan 60", pan_deg=60, zoom=1.3, n=800),
    Case(name="1200 frames, pan 130 at f 4400", pan_deg=130, zoom=1.2, n=1200, f_px=4400.0),
    Case(name="there and back, loops", pan_deg=30, zoom=1.5, n=400, back=True),
    Case(name="a gap of 8 frames", pan_deg=20, zoom=2, gap=8),
)


def camera_path(case: Case) -> tracks.Truth:
    """The true cameras of a case."""
    t = np.linspace(0, 1, case.n)
    s = 0.5 * (1 - np.cos(2 * np.pi * t)) if case.back else t
    pan, tilt = np.deg2rad(case.pan_deg) * s, np.deg2rad(-8 + 2 * np.sin(5 * s))
    log_f = np.log(case.f_px) + np.log(case.zoom) * 0.5 * (1 - np.cos(np.pi * s))
    R = rotation.from_pan_tilt_roll(pan, tilt, np.zeros(case.n))
    lens = Lens(size_px=SIZE, pp_px=(np.array(SIZE) - 1) / 2 + (5, -12), c0=-0.03, c1=0.02)
    return tracks.Truth(frames=np.arange(case.n), log_f=log_f, R=R @ R[0].T, lens=lens)


def moved(truth: tracks.Truth, a: int, b: int) -> bool:
    """Whether b needs a keyframe of its own after keyframe a."""
    centre = (np.array(SIZE, float)[None] - 1) / 2
    there = tracks.project(truth, a, b, centre)
    shift = float(np.linalg.norm(there - centre)) if np.isfinite(there).all() else np.inf
    return shift > 0.15 * SIZE[0] or abs(truth.log_f[b] - truth.log_f[a]) > np.log(1.15)


@dataclass(slots=True)
class Outcome:
    """What one run left behind."""

    truth: tracks.Truth
    calibrator: RunningCalibrator
    last: float
    last_sigma: float
    graph: HomographyGraph
    update_s: list[float] = field(default_factory=list)
    keyframe_s: list[float] = field(default_factory=list)


def measured(
    rng: np.random.Generator, truth: tracks.Truth, a: int, b: int, case: Case
) -> HomographyEdge | None:
    """An edge with the case's errors; an outlier moves a third of the cells by 8 px."""
    e = tracks.edge(rng, truth, a, b, noise_px=case.noise_px, smooth_px=case.smooth_px)
    if e is not None and rng.uniform() < case.outliers:
        wrong = rng.uniform(size=len(e.grid_a)) < 0.33
        e = replace(e, grid_b=e.grid_b + wrong[:, None] * np.array([8.0, -3.0]))
    return e


def run(case: Case) -> Outcome:
    """The whole shot through the calibrator."""
    rng = np.random.default_rng([85, case.seed, case.n])
    truth, cal = camera_path(case), RunningCalibrator(SIZE)
    keys: list[int] = []
    edges: list[HomographyEdge] = []
    update_s: list[float] = []
    keyframe_s: list[float] = []
    last, last_sigma = np.nan, np.nan
    for t in range(case.n):
        if case.gap and case.n // 2 <= t < case.n // 2 + case.gap:
            continue
        new_key = not keys or moved(truth, keys[-1], t)
        pairs = keys[-3:] if new_key else [keys[-1], t - 1]
        if new_key and case.back:
            near = [k for k in keys[:-3] if not moved(truth, k, t)]
            pairs = [*pairs, *near[-2:]]
        found = [measured(rng, truth, a, t, case) for a in dict.fromkeys(pairs)]
        links = [e for e in found if e is not None]
        begin = time.process_time()
        estimate = cal.add_keyframe(t, links) if new_key else cal.update(t, links)
        (keyframe_s if new_key else update_s).append(time.process_time() - begin)
        if new_key:
            keys.append(t)
            edges += links
        last, last_sigma = estimate.log_f, estimate.sigma_log_f
    graph = HomographyGraph(frames=np.array(keys), edges=tuple(edges), size_px=SIZE)
    return Outcome(truth, cal, last, last_sigma, graph, update_s, keyframe_s)


def case_line(case: Case) -> str:
    """One row of the table."""
    found = run(case)
    batch = refine(found.graph)
    k = int(found.graph.frames[-1])
    pose = found.calibrator.pose(k)
    assert pose is not None
    difference = pose[0] - batch.log_f[-1]
    sigma = float(batch.sigma_log_f[-1])
    errors = 100 * (pose[0] - found.truth.log_f[k]), 100 * (batch.log_f[-1] - found.truth.log_f[k])
    met = abs(difference) <= 1e-3 and abs(difference) <= sigma
    print(case.name, flush=True)
    return (
        f"| {case.name} | {len(found.graph.frames)} | {errors[0]:.3f} / {errors[1]:.3f} | {100 * difference:.3f} "
        f"| {abs(difference) / sigma:.2f} | {'met' if met else 'MISSED'} | {1e3 * np.median(found.update_s):.1f} / "
        f"{1e3 * np.percentile(found.update_s, 95):.1f} | {1e3 * np.median(found.keyframe_s):.0f} |"
    )


def long_lines(n: int) -> list[str]:
    """A shot of n frames that wanders for ever: time and memory by its parts."""
    rng = np.random.default_rng(3)
    t = np.arange(n)
    pan = np.deg2rad(25 * np.sin(t / 300.0) + 8 * np.sin(t / 97.0))
    tilt = np.deg2rad(-8 + 3 * np.sin(t / 211.0))
    log_f = np.log(2300) + 0.25 * np.sin(t / 400.0)
    R = rotation.from_pan_tilt_roll(pan, tilt, np.zeros(n))
    lens = Lens(size_px=SIZE, pp_px=(np.array(SIZE) - 1) / 2 + (5, -12), c0=-0.03, c1=0.02)
    truth = tracks.Truth(frames=t, log_f=log_f, R=R @ R[0].T, lens=lens)
    cal, last_key, lines = RunningCalibrator(SIZE), -1, []
    update_s: list[float] = []
    keyframe_s: list[float] = []
    for k in range(n):
        new_key = last_key < 0 or moved(truth, last_key, k)
        pairs = list(cal.keyframes[-3:]) if new_key else [last_key, k - 1]
        links = [e for e in (tracks.edge(rng, truth, a, k) for a in dict.fromkeys(pairs)) if e is not None]
        begin = time.process_time()
        estimate = cal.add_keyframe(k, links) if new_key else cal.update(k, links)
        (keyframe_s if new_key else update_s).append(time.process_time() - begin)
        last_key = k if new_key else last_key
        if (k + 1) % max(n // 10, 1) == 0:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            error = 100 * (estimate.log_f - truth.log_f[k])
            lines.append(
                f"| {k + 1} | {len(cal.keyframes)} | {1e3 * np.median(update_s):.2f} | "
                f"{1e3 * np.percentile(update_s, 95):.2f} | {1e3 * np.median(keyframe_s):.0f} | "
                f"{1e3 * (sum(update_s) + sum(keyframe_s)) / (len(update_s) + len(keyframe_s)):.2f} | {peak:.0f} | "
                f"{error:.2f} |"
            )
            print(lines[-1], flush=True)
            update_s, keyframe_s = [], []
    return lines


def main() -> None:
    """Run the cases and the long shot, write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("docs/calibration-running.md"))
    arguments = parser.parse_args()
    lines = [
        "# The running calibrator", "",
        "Made by `python -m benchmarks.calib_running` "
        f"(numpy {np.__version__}, Python {platform.python_version()}). Processor time, one core.", "",
        "## At the end of the shot, against the batch result", "",
        "Asked: within .1 % and one (statistical) sigma of the batch; 5 ms median a frame.", "",
        "| case | keyframes | error of the last f, running / batch, % | running - batch, % | in sigma | | ms a frame, "
        "median / 95 % | ms a keyframe |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [case_line(case) for case in CASES]
    lines += ["", f"## {arguments.frames} frames", "",
              "| up to frame | keyframes kept | ms a frame, median | 95 % | ms a keyframe | mean of all | peak memory "
              "MB | error of f % |", "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    lines += long_lines(arguments.frames)
    arguments.out.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
