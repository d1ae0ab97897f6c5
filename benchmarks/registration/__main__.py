"""Registration against its peers, with known truth: runs pairs, keeps every answer, writes the tables.

    python -m benchmarks.registration run --work FOLDER [--quick] [--seeds 1 2] [--sizes 1080p 720p]
        [--kinds soccer arena grass] [--photographs DATA] [--gaps 1 5 12 30 60] [--fast | --alone]
    python -m benchmarks.registration table --work FOLDER [--out docs/registration-cells.md] [--plot X.svg]

`run` appends a line of FOLDER/pairs.jsonl for each pair and skips those that are there: kill it and start it again.
Methods follow each other on each pair, so a busy machine is busy for all. Slow peers take part in the first seed of
`soccer` only, the slowest there in the conditions of --quick, 1 and 12 frames apart. --photographs adds clips rendered
from the panoramas of real grounds in DATA/pano, with the people of DATA/*_mask; hoardings do not scroll in them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.registration import peers
from benchmarks.registration.scenes import (
    CONDITIONS,
    GAPS,
    KINDS,
    PHOTOGRAPHS,
    Pair,
    corner_error_px,
    pairs_of_scene,
)
from benchmarks.registration.tables import write_tables

QUICK_CONDITIONS = ("clean", "players 25 %", "hoardings", "8 Mbit/s")


def measure(method: Callable[[Pair], peers.Answer], pair: Pair) -> dict[str, Any]:
    """error px (None: no answer), accepted, CPU and wall ms of one method on one pair."""
    cpu, wall = time.process_time(), time.perf_counter()
    H, accepted = method(pair)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    error = None if H is None else corner_error_px(H, pair.H_b_a, pair.a.shape[::-1])
    return {"error_px": error, "accepted": bool(accepted), "cpu_ms": 1e3 * cpu, "wall_ms": 1e3 * wall}


def methods_for(pair: Pair, arguments: argparse.Namespace) -> dict[str, Callable[[Pair], peers.Answer]]:
    """Who takes part in a pair."""
    if arguments.alone:
        return dict(peers.OURS)
    source = peers.keyframe_template(pair)
    chosen = {**peers.OURS, peers.VIDEO: lambda p: peers.video_path(p, source), **peers.FAST}
    if not arguments.fast and pair.kind == "soccer" and pair.seed == arguments.seeds[0]:
        chosen |= peers.SLOW
        if pair.gap in (1, 12) and pair.condition in QUICK_CONDITIONS:
            chosen |= peers.SLOWEST
    return chosen


def run(arguments: argparse.Namespace) -> None:
    """Measure all pairs that are not in the file yet."""
    cv2.setNumThreads(1)
    arguments.work.mkdir(parents=True, exist_ok=True)
    path = arguments.work / "pairs.jsonl"
    done = {json.loads(line)["key"] for line in path.read_text().splitlines()} if path.exists() else set()
    conditions = [c for c in CONDITIONS if not arguments.quick or c in QUICK_CONDITIONS]
    gaps = tuple(arguments.gaps)
    kinds = [*arguments.kinds, *(PHOTOGRAPHS if arguments.photographs else ())]
    warm = True
    for seed in arguments.seeds:
        for kind in kinds:
            for size in arguments.sizes:
                for pair in pairs_of_scene(kind, seed, size, conditions, gaps, done, arguments.photographs):
                    methods = methods_for(pair, arguments)
                    if warm:  # compiles and imports
                        for method in methods.values():
                            method(pair)
                        warm = False
                    answers = {name: measure(method, pair) for name, method in methods.items()}
                    row = {
                        "key": pair.key, "kind": kind, "seed": seed, "size": size,
                        "condition": pair.condition, "gap": pair.gap, "answers": answers,
                    }  # fmt: skip
                    with open(path, "a", encoding="utf-8") as handle:
                        handle.write(json.dumps(row) + "\n")
                    ours = answers["mosaic"]
                    print(
                        pair.key,
                        "none" if ours["error_px"] is None else f"{ours['error_px']:.4f}",
                        flush=True,
                    )


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run")
    one.add_argument("--work", type=Path, required=True)
    one.add_argument("--quick", action="store_true")
    one.add_argument("--fast", action="store_true", help="without the slow peers")
    one.add_argument("--alone", action="store_true", help="no peers: many cheap pairs, for failures")
    one.add_argument("--gaps", type=int, nargs="+", default=list(GAPS))
    one.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    one.add_argument("--sizes", nargs="+", default=["1080p", "720p"])
    one.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    one.add_argument("--photographs", type=Path, metavar="DATA", help="folder with pano/ and people")
    two = commands.add_parser("table")
    two.add_argument("--work", type=Path, required=True)
    two.add_argument("--out", type=Path)
    two.add_argument("--plot", type=Path)
    arguments = parser.parse_args(argv)
    np.seterr(all="ignore")  # peers divide by what they like
    if arguments.command == "run":
        run(arguments)
    else:
        write_tables(arguments.work / "pairs.jsonl", arguments.out, arguments.plot)


if __name__ == "__main__":
    main()
