"""`run` with several clips: their folders, the processes, summary.csv after every clip, and the table at the end."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.cli_results import print_json
from pipelines.cli_runs import RunResult, exit_code
from pipelines.clip_summary import row, write_summary
from pipelines.config import Config
from pipelines.errors import ConfigError, InputError, OutputError, UserError
from pipelines.many import SUMMARY, Outcome, Task, folder_names, read_list, run_many, work_on
from pipelines.output_folder import held_folder
from pipelines.progress import TerminalProgress
from pipelines.stdin import STDIN

log = logging.getLogger(__name__)


def run_clips(
    named: Sequence[Path],
    listed: Path | None,
    out: Path,
    config: Config,
    jobs: int,
    resume: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> int:
    """Run every clip into OUT/<its name>, print what became of them, return the exit code.

    Raises ConfigError: the list is not usable; OutputError: OUT cannot be written or is in use, or summary.csv could
    not be written at the end. What goes wrong with a clip is in its row.
    """
    clips = [*named, *(read_list(listed) if listed is not None else ())]
    if STDIN in clips:
        raise InputError(STDIN, "standard input can only be the one clip of a run", "name files")
    if config.people.masks is not None and len(clips) > 1:
        cure = "run each clip with its own, or give a detector: people.model"
        raise ConfigError("people.masks", f"belong to one clip, and {len(clips)} are named", cure)
    tasks = [
        Task(
            clip=clip, out=out / name, config=config, resume=resume or config.run.resume, quiet=quiet, verbose=verbose
        )
        for clip, name in zip(clips, folder_names(clips), strict=True)
    ]  # fmt: skip
    results: dict[int, RunResult] = {}
    rows: dict[int, dict[str, Any]] = {}
    unwritten: OSError | None = None
    with held_folder(out), TerminalProgress(show=not quiet) as progress:

        def show(number: int, stage: str, done: int, total: int | None) -> None:
            if jobs == 1:  # lines of clips that take turns would tell nothing
                progress(f"{tasks[number].out.name}: {stage}", done, total)

        def note(number: int, outcome: Outcome) -> None:
            nonlocal unwritten
            task = tasks[number]
            results[number] = RunResult(
                clip=task.clip, out=task.out, record=outcome.record, error=outcome.error
            )
            rows[number] = row(task, outcome)
            if outcome.error is not None:
                print(f"broadcast-mosaic: {_error_line(outcome.error)}", file=sys.stderr)
            for line in results[number].failures():
                print(f"broadcast-mosaic: {line}", file=sys.stderr)
            progress("clips", len(rows), len(tasks))
            try:
                # After every clip: a season takes days, and what is done shall be seen and outlive a crash.
                write_summary(out / SUMMARY, [rows[i] for i in sorted(rows)])
                unwritten = None
            except OSError as error:
                unwritten = error  # the next clip may find room again; at the end it counts

        run_many(tasks, jobs, work=work_on, on_progress=show, on_done=note)
    if unwritten is not None:
        cause = f"cannot be written ({unwritten.strerror})"
        raise OutputError(out / SUMMARY, cause, "make room and run again with --resume") from unwritten
    in_order = [results[number] for number in range(len(tasks))]
    code = exit_code(in_order)
    if as_json:
        document = [{**result.as_dict(), "summary": rows[number]} for number, result in enumerate(in_order)]
        print_json({"exit_code": code, "summary": str(out / SUMMARY), "clips": document})
    elif not quiet:
        from pipelines.summary import print_clips

        print_clips(out / SUMMARY, [rows[number] for number in range(len(tasks))])
    return code


def _error_line(error: Mapping[str, str]) -> str:
    return str(UserError(error["what"], error["cause"], error["cure"]))
