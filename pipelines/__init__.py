"""The main job: clip in; camera log, homographies, panorama and report out.

`process(clip, out)` runs it, `open_result(out)` opens what an earlier run wrote. Names are loaded when first used, so
that the command line's help stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.config import Config as Config
    from pipelines.config import load_config as load_config
    from pipelines.errors import UserError as UserError
    from pipelines.exports.formats import ExportOptions as ExportOptions
    from pipelines.render.encode import EncodeOptions as EncodeOptions
    from pipelines.render.move import MoveOptions as MoveOptions
    from pipelines.render.overlay import OverlayOptions as OverlayOptions
    from pipelines.render.stabilise import StabiliseOptions as StabiliseOptions
    from pipelines.result import Result as Result
    from pipelines.result import open_result as open_result
    from pipelines.result import process as process

_HOMES = {
    "Config": "pipelines.config",
    "EncodeOptions": "pipelines.render.encode",
    "ExportOptions": "pipelines.exports.formats",
    "MoveOptions": "pipelines.render.move",
    "OverlayOptions": "pipelines.render.overlay",
    "Result": "pipelines.result",
    "StabiliseOptions": "pipelines.render.stabilise",
    "UserError": "pipelines.errors",
    "load_config": "pipelines.config",
    "open_result": "pipelines.result",
    "process": "pipelines.result",
}

__all__ = [
    "Config",
    "EncodeOptions",
    "ExportOptions",
    "MoveOptions",
    "OverlayOptions",
    "Result",
    "StabiliseOptions",
    "UserError",
    "load_config",
    "open_result",
    "process",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
