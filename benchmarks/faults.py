"""Fault campaign: `python -m benchmarks.faults [--mutations 240] [--kills 50] [--seed 1]`; figures in docs/footage.md.

Mutated files (flipped bytes, cuts, zeroed and doubled ranges) of the zoo's formats are probed and decoded. Runs are
killed by SIGKILL at random times and resumed; they meet a full disk, and each other in one folder. Counted are
tracebacks, crashes, hangs over 60 s, losses that nobody mentions, damage to earlier outputs, and resumed results that
differ. Exit code 1 if there are any.

Runs are forked from one process that has imported everything: a kill then lands in the work, not in seconds of imports.
POSIX only.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from tests.pipelines.end_to_end import digests, pan_spec, small_spec
from tests.pipelines.zoo import CASES, Case, N, make
from tests.synth.clip import write_clip
from tests.synth.paths import PathSpec

HANG_S = 60.0
FINE = ("refused in one line", "decoded in part, said so", "decoded whole")
BASES = (
    "libx264 yuv420p mp4", "libx264 yuv420p ts", "libx265 yuv420p10le ts", "libx264 yuv422p10le mxf",
    "mpeg2video yuv422p mxf", "mpeg2video yuv420p ts", "prores_ks proxy yuv422p10le mov", "dnxhd dnxhr_sq yuv422p mxf",
    "libsvtav1 yuv420p mp4", "ffv1 gray mkv", "libx265 yuv420p12le mkv", "mpeg2video top field first mxf",
)  # fmt: skip
WITH_TIMES = ("run.json", "report.html")  # they hold seconds; all other files are compared byte for byte
FEW = ("--panorama.max_megapixels", "2", "-q")


# ---- mutated files


def mutate(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """One damage to a file's bytes, and its kind."""
    kind = str(rng.choice(["flip 1", "flip 16", "flip 256", "head", "tail", "cut", "zero", "double"]))
    found = bytearray(data)
    n = len(found)
    if kind.startswith("flip"):
        for position in rng.integers(0, n, int(kind.split()[1])):
            found[position] ^= int(rng.integers(1, 256))
    elif kind in ("head", "tail"):  # where containers keep sizes, counts and offsets
        span = min(n, 1024)
        for position in rng.integers(0, span, 8):
            found[position if kind == "head" else n - 1 - position] ^= int(rng.integers(1, 256))
    elif kind == "cut":
        del found[int(rng.integers(0, n)) :]
    else:
        start, length = int(rng.integers(0, n)), int(rng.integers(1, n // 4))
        if kind == "zero":
            end = min(n, start + length)
            found[start:end] = bytes(end - start)
        else:
            found[start:start] = found[start : start + length]
    return kind, bytes(found)


def read_clip(path: Path, n_frames: int) -> str:
    """Probe and decode; a word for what came of it, 'silent loss' when frames lack and no warning says anything."""
    from pipelines.decode import open_clip
    from pipelines.errors import UserError
    from pipelines.probe import probe

    try:
        probe(path, shots=False)
        with open_clip(path) as clip:
            pictures = sum(1 for _ in clip)
            lost = clip.counts["decoded"] < n_frames
            said = bool(clip.facts.warnings)
    except UserError as error:
        return "refused in one line" if len(str(error).splitlines()) == 1 else "error of several lines"
    if pictures == 0:
        return "nothing decoded, nothing said"
    return ("silent loss" if not said else "decoded in part, said so") if lost else "decoded whole"


def _reader(connection: Connection) -> None:
    while True:
        path, n_frames = connection.recv()
        try:
            connection.send(read_clip(path, n_frames))
        except Exception:
            connection.send(traceback.format_exc())


def mutated_files(count: int, seed: int, folder: Path) -> Counter[str]:
    """Damage, probe and decode `count` files, in turn of each base; outcomes by word. What is bad keeps its file."""
    context = multiprocessing.get_context("spawn")
    rng = np.random.default_rng(seed)
    by_name = {case.name: case for case in CASES}
    bases: list[tuple[Case, bytes]] = [
        (by_name[name], make(by_name[name], folder).read_bytes())
        for name in BASES
        if not by_name[name].missing()
    ]
    outcomes: Counter[str] = Counter()
    child = None
    longest = 0.0
    for number in range(count):
        case, whole = bases[number % len(bases)]
        kind, data = mutate(whole, rng)
        path = folder / f"mutated-{number:04d}.{case.suffix}"
        path.write_bytes(data)
        if child is None:
            ours, theirs = context.Pipe()
            child = context.Process(target=_reader, args=(theirs,), daemon=True)
            child.start()
            theirs.close()
        started = time.perf_counter()
        ours.send((path, N))
        try:
            word = ours.recv() if ours.poll(HANG_S) else "hang"
        except EOFError:
            child.join()
            word = f"crash ({child.exitcode})"
        longest = max(longest, time.perf_counter() - started)
        if word == "hang" or word.startswith("crash"):
            child.kill()
            child = None
        if "\n" in word:
            print(f"{case.name}, {kind}:\n{word}", file=sys.stderr)
            word = "traceback"
        if is_bad(word):
            print(f"{path}: {case.name}, {kind}: {word}", file=sys.stderr)
        else:
            path.unlink()
        outcomes[word] += 1
    if child is not None:
        child.kill()
    print(f"longest {longest:.1f} s")
    return outcomes


def is_bad(word: str) -> bool:
    """Whether an outcome breaks a promise."""
    return word not in FINE and not word.startswith("good")


# ---- runs


def start_run(args: Sequence[str], log: Path, before: Callable[[], None] | None = None) -> int:
    """Fork a child that runs the command line with its output in `log`; its process id."""
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:
        handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        if before is not None:
            before()
        from pipelines import cli

        code = cli.main(["run", *args])
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(code)


def wait_for(pid: int, limit_s: float) -> int | None:
    """Exit code (negative: signal) of a child; None when it had to be killed after limit_s."""
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def visible(out: Path) -> dict[str, str]:
    """Digests of the results in OUT; hidden names are a run's own."""
    return {name: digest for name, digest in digests(out).items() if not name.startswith(".")}


def same_results(found: dict[str, str], expected: dict[str, str]) -> bool:
    """Same files, same bytes but where seconds are written."""
    different = {name for name in expected if found.get(name) != expected[name]}
    return set(found) == set(expected) and {Path(name).name for name in different} <= set(WITH_TIMES)


class Runs:
    """One small clip of two shots, its unbroken result, and an earlier result of another clip that must not suffer."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.rng = np.random.default_rng(seed)
        path = PathSpec(pan_deg=10, zoom=1.2, zoom_style="in")
        self.clip, other = folder / "two.mp4", folder / "other.mp4"
        # Two shots of unequal motion: a kill may find the first one finished and the second not.
        second = small_spec(11, 16, PathSpec(pan_deg=14, zoom=1.2, zoom_style="in"))
        write_clip(self.clip, [pan_spec(8, 16, 12), second])
        write_clip(other, small_spec(5, 14, path))
        self.log = folder / "log"
        assert self.run(other, folder / "earlier") in (0, 1), self.log.read_text()
        started = time.perf_counter()
        assert self.run(self.clip, folder / "whole") in (0, 1), self.log.read_text()
        self.seconds = time.perf_counter() - started
        self.expected = visible(folder / "whole")
        assert "shot-001/pairs.npz" in self.expected, "the clip was not split into its two shots"

    def run(
        self, clip: Path, out: Path, *options: str, before: Callable[[], None] | None = None
    ) -> int | None:
        """One run to its end."""
        return wait_for(start_run([str(clip), "-o", str(out), *FEW, *options], self.log, before), 10 * HANG_S)

    def out(self, number: int) -> Path:
        """A folder that holds the earlier result."""
        out = self.folder / f"out-{number}"
        shutil.copytree(self.folder / "earlier", out)
        return out

    def killed(self, number: int) -> str:
        """SIGKILL at a random time of the run, then --resume."""
        out = self.out(number)
        before = visible(out)
        pid = start_run([str(self.clip), "-o", str(out), *FEW], self.log)
        code = wait_for(pid, float(self.rng.uniform(0.02, 1.0)) * self.seconds)
        now = visible(out)
        if code is not None:
            kept = "good: it had ended before" if same_results(now, self.expected) else "unbroken run differs"
        elif now == before:
            kept = "good: killed, resumed to the same bytes"
        elif same_results(now, self.expected):
            kept = "good: killed when all was published"
        else:
            kept = (
                "two runs mixed: killed while names were changed"
                if (out / "run.json").exists()
                else "earlier output damaged"
            )
        shots = len(list(out.glob(".partial-*/shot-*/shot.json")))
        code = self.run(self.clip, out, "--resume")
        text = self.log.read_text()
        if code is None or "Traceback" in text:
            return "hang" if code is None else f"traceback\n{text}"
        if not same_results(visible(out), self.expected) or any(out.glob(".partial-*")):
            return "resumed result differs"
        return f"{kept}, {shots} shots kept" if kept.startswith("good: killed, ") else kept

    def full(self, number: int) -> str:
        """No file may grow beyond a random size (RLIMIT_FSIZE): as a full disk, a write fails in the middle."""
        out = self.out(number)
        before = visible(out)
        limit = int(10 ** self.rng.uniform(3.3, 5.8))

        def lower() -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        code = self.run(self.clip, out, before=lower)
        text = self.log.read_text()
        if code is None or "Traceback" in text:
            return "hang" if code is None else f"traceback\n{limit} bytes\n{text}"
        if code in (0, 1):
            return "good: enough room" if same_results(visible(out), self.expected) else "result differs"
        if visible(out) != before:
            return "earlier output damaged"
        lines = text.splitlines()
        return (
            "good: refused in one line"
            if code == 2 and len(lines) == 1
            else f"exit {code}, {len(lines)} lines {text}"
        )

    def two(self, number: int) -> str:
        """A second run into the folder of one that is at work."""
        out = self.out(number)
        first = start_run([str(self.clip), "-o", str(out), *FEW], self.folder / "log-first")
        while not list(out.glob(".partial-*")):
            time.sleep(0.01)
        time.sleep(float(self.rng.uniform(0, 0.5)) * self.seconds)
        code, text = self.run(self.clip, out), self.log.read_text()
        ended = wait_for(first, 10 * HANG_S)
        if code == 2 and "another run" in text and len(text.splitlines()) == 1 and ended in (0, 1):
            whole = same_results(visible(out), self.expected)
            return "good: second refused, first whole" if whole else "first result differs"
        return f"exit {code} and {ended}: {text}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutations", type=int, default=240)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--full", type=int, default=10)
    parser.add_argument("--two", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60, help="no further run is started after that")
    options = parser.parse_args()
    until = time.monotonic() + 60 * options.minutes
    bad = 0
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        if options.mutations:
            bad += report("mutated files", mutated_files(options.mutations, options.seed, folder))
        if options.kills or options.full or options.two:
            import pipelines.run  # noqa: F401  # before the forks: its import takes longer than the runs

            runs = Runs(folder, options.seed)
            print(f"the run takes {runs.seconds:.1f} s")
            numbers = iter(range(10**6))
            for title, one, count in (
                ("two runs in one folder", runs.two, options.two),
                ("full disk", runs.full, options.full),
                ("kills", runs.killed, options.kills),
            ):
                outcomes: Counter[str] = Counter()
                while outcomes.total() < count and time.monotonic() < until:
                    outcomes[one(next(numbers))] += 1
                bad += report(title, outcomes)
    return 1 if bad else 0


def report(title: str, outcomes: Counter[str]) -> int:
    """Print the counts; how many of them break a promise."""
    print(f"{title}: {outcomes.total()}", flush=True)
    for word, count in outcomes.most_common():
        print(f"  {count:4d}  {word}", flush=True)
    return sum(count for word, count in outcomes.items() if is_bad(word))


if __name__ == "__main__":
    sys.exit(main())
