"""What a second distortion coefficient, a drifting principal point or straight lines do to the focal length.

    python -m benchmarks.calib_wide_lens [--tracks 24] [--out docs/calibration-wide-lens.md]

Tracks without pictures (tests/calib/tracks.py), .1 px independent and .1 px smooth noise an edge. One core, minutes.
"""

from __future__ import annotations

import argparse
import platform
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.calib_broadcast import realistic
from calib import HomographyGraph, Priors, StraightLine, fit_lines, judge, refine
from tests.calib import tracks

Array = NDArray[np.float64]
WIDTH = 1280
USUAL = Priors()
WIDE = Priors(k2_std=0.02, pp_drift_std=20 / WIDTH)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A lens: k2 (half widths), drift px per unit of log f (x, y); what the camera does."""

    name: str
    k2: float = 0.0
    drift_px: tuple[float, float] = (0.0, 0.0)
    f_w: float = 0.8
    zoom: float = 1.3
    pan_deg: float = 30.0


CASES = (
    Case(name="k2 -.03, f .8 to 1.04 W, pan 30", k2=-0.03),
    Case(name="k2 -.01", k2=-0.01),
    Case(name="k2 .03", k2=0.03),
    Case(
        name="drift (10, -10) px, f 1.2 to 2.4 W, pan 25", drift_px=(10, -10), f_w=1.2, zoom=2.0, pan_deg=25
    ),
    Case(name="drift (30, -30) px", drift_px=(30, -30), f_w=1.2, zoom=2.0, pan_deg=25),
    Case(name="k2 -.02, drift (15, -15) px, f .8 to 1.4 W, pan 30", k2=-0.02, drift_px=(15, -15), zoom=1.75),
    Case(name="neither, f .8 to 1.04 W, pan 30"),
    Case(name="neither, f 1.2 to 2.4 W, pan 25", f_w=1.2, zoom=2.0, pan_deg=25),
)


def make(case: Case, seed: int) -> tuple[tracks.Truth, HomographyGraph]:
    """A track of ten keyframes and its graph."""
    rng = np.random.default_rng([21, seed])
    truth = tracks.path(rng, 10, pan_deg=case.pan_deg, f_w=case.f_w, zoom=case.zoom)
    lens = replace(
        truth.lens, k2=case.k2, pp_drift_px=np.array(case.drift_px), pp_log_f=float(truth.log_f.mean())
    )
    truth = replace(truth, lens=lens)
    return truth, tracks.graph(rng, truth, max_span=3, smooth_px=0.1)


def line(case: Case, name: str, priors: Priors, n_tracks: int) -> str:
    """A row of the table: errors in per cent, and how often the error bars hold."""
    found = []
    for seed in range(n_tracks):
        truth, graph = make(case, seed)
        solution = refine(graph, priors=priors)
        error = float(np.nanmean(solution.log_f - truth.log_f))
        zoom = float(np.nanstd(solution.log_f - truth.log_f))
        verdict = judge(solution, graph)
        found.append(
            (
                error,
                solution.sigma_mean_log_f,
                zoom,
                solution.chi2_dof,
                verdict.sigma_log_f_total,
                verdict.claims_focal,
            )
        )
    error, sigma, zoom, chi2, total, claims = np.array(found, float).T

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return (
        f"| {case.name} | {name} | {100 * rms(error):.2f} | {100 * rms(sigma):.2f} "
        f"| {100 * np.mean(np.abs(error) < sigma):.0f} / {100 * np.mean(np.abs(error) < 1.96 * sigma):.0f} "
        f"| {100 * rms(total):.2f} | {100 * np.mean(np.abs(error) < 2 * total):.0f} | {100 * rms(zoom):.3f} "
        f"| {np.mean(chi2):.1f} | {int(claims.sum())} |"
    )


def line_seen(
    rng: np.random.Generator, truth: tracks.Truth, row: int, ends: tuple[tuple[float, float], tuple[float, float]],
    noise_px: float,
) -> StraightLine:  # fmt: skip
    """25 points of a line between two ideal pixels, as a frame of a track shows it."""
    raw = truth.lens.distort(np.linspace(*ends, 25), truth.log_f[row])
    raw = raw + noise_px * rng.standard_normal(raw.shape)
    return StraightLine(frame=int(truth.frames[row]), points_px=raw, sigma_px=noise_px)


def straight_lines(n_tracks: int, noise_px: float = 0.3) -> list[str]:
    """Three lines across the picture, on realistic tracks and on tracks without anything shared by the edges."""
    lines = [
        "## Straight lines", "",
        "`fit_lines(graph, lines)` calibrates with lines of which only that they are straight is known: 25 points "
        f"each, {noise_px:g} px, one across the upper and two across the lower part of three frames. They weigh "
        "against the edges as the edges' total error over their formal one says, since what edges share does not "
        "average out.", "",
        "| tracks | | error % | statistical sigma | total sigma | within two total % | claimed |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, draw in (
        ("realistic (calibration-broadcast.md): pupil .6 m before the axis, LED boards", realistic),
        ("nothing shared", lambda seed: make(Case(name="", f_w=1.6, zoom=1.2, pan_deg=12), seed)),
    ):
        found: dict[str, list[tuple[float, float, float, float]]] = {"without lines": [], "three lines": []}
        for seed in range(n_tracks):
            truth, graph = draw(seed)
            rng, n = np.random.default_rng([22, seed]), len(truth.frames)
            seen = [
                line_seen(rng, truth, row, ((30, y), (1250, y + 50)), noise_px)
                for row, y in ((1, 120), (n // 2, 560), (n - 2, 600))
            ]
            for model, solution in (
                ("without lines", refine(graph)),
                ("three lines", fit_lines(graph, seen)),
            ):
                verdict, error = judge(solution, graph), float(np.nanmean(solution.log_f - truth.log_f))
                total = verdict.sigma_log_f_total
                found[model].append((error, solution.sigma_mean_log_f, total, float(verdict.claims_focal)))
        for model, values in found.items():
            error, sigma, total, claims = np.array(values).T
            rms = [100 * float(np.sqrt(np.mean(v**2))) for v in (error, sigma, total)]
            lines.append(
                f"| {name} | {model} | {rms[0]:.2f} | {rms[1]:.2f} | {rms[2]:.2f} "
                f"| {100 * np.mean(np.abs(error) < 2 * total):.0f} | {int(claims.sum())} of {n_tracks} |"
            )
            print(lines[-1], flush=True)
    return [*lines, ""]


def main() -> None:
    """Run the cases and write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracks", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("docs/calibration-wide-lens.md"))
    a = parser.parse_args()
    lines = [
        "# The wider lens", "",
        "`calib` calibrates a shot with one coefficient of distortion, k1_half(f) = c0 + c1 log(f / W), and a fixed "
        "principal point. Priors free more: `Priors(k2_std=.02)` a second coefficient, of the fourth power of the "
        "radius in half widths and the same at every focal; `Priors(pp_drift_std=10 / 1920)` a principal point that "
        "moves with the zoom, pp(f) = p0 + p1 (log f - mean). Both are off unless asked for. `refine`, `solve_poses`, "
        "`judge`, `fit_pupil`, the running calibrator and the lens profile (k2 only) know them; `run` does not offer "
        "them: camera.csv and most exports have one coefficient, and what a k2 left out does there is pixels.", "",
        "When to free them: where `solution.cost` falls by more than about 20 times the edges' mean `edge_kappa`. "
        "Where the lens has neither, they cost a wider error bar and nothing else (last rows).", "",
        f"Made by `python -m benchmarks.calib_wide_lens` (numpy {np.__version__}, Python "
        f"{platform.python_version()}): "
        f"{a.tracks} tracks of ten keyframes a line, W = {WIDTH}, .1 px independent and .1 px smooth noise an edge. "
        "Errors and sigmas of the mean log f in %, rms over the tracks; covered: by one and by 1.96 statistical sigma; "
        "relative zoom: rms in a track.", "",
        "| the lens and the shot | model | error | statistical sigma | covered % | total sigma | within two total % | "
        "relative zoom | chi2 / dof | claimed |", "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for case in CASES:
        for name, priors in (("usual", USUAL), ("wider", WIDE)):
            lines.append(line(case, name, priors, a.tracks))
            print(lines[-1], flush=True)
    a.out.write_text("\n".join([*lines, "", *straight_lines(a.tracks)]), encoding="utf-8")


if __name__ == "__main__":
    main()
