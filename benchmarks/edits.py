"""Shot boundaries on edited programmes of known truth: precision, recall and F1 by kind of edit.

    python -m benchmarks.edits [--seeds 101 102 ...] [--size 480x270] [--whole-run] [--clips FILE ...]

Each programme has eight shots of two venues (wide, close, still, panning; some of 14 to 30 frames, some with a flash)
joined by cuts, dissolves of 6 to 50 frames, fades, wipes, irises and stingers. A cut counts as found within two frames,
a gradual edit where what lies between two found shots overlaps it. --clips: files without truth; boundaries printed.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from pipelines.config import Config
from pipelines.decode import open_clip
from pipelines.first_look import look_at
from pipelines.run import process
from tests.synth.edits import Boundary, random_programme, write_programme

KINDS = ("cut", "dissolve", "fade", "wipe", "iris", "stinger")
WITHIN = 2  # frames


def found_shots(clip: Path, *, whole_run: bool) -> list[tuple[int, int]]:
    """First and last frame of every shot, by the cheap first pass of `probe`, or by the main job without panorama."""
    if whole_run:
        config = Config.model_validate({"panorama": {"enabled": False}})
        with tempfile.TemporaryDirectory() as name:
            record = process(clip, Path(name) / "out", config)
        return [(s.first_frame, s.last_frame) for s in record.shots]
    with open_clip(clip) as opened:
        shots = look_at(opened, Config(), seconds=None)["shots"]["list"]
    return [(s["first_frame"], s["last_frame"]) for s in shots]


def matched(
    shots: Sequence[tuple[int, int]], truth: Iterable[Boundary]
) -> tuple[list[Boundary], list[Boundary], list[tuple[int, int]]]:
    """Truth that was found, truth that was missed, and gaps between shots that are no edit."""
    gaps = [(a[1] + 1, b[0] - 1) for a, b in itertools.pairwise(shots)]
    hit, missed = [], []
    for boundary in truth:
        if boundary.kind == "cut":
            near = [g for g in gaps if g[0] - WITHIN <= boundary.first <= g[1] + 1 + WITHIN]
        else:
            near = [g for g in gaps if g[0] <= boundary.last + 1 and g[1] + 1 >= boundary.first]
        if near:
            gaps.remove(near[0])
            hit.append(boundary)
        else:
            missed.append(boundary)
    return hit, missed, gaps


def inside(shots: Sequence[tuple[int, int]], truth: Iterable[Boundary]) -> tuple[int, int]:
    """Frames of gradual edits that were taken for frames of a shot, and how many such frames there are."""
    mixed = [k for b in truth for k in range(b.first, b.last + 1)]
    return sum(any(a <= k <= z for a, z in shots) for k in mixed), len(mixed)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(101, 113)))
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--whole-run", action="store_true")
    parser.add_argument("--clips", nargs="*", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=None, help="keep the programmes here")
    arguments = parser.parse_args()
    if arguments.clips:
        for clip in arguments.clips:
            print(clip.name, found_shots(clip, whole_run=arguments.whole_run), flush=True)
        return
    width, height = (int(v) for v in arguments.size.split("x"))
    there, gone = Counter[str](), Counter[str]()
    n_wrong, n_inside, n_mixed = 0, 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in arguments.seeds:
            programme = random_programme(seed, size_px=(width, height), kinds=KINDS)
            clip = folder / f"edits-{seed}.mp4"
            if not clip.exists():
                write_programme(clip, programme)
            started = time.perf_counter()
            shots = found_shots(clip, whole_run=arguments.whole_run)
            seconds = time.perf_counter() - started
            hit, missed, wrong = matched(shots, programme.boundaries)
            there.update(b.kind for b in hit)
            gone.update(b.kind for b in missed)
            n_wrong += len(wrong)
            taken, mixed = inside(shots, programme.boundaries)
            n_inside, n_mixed = n_inside + taken, n_mixed + mixed
            print(
                f"seed {seed}: {programme.n_frames} frames, {len(hit)} of {len(programme.boundaries)} found, "
                f"wrong {wrong}, missed {[(b.kind, b.first, b.last) for b in missed]}, {seconds:.0f} s",
                flush=True,
            )
    print("\n| kind | edits | found |\n|---|---|---|")
    for kind in KINDS:
        print(f"| {kind} | {there[kind] + gone[kind]} | {there[kind]} |")
    n_there, n_gone = there.total(), gone.total()
    precision, recall = n_there / max(n_there + n_wrong, 1), n_there / max(n_there + n_gone, 1)
    print(
        f"\n{n_there} found, {n_gone} missed, {n_wrong} wrong: precision {precision:.3f}, recall {recall:.3f}, F1 "
        f"{2 * precision * recall / max(precision + recall, 1e-9):.3f}; "
        f"{n_inside} of {n_mixed} frames of gradual edits in a shot"
    )


if __name__ == "__main__":
    main()
