"""Time of the batch refinement against the number of frames, beside scipy.optimize.least_squares on the same problem.

    python -m benchmarks.calib_speed [--frames 250 500 ... 20000] [--out docs/calibration-speed.md]

A camera that pans, tilts and zooms for ever; four edges a frame (the two frames before, the keyframe, the keyframe
before it), 40 cells an edge, .1 px noise. Start: 2 % off in focal length, .1 degrees in every angle. Processor time of
one core, so that other work on the machine does not count. Writes a table and a plot.
"""

from __future__ import annotations

import argparse
import platform
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
import scipy.optimize
import scipy.sparse as sp
from numpy.typing import NDArray

from calib import HomographyEdge, HomographyGraph, Lens, Priors, Solution, refine, rotation
from calib.camera import transfer
from calib.problem import Packed, PriorTerms, State, pack, residuals
from calib.refine import nothing
from tests.calib.tracks import grid

Array = NDArray[np.float64]
SIZE = (1280, 720)
KEYFRAME_STEP = 25
NOISE_PX = 0.1


def make(n: int) -> tuple[HomographyGraph, Array, Array, Lens]:
    """A graph of n frames and its true log f (n,), R (n, 3, 3), lens."""
    rng = np.random.default_rng(n)
    t = np.arange(n)
    pan, tilt = np.deg2rad(22 * np.sin(t / 170.0)), np.deg2rad(-8 + 3 * np.sin(t / 90.0))
    log_f = np.log(1.4 * SIZE[0]) + 0.3 * np.sin(t / 260.0)
    R = rotation.from_pan_tilt_roll(pan, tilt, np.deg2rad(0.1 * rng.standard_normal(n)))
    R = R @ R[0].T
    lens = Lens(size_px=SIZE, pp_px=(np.array(SIZE) - 1) / 2 + (4, -9), c0=0.03, c1=-0.01)
    key = t // KEYFRAME_STEP * KEYFRAME_STEP
    pairs = np.concatenate([np.stack([t - 1, t], 1), np.stack([t - 2, t], 1), np.stack([key, t], 1),
                            np.stack([key - KEYFRAME_STEP, t], 1)])  # fmt: skip
    pairs = np.unique(pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < pairs[:, 1])], axis=0)
    shared = np.array([*lens.pp_px, 0.0, lens.c0, lens.c1])
    points, edges, info = grid(SIZE), [], np.eye(2) / NOISE_PX**2
    for part in np.array_split(pairs, max(1, len(pairs) // 500)):
        a, b = part.T
        x, y = (np.broadcast_to(points[:, k], (len(part), len(points))) for k in (0, 1))
        seen = transfer(x, y, log_f[a], log_f[b], R[b] @ np.swapaxes(R[a], 1, 2),
                        np.broadcast_to(shared, (len(part), 5)), SIZE[0], jacobian=False)  # fmt: skip
        landed = np.stack([seen.x, seen.y], -1)
        inside: NDArray[np.bool_] = np.asarray(((landed >= 0) & (landed <= np.array(SIZE) - 1)).all(-1))
        noisy = landed + NOISE_PX * rng.standard_normal(landed.shape)
        for k, (i, j) in enumerate(part.tolist()):
            if inside[k].sum() >= 10:
                m = int(inside[k].sum())
                edges.append(
                    HomographyEdge(
                        a=i, b=j, H=np.full((3, 3), np.nan), grid_a=points[inside[k]], grid_b=noisy[k][inside[k]],
                        info=np.broadcast_to(info, (m, 2, 2)),
                    )
                )  # fmt: skip
    return HomographyGraph(frames=t, edges=tuple(edges), size_px=SIZE), log_f, R, lens


def start_of(graph: HomographyGraph, log_f: Array, R: Array) -> Solution:
    """A start as a first pass leaves it: 2 % in the common focal, .2 % and .1 degrees a frame, no distortion."""
    rng = np.random.default_rng(1)
    n = len(log_f)
    empty = nothing(graph, Priors(), 0, "start")
    return replace(
        empty, log_f=log_f + 0.02 + 0.002 * rng.standard_normal(n),
        R=rotation.exp(np.deg2rad(0.1) * rng.standard_normal((n, 3))) @ R,
    )  # fmt: skip


class ForScipy:
    """Residuals and sparse Jacobian as least_squares wants them: the same cells, model, priors and derivatives."""

    def __init__(self, packed: Packed, start: Solution, terms: PriorTerms) -> None:
        self.packed, self.terms, self.R0 = packed, terms, start.R
        n = packed.n_frames
        self.n = n
        self.free = np.flatnonzero(terms.free)
        self.active = np.concatenate([np.setdiff1d(np.arange(4 * n), (1, 2, 3)), 4 * n + self.free])
        self.x0 = np.concatenate([np.column_stack([start.log_f, np.zeros((n, 3))]).ravel(), terms.mean])
        E, m = packed.dof.shape
        self.known = np.repeat((packed.dof > 0)[:, None], 2, 1).reshape(E, 2 * m)
        a, b = 4 * packed.ia[:, None] + np.arange(4), 4 * packed.ib[:, None] + np.arange(4)
        self.columns = np.concatenate([a, b, np.broadcast_to(4 * n + np.arange(5), (E, 5))], 1)

    def state(self, x: Array) -> State:
        """The cameras of the active unknowns x."""
        full = self.x0.copy()
        full[self.active] = x
        frames = full[: 4 * self.n].reshape(-1, 4)
        return State(
            frames[None, :, 0], (rotation.exp(frames[:, 1:]) @ self.R0)[None], full[None, 4 * self.n :]
        )

    def value(self, x: Array) -> Array:
        """Whitened residuals, then the priors'."""
        state = self.state(x)
        rx, ry, _ = residuals(self.packed, state)
        e = np.stack([rx[0], ry[0]], 1).reshape(self.known.shape) / NOISE_PX
        prior = (state.shared[0, self.free] - self.terms.mean[self.free]) / self.terms.std[self.free]
        mean = (state.log_f.mean() - self.terms.mean_log_f) * np.sqrt(self.terms.mean_precision)
        return np.concatenate([-e[self.known], prior, [mean]])

    def jacobian(self, x: Array) -> sp.csr_array:
        """Its derivatives; rotations about the start, so exact only while the turn is small (.1 degrees)."""
        _, _, J = residuals(self.packed, self.state(x), jacobian=True)
        E, _, two, m = J.shape[1:]
        values = np.moveaxis(J[0], 1, 3).reshape(E, two * m, 13) / NOISE_PX
        rows = np.cumsum(self.known.ravel()) - 1
        keep = self.known.ravel()
        row = np.repeat(rows[keep], 13)
        col = np.repeat(self.columns, two * m, 0).reshape(-1, 13)[keep].ravel()
        data = values.reshape(-1, 13)[keep].ravel()
        n_data, k = int(keep.sum()), len(self.free)
        row = np.concatenate([row, n_data + np.arange(k), np.full(self.n, n_data + k)])
        col = np.concatenate([col, 4 * self.n + self.free, 4 * np.arange(self.n)])
        data = np.concatenate([data, 1 / self.terms.std[self.free],
                               np.full(self.n, np.sqrt(self.terms.mean_precision) / self.n)])  # fmt: skip
        full = sp.csr_array((data, (row, col)), shape=(n_data + k + 1, 4 * self.n + 5))
        return full[:, self.active]


def by_scipy(graph: HomographyGraph, start: Solution) -> tuple[float, float, int, str]:
    """Seconds, cost, evaluations and message of least_squares (trf, lsmr, sparse closed-form Jacobian, no loss)."""
    packed = pack(graph)
    terms = PriorTerms(Priors(), SIZE, graph.frames, np.array([True, True, False, True, True]))
    problem = ForScipy(packed, start, terms)
    begin = time.process_time()
    found = scipy.optimize.least_squares(
        problem.value, problem.x0[problem.active], jac=problem.jacobian, method="trf", tr_solver="lsmr", x_scale="jac",
        max_nfev=60, ftol=1e-10, xtol=1e-10, gtol=1e-10,
    )  # fmt: skip
    return time.process_time() - begin, float(2 * found.cost), int(found.nfev), str(found.message)


def plot(rows: list[tuple[int, float]], theirs: list[tuple[int, float]]) -> str:
    """Seconds against frames, both logarithmic, as SVG text."""
    width, height, left, bottom = 520, 340, 60, 50
    low, high = np.log10([200, 0.1]), np.log10([30_000, 200])

    def place(n: float, s: float) -> tuple[float, float]:
        u = (np.log10([n, s]) - low) / (high - low)
        return left + u[0] * (width - left - 20), 20 + (1 - u[1]) * (height - bottom - 20)

    text = 'font-family="sans-serif" font-size="11" fill="#333"'
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
             f'<rect width="{width}" height="{height}" fill="white"/>']  # fmt: skip
    for s in (0.1, 1, 10, 100):
        x, y = place(200, s)
        parts.append(f'<path d="M{x:.1f},{y:.1f}H{width - 20}" stroke="#ddd"/>'
                     f'<text x="{x - 6:.1f}" y="{y + 4:.1f}" text-anchor="end" {text}>{s:g} s</text>')  # fmt: skip
    for n in (250, 1000, 5000, 20_000):
        x, y = place(n, 0.1)
        parts.append(f'<text x="{x:.1f}" y="{y + 16:.1f}" text-anchor="middle" {text}>{n}</text>')
    for values, colour, name in (
        (rows, "#2563eb", "calib.refine"),
        (theirs, "#dc2626", "scipy least_squares"),
    ):
        if not values:
            continue
        points = [place(*value) for value in values]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in points]
        parts.append(f'<text x="{points[-1][0] - 8:.1f}" y="{points[-1][1] - 8:.1f}" text-anchor="end" '
                     f'font-family="sans-serif" font-size="12" fill="{colour}">{name}</text>')  # fmt: skip
    parts.append(f'<text x="{width / 2}" y="{height - 10}" text-anchor="middle" {text}>frames</text></svg>')
    return "".join(parts)


def main() -> None:
    """Time the sizes, write table and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[250, 500, 1000, 2500, 5000, 10_000, 20_000])
    parser.add_argument("--scipy-frames", type=int, default=1000, help="largest size given to scipy")
    parser.add_argument("--out", type=Path, default=Path("docs/calibration-speed.md"))
    arguments = parser.parse_args()
    lines = [
        "# Speed of the batch refinement", "",
        "Made by `python -m benchmarks.calib_speed` "
        f"(numpy {np.__version__}, scipy {scipy.__version__}, Python {platform.python_version()}). Processor time on "
        "one core of a machine that others used too.", "",
        "Four edges a frame, 40 cells an edge; error bars of every frame included. scipy: `least_squares` (trf, lsmr) "
        "with the same residuals and closed-form sparse Jacobian, without robust loss and without error bars.", "",
        "| frames | edges | s | ms a frame | steps | error of mean f % | stated % | peak memory MB | scipy s | "
        "scipy cost / ours | evaluations |", "|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    mine: list[tuple[int, float]] = []
    theirs: list[tuple[int, float]] = []
    for n in arguments.frames:
        graph, log_f, R, _ = make(n)
        start = start_of(graph, log_f, R)
        begin = time.process_time()
        found = refine(graph, start=start)
        seconds = time.process_time() - begin
        mine.append((n, seconds))
        error = 100 * float(np.mean(found.log_f - log_f))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        other = "- | - | -"
        if n <= arguments.scipy_frames:
            s, cost, calls, message = by_scipy(graph, start)
            theirs.append((n, s))
            other = f"{s:.1f} | {cost / found.cost:.4f} | {calls}{'' if 'satisfied' in message else ' (not done)'}"
        lines.append(
            f"| {n} | {len(graph.edges)} | {seconds:.2f} | {1e3 * seconds / n:.2f} | {found.n_steps} | {error:.3f} "
            f"| {100 * found.sigma_mean_log_f:.3f} | {peak:.0f} | {other} |"
        )
        print(lines[-1], flush=True)
        del graph, start, found
    figure = arguments.out.parent / "images" / "calibration-speed.svg"
    figure.parent.mkdir(parents=True, exist_ok=True)
    figure.write_text(plot(mine, theirs), encoding="utf-8")
    lines += ["", "![Seconds against frames](images/calibration-speed.svg)", ""]
    arguments.out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
