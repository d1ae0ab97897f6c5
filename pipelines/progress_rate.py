"""The counts and rates of the progress bars; apart, because they need rich at import."""

from __future__ import annotations

from rich.progress import MofNCompleteColumn, ProgressColumn, Task
from rich.text import Text


class CountColumn(MofNCompleteColumn):
    """Done of all; nothing for a stage that counts nothing."""

    def render(self, task: Task) -> Text:
        return super().render(task) if counts(task) else Text("")


def counts(task: Task) -> bool:
    """Whether a stage has steps: one of unknown length without any, or of a single step, has not."""
    return task.total not in (None, 1) or (task.total is None and task.completed > 0)


class RateColumn(ProgressColumn):
    """Steps per second: frames/s in the stages that count frames."""

    def render(self, task: Task) -> Text:
        if not counts(task):
            return Text("")
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s", style="progress.data.speed")
