"""Images to homographies to panorama: direct registration and compositing for rotating cameras.

`register(a, b)` for two pictures, `DirectHomography` for batches of tensors, `composite_panorama` for placed frames.
The names below are loaded when first used: importing mosaic imports neither torch nor cv2 nor numba.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mosaic.composite import Panorama as Panorama
    from mosaic.composite import composite as composite_panorama
    from mosaic.estimator import RegisterOptions as RegisterOptions
    from mosaic.framestore import FrameStore as FrameStore
    from mosaic.pair import PairOptions as PairOptions
    from mosaic.pair import register as register
    from mosaic.records import FlowGrid as FlowGrid
    from mosaic.records import MotionGraph as MotionGraph
    from mosaic.records import PairFit as PairFit
    from mosaic.records import PairStatus as PairStatus
    from mosaic.surface import Placement as Placement
    from mosaic.surface import Surface as Surface
    from mosaic.surface import choose_surface as choose_surface
    from mosaic.torch_module import DirectHomography as DirectHomography
    from mosaic.views import CompositeOptions as CompositeOptions

# Public name -> (module, name there). No public name is that of a submodule: `mosaic.composite` would be the function
# or the module, depending on what was imported before.
_HOMES = {
    "CompositeOptions": ("mosaic.views", "CompositeOptions"),
    "DirectHomography": ("mosaic.torch_module", "DirectHomography"),
    "FlowGrid": ("mosaic.records", "FlowGrid"),
    "FrameStore": ("mosaic.framestore", "FrameStore"),
    "MotionGraph": ("mosaic.records", "MotionGraph"),
    "PairFit": ("mosaic.records", "PairFit"),
    "PairOptions": ("mosaic.pair", "PairOptions"),
    "PairStatus": ("mosaic.records", "PairStatus"),
    "Panorama": ("mosaic.composite", "Panorama"),
    "Placement": ("mosaic.surface", "Placement"),
    "RegisterOptions": ("mosaic.estimator", "RegisterOptions"),
    "Surface": ("mosaic.surface", "Surface"),
    "choose_surface": ("mosaic.surface", "choose_surface"),
    "composite_panorama": ("mosaic.composite", "composite"),
    "register": ("mosaic.pair", "register"),
}

__all__ = [
    "CompositeOptions",
    "DirectHomography",
    "FlowGrid",
    "FrameStore",
    "MotionGraph",
    "PairFit",
    "PairOptions",
    "PairStatus",
    "Panorama",
    "Placement",
    "RegisterOptions",
    "Surface",
    "choose_surface",
    "composite_panorama",
    "register",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value  # the next look-up finds it without us
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
