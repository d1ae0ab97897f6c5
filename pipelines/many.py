"""Many clips: one folder each, worker processes, and whatever happens to a clip is that clip's own result.

A worker is a fresh interpreter that takes clip after clip. What a clip gives depends on nothing but the clip and the
settings, so that any number of workers gives the same files; a worker that dies (a decoder's crash on a hostile file,
the system out of memory) takes only its clip along. The table of all clips is in clip_summary.py.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.errors import ConfigError, UserError
from pipelines.output_folder import LOCK
from pipelines.stills import is_pattern

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

    from pipelines.config import Config
    from pipelines.records import RunRecord

log = logging.getLogger(__name__)

SUMMARY = "summary.csv"
PROGRESS_EVERY_S = 0.2  # between two words of a worker about its progress: a terminal shows no more
PATIENCE_S = 20.0  # for workers to close their files after an interrupt, before they are killed


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One clip to be run into a folder of its own. quiet, verbose: what its worker says on stderr."""

    clip: Path
    out: Path
    config: Config
    resume: bool = False
    quiet: bool = False
    verbose: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of one clip: its record, or else the error.

    error: kind ('input', 'output', ... as UserError; 'bug': an exception of ours; 'crash': the process died), what,
    cause and cure. seconds: s that its worker had it.
    """

    record: RunRecord | None
    error: Mapping[str, str] | None
    seconds: float


Work = Callable[[Task, Callable[[str, int, int | None], None]], "RunRecord"]
OnProgress = Callable[[int, str, int, int | None], None]
OnDone = Callable[[int, Outcome], None]


def read_list(path: Path) -> list[Path]:
    """Clips of a text file: one a line, blank lines and lines that begin with # left out.

    Names count from the current folder, as on the command line. Raises ConfigError: not readable, no text, no clip.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise ConfigError(path, "no such file", "check the path") from None
    except UnicodeDecodeError:
        raise ConfigError(path, "is not a text file", "--list takes the names of clips, one a line") from None
    except OSError as error:
        raise ConfigError(path, f"cannot be read ({error.strerror})", "check the path") from None
    clips = [Path(line.strip()) for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not clips:
        raise ConfigError(path, "names no clip", "write one name a line")
    return clips


def folder_names(clips: Sequence[Path]) -> list[str]:
    """A folder name for each clip: its stem, numbered where that is taken. The same clips give the same names.

    Names that differ by case only count as the same: on many disks they are.
    """
    names: list[str] = []
    taken = {SUMMARY, LOCK}
    for clip in clips:
        # '..' is a folder of images too, and no name for one of results.
        whole = Path(os.path.abspath(clip))
        stem = (whole.parent.name if is_pattern(clip) else whole.stem) or "clip"
        name, number = stem, 2
        while name.casefold() in taken:
            name, number = f"{stem}-{number}", number + 1
        taken.add(name.casefold())
        names.append(name)
    return names


def work_on(task: Task, progress: Callable[[str, int, int | None], None]) -> RunRecord:
    """Run one clip in this process. With `resume`, a clip that is already done with these settings is kept as it is."""
    from pipelines.run import process

    if task.resume and (done := _finished(task)) is not None:
        log.info("%s: kept, it was finished before", task.clip)
        return done
    return process(task.clip, task.out, task.config, progress=progress, resume=task.resume)


def _finished(task: Task) -> RunRecord | None:
    """The record in OUT, if it is of this very clip, settings and version, and all its files are there."""
    from pipelines.archive import read_run
    from pipelines.decode import open_clip
    from pipelines.output_folder import run_digest

    with suppress(UserError):
        record = read_run(task.out)
        with open_clip(task.clip, task.config.decode) as opened:
            digest = run_digest(task.config, opened.facts.identity())
        whole = all((task.out / str(name)).is_file() for name in record.extra.get("files", ["?"]))
        if record.extra.get("digest") == digest and whole:
            return record
    return None


def run_many(
    tasks: Sequence[Task],
    jobs: int = 1,
    *,
    work: Work = work_on,
    on_progress: OnProgress | None = None,
    on_done: OnDone | None = None,
) -> list[Outcome]:
    """Run the tasks in at most `jobs` processes; one outcome a task, in the order of the tasks.

    on_progress(task number, stage, done, total) and on_done(task number, outcome) are called in this process. `work`
    must be a function of a module: workers import it. KeyboardInterrupt stops the workers, which keep what is finished.
    """
    context = multiprocessing.get_context(
        "spawn"
    )  # a fork would inherit the threads of torch and numba half dead
    outcomes: dict[int, Outcome] = {}
    waiting = iter(range(len(tasks)))
    workers: list[_Worker] = []
    try:
        for _ in range(min(jobs, len(tasks))):
            workers.append(_Worker(context, work))
            _give(workers[-1], waiting, tasks)
        while len(outcomes) < len(tasks):
            busy = {worker.connection: worker for worker in workers if worker.number is not None}
            for ready in wait(list(busy)):
                worker = busy[ready]
                number = worker.number
                assert number is not None
                said = worker.said()
                if isinstance(said, tuple):
                    if on_progress is not None:
                        on_progress(number, *said)
                    continue
                outcomes[number] = said
                if on_done is not None:
                    on_done(number, said)
                if said.error is not None and said.error["kind"] == "crash":
                    workers.remove(worker)
                    worker = _Worker(context, work)
                    workers.append(worker)
                _give(worker, waiting, tasks)
    finally:
        _stop(workers, interrupted=len(outcomes) < len(tasks))
    return [outcomes[number] for number in range(len(tasks))]


class _Worker:
    """A process and what it is at work on (internal to this module)."""

    def __init__(self, context: Any, work: Work) -> None:
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs, work), name="clip")
        self.process.start()
        theirs.close()
        self.number: int | None = None
        self._started = 0.0

    def give(self, number: int, task: Task) -> None:
        self.number = number
        self._task = task
        self._started = time.perf_counter()
        with suppress(OSError):  # it died before its first task: `said` will tell
            self.connection.send(task)

    def said(self) -> tuple[str, int, int | None] | Outcome:
        """The next message: progress, or how the task ended; a process that died is an outcome too."""
        try:
            message: tuple[str, int, int | None] | Outcome = self.connection.recv()
            return message
        except (EOFError, OSError, pickle.UnpicklingError):
            pass
        self.process.join(PATIENCE_S)
        code = self.process.exitcode
        cause = f"its process was ended by signal {-code}" if code is not None and code < 0 else ""
        error = {
            "kind": "crash",
            "what": str(self._task.clip),
            "cause": cause or f"its process ended with code {code}",
            "cure": "look for a damaged file, or for too little memory (fewer --jobs)",
        }
        return Outcome(record=None, error=error, seconds=time.perf_counter() - self._started)


def _give(worker: _Worker, waiting: Iterator[int], tasks: Sequence[Task]) -> None:
    """The next task, or none any more."""
    number = next(waiting, None)
    if number is None:
        worker.number = None
    else:
        worker.give(number, tasks[number])


def _stop(workers: Sequence[_Worker], *, interrupted: bool) -> None:
    for worker in workers:
        if interrupted:
            worker.process.terminate()
        worker.connection.close()  # an idle worker reads the end and goes
    until = time.monotonic() + PATIENCE_S
    for worker in workers:
        worker.process.join(max(0.1, until - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


# ---- in the worker


def _serve(connection: Connection, work: Work) -> None:
    """Body of a worker: tasks in, progress and outcomes out, until the other end is closed."""
    # The terminal sends its interrupt to all processes; who decides is the first one, and it says so by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    with suppress(EOFError, KeyboardInterrupt, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(_outcome(connection.recv(), connection, work))


def _leave_with_parent() -> None:
    """End at once when the parent was killed: a worker that lives on would hold its folder against --resume."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _outcome(task: Task, connection: Connection, work: Work) -> Outcome:
    from pipelines.cli_logging import set_up_logging

    set_up_logging(task.quiet, task.verbose, task.clip.name)
    started = time.perf_counter()
    next_word = started

    def progress(stage: str, done: int, total: int | None) -> None:
        nonlocal next_word
        if time.perf_counter() >= next_word:
            connection.send((stage, done, total))
            next_word = time.perf_counter() + PROGRESS_EVERY_S

    record, error = None, None
    try:
        record = work(task, progress)
    except UserError as mistake:
        error = mistake.as_dict()
    except Exception as bug:
        log.exception("%s: a bug in broadcast-mosaic; the other clips go on", task.clip)
        cause = f"{type(bug).__name__}: {bug}"
        error = {"kind": "bug", "what": str(task.clip), "cause": cause, "cure": "please report it"}
    return Outcome(record=record, error=error, seconds=time.perf_counter() - started)
