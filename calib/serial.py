"""calib's records as plain JSON values and back. Exact: floats keep their 64 bits (JSON prints the shortest repr)."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def number(value: float) -> float | str:
    """A float as JSON has it: NaN and infinities as words."""
    return value if math.isfinite(value) else str(float(value))


def from_number(value: float | str) -> float:
    """Inverse of `number`."""
    return _WORDS[value] if isinstance(value, str) else float(value)


def to_plain(value: Any) -> Any:
    """A record, array or number as dicts, lists, strings, numbers. Raises TypeError for anything else."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        flat = (
            [number(x) for x in value.ravel().tolist()] if value.dtype.kind == "f" else value.ravel().tolist()
        )
        return {"shape": list(value.shape), "dtype": value.dtype.name, "values": flat}
    if isinstance(value, Mapping):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return number(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    raise TypeError(f"{type(value).__name__} has no plain form")


def from_plain(kind: type[T], value: Any) -> T:
    """The record of type `kind` that to_plain() wrote. Raises TypeError for unknown or missing fields."""
    hints = typing.get_type_hints(kind)
    return kind(**{name: _build(hints[name], part) for name, part in value.items()})


def _build(hint: Any, value: Any) -> Any:
    if isinstance(value, dict) and set(value) == {"shape", "dtype", "values"}:
        if np.dtype(value["dtype"]).kind == "f":
            return np.array([from_number(x) for x in value["values"]], value["dtype"]).reshape(value["shape"])
        return np.array(value["values"], value["dtype"]).reshape(value["shape"])
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _build(next(a for a in arguments if a is not type(None)), value)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_plain(hint, value)
    if origin is tuple:
        inner = arguments[0] if len(arguments) == 2 and arguments[1] is Ellipsis else None
        return tuple(
            _build(inner if inner is not None else a, v)
            for v, a in zip(value, arguments if inner is None else value, strict=True)
        )
    if isinstance(value, dict):
        return {k: _build(arguments[1] if len(arguments) == 2 else Any, v) for k, v in value.items()}
    if hint is float:
        return from_number(value)
    return value
