"""Conversion of result dataclasses to JSON data and back."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar

import numpy as np

_DataclassType = TypeVar("_DataclassType")


def to_plain_data(value: Any) -> Any:
    """Nested dataclass of numbers, texts and arrays as JSON data, without loss of precision.

    JSON has no infinities: what is not finite becomes text.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: to_plain_data(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "values": to_plain_data(value.ravel().tolist())}
    if isinstance(value, Mapping):
        return {str(key): to_plain_data(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain_data(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def from_plain_data(kind: type[_DataclassType], data: Mapping[str, Any]) -> _DataclassType:
    """Dataclass instance restored from the data that `to_plain_data` returned."""
    return kind(**{name: _value(hint, data[name]) for name, hint in _hints(typing.cast(typing.Hashable, kind)).items()})


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {entry.name: hints[entry.name] for entry in dataclasses.fields(kind)}


def _value(hint: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _value(next(entry for entry in arguments if entry is not type(None)), value)
    if origin is np.ndarray:
        kind = typing.get_args(arguments[1])[0]
        return np.array(value["values"], dtype=kind).reshape(value["shape"])
    if origin is tuple:
        inner = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_value(entry, item) for entry, item in zip(inner, value, strict=True))
    if origin in (dict, Mapping):
        return {key: _value(arguments[1], entry) for key, entry in value.items()}
    if dataclasses.is_dataclass(hint):
        return from_plain_data(typing.cast(type, hint), value)
    return float(value) if hint is float else value
