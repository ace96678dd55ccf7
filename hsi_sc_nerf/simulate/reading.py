"""Typed values from YAML: dataclasses whose keys, types and ranges are checked, each fault one clear sentence."""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hsi_sc_nerf.errors import InputError


def between(low: float, high: float, **kwargs: Any) -> Any:
    """A dataclass field whose value must lie in [low, high]."""
    return field(metadata={"range": (low, high)}, **kwargs)


def read_dataclass(cls: Any, values: Any, source: str, prefix: str) -> Any:
    """Fill the dataclass ``cls`` from a mapping, checking keys and types; ``prefix`` is the path down to here."""
    where = prefix.rstrip(".") or "the file"
    if not isinstance(values, dict):
        raise InputError(f"{source}: {where} must hold `key: value` lines, not {values!r}.")
    fields = {f.name: f for f in dataclasses.fields(cls)}
    for key in values:
        if key not in fields:
            raise InputError(f"{source}: {prefix}{key} is not a known key; known here are {', '.join(fields)}.")
    for key, f in fields.items():
        if key not in values and f.default is dataclasses.MISSING:
            raise InputError(f"{source}: {prefix}{key} is missing; add it.")
    hints = get_type_hints(cls)
    return cls(**{key: _read_value(hints[key], value, source, prefix + key) for key, value in values.items()})


def _read_value(expected: Any, value: Any, source: str, key: str) -> Any:
    """Check one value against its declared type; whole numbers pass for floats, YAML lists become tuples."""
    if dataclasses.is_dataclass(expected):
        return read_dataclass(expected, value, source, key + ".")
    if get_origin(expected) is Literal:
        if value not in get_args(expected):
            raise InputError(f"{source}: {key} is {value!r}, but must be one of {', '.join(get_args(expected))}.")
        return value
    if get_origin(expected) is tuple:
        if not isinstance(value, list):
            raise InputError(f"{source}: {key} is {value!r}, but must be a list.")
        return tuple(value)
    kind, accepted = {float: ("a number", (int, float)), int: ("a whole number", (int,)), str: ("a text", (str,))}[
        expected
    ]
    if isinstance(value, bool) or not isinstance(value, accepted):
        raise InputError(f"{source}: {key} is {value!r}, but must be {kind}.")
    return expected(value)


def check_ranges(values: Any, source: str, prefix: str) -> None:
    for f in dataclasses.fields(values):
        value = getattr(values, f.name)
        if dataclasses.is_dataclass(value):
            check_ranges(value, source, f"{prefix}{f.name}.")
        elif "range" in f.metadata:
            low, high = f.metadata["range"]
            # Written so that NaN fails as well.
            if not low <= value <= high:
                raise InputError(
                    f"{source}: {prefix}{f.name} is {value:g}, but must lie between {low:g} and {high:g}."
                )
