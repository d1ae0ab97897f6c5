"""How often `register` is wrong, and how often it says so: many small pairs with drawn degradations, no peers.

    python -m benchmarks.registration.campaign run --work FOLDER [--photographs DATA] [--seeds 1001 1002] [--pairs 5000]
    python -m benchmarks.registration.campaign table --work FOLDER [--seeds 1001]

A seed is a scene of each kind (three painted grounds, three photographs), 640x360, under every degradation with a
strength drawn from the seed; pairs 1 to 60 frames apart from several first frames of the same move, so pairs of a scene
are not independent. `run` appends a line of FOLDER/campaign.jsonl a pair and skips what is there.

Wrong is a corner error (rms over four corners) over 2 px of the 640, or no answer. Undetected is wrong and called
`ok`; wrong and called `weak` is counted beside it: a weak pair is an answer with a warning.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.registration.scenes import (
    FIRST,
    GAPS,
    KINDS,
    PHOTOGRAPHS,
    Condition,
    Scene,
    corner_error_px,
    encoded,
    picture,
    scene_of,
    true_homography,
)
from mosaic import register
from mosaic.coords import transfer
from mosaic.records import PairFit, PairStatus

SIZE = "360p"
FIRSTS = (FIRST - 15, FIRST, FIRST + 15)
WRONG_PX = 2.0
AVOIDABLE_OVERLAP = 0.4  # the issue's: with more of it in both pictures, a failure could be avoided


def degradations(seed: int) -> dict[str, Condition]:
    """The degradations by name, their strengths drawn; those that share a world of players follow each other."""
    rng = np.random.default_rng([seed, 4010])
    stretch = float(np.exp(rng.uniform(np.log(0.7), np.log(1.4))))
    return {
        "clean": Condition(),
        "players 10 %": Condition(players=0.10),
        "overlay": Condition(players=0.10, overlay=True),
        "gain .7 to 1.4": Condition(players=0.10, gain=stretch),
        "noise 2 to 6": Condition(players=0.10, noise_grey=float(rng.uniform(2, 6))),
        "blur 2 to 12 px": Condition(players=0.10, blur_px=float(rng.uniform(2, 12))),
        "CRF 23 to 35": Condition(players=0.10, codec=(("crf", str(int(rng.integers(23, 36)))),)),
        "several": Condition(
            players=0.10, overlay=bool(rng.integers(2)), gain=float(np.exp(rng.uniform(-0.35, 0.35))),
            noise_grey=float(rng.uniform(2, 6)), blur_px=float(rng.uniform(0, 8)),
        ),
        "players 25 %": Condition(players=0.25),
        "players 40 %": Condition(players=0.40),
        "hoardings": Condition(players=0.10, hoardings=True),
    }  # fmt: skip


class Remembered:
    """A scene whose drawn frames are kept, since most degradations share them (0.9 MB a frame)."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self.seed, self.size_px = scene, scene.seed, scene.size_px
        self.camera = scene.camera
        self._drawn: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def draw(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Copies: light and noise are added in place."""
        if index not in self._drawn:
            self._drawn[index] = self._scene.draw(index)
        image, cover = self._drawn[index]
        return image.copy(), cover.copy()


def _gray_frames(scene: Scene, condition: Condition) -> Callable[[int, bool], tuple[Any, Any]]:
    """(gray, usable pixels or None) of a frame as first or second picture of a pair, each made once."""
    made: dict[tuple[int, bool], tuple[np.ndarray, np.ndarray | None]] = {}
    if condition.codec is not None:
        wanted = sorted({f + g for f in FIRSTS for g in (0, *GAPS)})
        for index, (gray, _, usable) in encoded(scene, condition, wanted).items():
            made[index, False] = made[index, True] = gray, usable

    def frame(index: int, second: bool) -> tuple[np.ndarray, np.ndarray | None]:
        if (index, second) not in made:
            image, _, usable = picture(scene, index, condition, second)
            made[index, second] = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), usable
        return made[index, second]

    return frame


def overlap_of(H_b_a: np.ndarray, size_px: tuple[int, int]) -> float:
    """Share of a's picture that b shows, truly."""
    w, h = size_px
    x, y = np.meshgrid(np.linspace(0, w - 1, 64), np.linspace(0, h - 1, 36))
    at = transfer(H_b_a, np.stack([x.ravel(), y.ravel()], axis=-1))
    with np.errstate(invalid="ignore"):
        return float(np.mean((at >= 0).all(axis=1) & (at[:, 0] <= w - 1) & (at[:, 1] <= h - 1)))


def answer(fit: PairFit, truth: np.ndarray, size_px: tuple[int, int]) -> dict[str, Any]:
    """What is kept of a fit: its error, what it says of itself, and d' info d / 8 over its anchors."""
    kept: dict[str, Any] = {
        "status": str(fit.status), "reason": fit.reason, "route": fit.route, "score": fit.score,
        "overlap_seen": fit.overlap, "rms_grey": fit.rms_grey, "gain": fit.gain, "n_cells": len(fit.flow.cell),
    }  # fmt: skip
    if not fit.usable:
        return {**kept, "error_px": None}
    d = (transfer(fit.H_dst_src, fit.anchors_px) - transfer(truth, fit.anchors_px)).ravel()
    away = np.linalg.norm(fit.flow.dst_px - transfer(fit.H_dst_src, fit.flow.src_px), axis=1)
    known = np.linalg.cond(fit.info) < 1e12
    return {
        **kept,
        "error_px": corner_error_px(fit.H_dst_src, truth, size_px),
        "chi2": float(d @ fit.info @ d) / 8 if known else None,
        "std_px": float(np.sqrt(np.trace(np.linalg.inv(fit.info)) / 8)) if known else None,
        "away_px": [float(v) for v in np.quantile(away, [0.5, 0.7, 0.85])] if len(away) else None,
        "cells": fit.flow.cell.tolist(),
        "cell_weight": float(np.mean(fit.flow.weight)) if len(away) else None,
        "H": fit.H_dst_src.ravel().tolist(),
    }


def rows_of_scene(kind: str, seed: int, data: Path | None, done: set[str]) -> Iterator[dict[str, Any]]:
    """A row a pair that is not done."""
    worlds: dict[tuple[float, bool], Scene] = {}
    for name, condition in degradations(seed).items():
        if condition.hoardings and kind in PHOTOGRAPHS:
            continue
        keys = {(f, g): f"{kind}-{seed}-{name}-{f}-{g}" for f in FIRSTS for g in GAPS}
        if done.issuperset(keys.values()):
            continue
        world = (condition.players, condition.hoardings)
        if world not in worlds:
            worlds.clear()
            worlds[world] = Remembered(scene_of(kind, seed, SIZE, *world, data))
        scene = worlds[world]
        frame = _gray_frames(scene, condition)
        for (first, gap), key in keys.items():
            if key in done:
                continue
            (a, mask_a), (b, mask_b) = frame(first, False), frame(first + gap, True)
            truth = true_homography(scene.camera(first), scene.camera(first + gap))
            began = time.process_time()
            fit = register(a, b, mask_a=mask_a, mask_b=mask_b)
            cpu_ms = 1e3 * (time.process_time() - began)
            yield {
                "key": key, "kind": kind, "seed": seed, "condition": name, "gap": gap, "cpu_ms": cpu_ms,
                "overlap": overlap_of(truth, scene.size_px), **answer(fit, truth, scene.size_px),
            }  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    """Pairs until there are as many as asked for, seed by seed, each with all kinds of scenes."""
    cv2.setNumThreads(1)
    arguments.work.mkdir(parents=True, exist_ok=True)
    path = arguments.work / "campaign.jsonl"
    done = {r["key"] for r in read_rows(path)} if path.exists() else set()
    kinds = [*KINDS, *(PHOTOGRAPHS if arguments.photographs else ())]
    for seed in arguments.seeds:
        for kind in kinds:
            if len(done) >= arguments.pairs:
                return
            for row in rows_of_scene(kind, seed, arguments.photographs, done):
                with open(path, "a", encoding="utf-8") as handle:
                    handle.write(json.dumps(row) + "\n")
                done.add(row["key"])
            print(seed, kind, len(done), flush=True)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a run, a pair once."""
    return list(
        {r["key"]: r for r in map(json.loads, path.read_text(encoding="utf-8").splitlines())}.values()
    )


def is_wrong(row: dict[str, Any]) -> bool:
    """No answer, or one more than WRONG_PX off."""
    return row["error_px"] is None or not row["error_px"] <= WRONG_PX


def table(rows: list[dict[str, Any]], by: str) -> list[str]:
    """A line per value of `by`, and one for all."""
    lines = [
        f"| {by} | pairs | wrong | of them over 40 % overlap | wrong, `ok` | wrong, `weak` | right, not `ok` "
        "| median px | 95 % px | chi^2 / 8 of `ok`: mean, median |",
        "|" + "---|" * 10,
    ]
    for value in [*sorted({r[by] for r in rows}, key=str if by != "gap" else int), None]:
        some = [r for r in rows if value is None or r[by] == value]
        wrong = [r for r in some if is_wrong(r)]
        near = [r for r in some if r["overlap"] > AVOIDABLE_OVERLAP]
        near_wrong = sum(is_wrong(r) for r in near)
        ok = sum(r["status"] == PairStatus.OK for r in wrong)
        weak = sum(r["status"] == PairStatus.WEAK for r in wrong)
        doubted = sum(not is_wrong(r) and r["status"] != PairStatus.OK for r in some)
        errors = np.array([np.inf if r["error_px"] is None else r["error_px"] for r in some])
        high = float(np.quantile(errors, 0.95, method="higher"))
        chi2 = [r["chi2"] for r in some if r["status"] == PairStatus.OK and r["chi2"] is not None]
        lines.append(
            f"| {'all' if value is None else value} | {len(some)} | {len(wrong)} "
            f"| {near_wrong} of {len(near)} ({100 * near_wrong / max(len(near), 1):.1f} %) "
            f"| {ok} ({100 * ok / len(some):.2f} %) | {weak} | {doubted} | {np.median(errors):.3g} "
            f"| {f'{high:.3g}' if np.isfinite(high) else 'no answer'} "
            f"| {f'{np.mean(chi2):.2g}, {np.median(chi2):.2g}' if chi2 else '-'} |"
        )
    return lines


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run")
    one.add_argument("--photographs", type=Path, metavar="DATA", help="folder with pano/ and people")
    one.add_argument("--pairs", type=int, default=5000)
    two = commands.add_parser("table")
    for command in (one, two):
        command.add_argument("--work", type=Path, required=True)
        command.add_argument("--seeds", type=int, nargs="+", default=list(range(1001, 1006)))
    arguments = parser.parse_args(argv)
    if arguments.command == "run":
        run(arguments)
        return
    rows = [r for r in read_rows(arguments.work / "campaign.jsonl") if r["seed"] in arguments.seeds]
    for by in ("condition", "gap", "kind"):
        print("\n".join([*table(rows, by), ""]))


if __name__ == "__main__":
    main()
