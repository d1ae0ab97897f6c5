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
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            from pipelines.progress_rate import RateColumn

            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
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
            self._bars.stop()
            self._bars = None

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        if self._bars is None:
            return
        if stage not in self._tasks or done < self._done[stage]:  # a stage that comes again is another shot's
            self._tasks[stage] = self._bars.add_task(f"{self._title}{stage}", total=total)
        self._done[stage] = done
        self._bars.update(self._tasks[stage], completed=done, total=total)
