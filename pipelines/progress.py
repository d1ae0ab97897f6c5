"""How a long stage says where it is. The pipeline calls a hook; the command line may show it on a terminal."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Progress(Protocol):
    """Called with the stage's name in words, what is done of it, and how much there is (None: not known)."""

    def __call__(self, stage: str, done: int, total: int | None) -> None: ...


def silent(stage: str, done: int, total: int | None) -> None:
    """The hook of whoever does not want to know."""


class TerminalProgress:
    """A line a stage on stderr: bar, count, rate, time to go. Nothing when stderr is no terminal, or `show` is off.

    `with TerminalProgress(...) as progress: process(..., progress=progress)`.
    """

    def __init__(self, title: str = "", *, show: bool = True) -> None:
        self._title = title
        self._show = show and sys.stderr.isatty()
        self._bars: RichProgress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._done: dict[str, int] = {}

    def __enter__(self) -> Self:
        if self._show:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            from pipelines.progress_rate import CountColumn, RateColumn

            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                CountColumn(),
                RateColumn(),
                TimeRemainingColumn(compact=True, elapsed_when_finished=True),
                console=Console(stderr=True),
            )
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            for task in self._bars.tasks:
                # A header may promise more pictures than come: what has ended is not left at 817 of 825.
                if kind is None and not task.finished:
                    self._bars.update(task.id, total=task.completed)
            self._bars.stop()
            self._bars = None

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        if self._bars is None:
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(f"{self._title}{stage}", total=total)
        elif done < self._done[stage]:
            # The next shot's, on the same line: a line a shot would fill the terminal, and the newest be cut off.
            self._bars.reset(self._tasks[stage], total=total)
        self._done[stage] = done
        self._bars.update(self._tasks[stage], completed=done, total=total)
