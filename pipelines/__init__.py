"""The main job: clip in; camera log, homographies, panorama and report out.

`pipelines.process(clip, out)` is loaded when first used, so that the command line's help stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.run import process as process

__all__ = ["process"]


def __getattr__(name: str) -> Any:
    if name != "process":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pipelines.run import process

    globals()[name] = process
    return process


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
