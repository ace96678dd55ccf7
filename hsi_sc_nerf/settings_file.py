"""Typed reader of settings files: fills dataclasses from YAML values and checks keys, types and ranges.

Every error is one sentence that names the file and the key.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from hsi_sc_nerf.errors import InputError, shown

_DEEPEST = 20
"""Settings are nested a few times; thousands of levels are an attack or damage."""
_LARGEST_NUMBER = {int: 2**63, float: math.inf}


def between(low: float, high: float, **kwargs: Any) -> Any:
    """A dataclass field whose value, or each of them, must lie in [low, high]; ``high`` may be infinite."""
    return field(metadata={"range": (low, high)}, **kwargs)


def read_yaml(text: str, source: str) -> Any:
    """The content of a YAML text of plain values: no types of a program, no references, no deep nesting.

    References can make a short text stand for more values than fit into memory.

    Raises:
        InputError: it is no such text.
    """
    depth = 0
    try:
        for event in yaml.parse(text, yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST or isinstance(event, yaml.AliasEvent):
                raise ValueError("it refers to its own parts" if depth <= _DEEPEST else "it is nested too deeply")
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{source}: not valid YAML ({error}); correct that line.") from error


def read_dataclass(cls: Any, values: Any, source: str, prefix: str) -> Any:
    """Fill a dataclass from a mapping and check its keys and types.

    Args:
        cls: the dataclass; fields may be numbers, texts, paths, literals, tuples, optional values, dataclasses, or
            unions of dataclasses whose first field is a literal that tells them apart.
        values: content of the file or of one of its keys.
        prefix: path of keys down to ``values``, with a dot at its end; empty for the whole file.

    Raises:
        InputError: an unknown or missing key, or a value of the wrong type.

    Example:
        >>> read_dataclass(MarkerSettings, {"side_m": 0.036}, "scene.yaml", "markers.").side_m
        0.036
    """
    where = prefix.rstrip(".") or "the file"
    if not isinstance(values, dict):
        raise InputError(f"{source}: {where} must hold `key: value` lines, not {shown(values)}.")
    fields = {f.name: f for f in dataclasses.fields(cls)}
    for key in values:
        if key not in fields:
            name = key if isinstance(key, str) else shown(key)
            raise InputError(f"{source}: {prefix}{name} is not a known key; known here are {', '.join(fields)}.")
    for key, f in fields.items():
        if key not in values and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise InputError(f"{source}: {prefix}{key} is missing; add it.")
    hints = get_type_hints(cls)
    return cls(**{key: _read_value(hints[key], value, source, prefix + key) for key, value in values.items()})


def _read_value(expected: Any, value: Any, source: str, key: str) -> Any:
    """Check one value against its declared type; integers are accepted as floats, lists become tuples."""
    if get_origin(expected) is dict:
        return value
    if get_origin(expected) in (Union, types.UnionType):
        expected = _union_member(expected, value, source, key)
    if dataclasses.is_dataclass(expected):
        return read_dataclass(expected, value, source, key + ".")
    if get_origin(expected) is Literal:
        if not isinstance(value, str) or value not in get_args(expected):
            raise InputError(
                f"{source}: {key} is {shown(value)}, but must be one of {', '.join(get_args(expected))}."
            )
        return value
    if get_origin(expected) is tuple:
        if not isinstance(value, list):
            raise InputError(f"{source}: {key} is {shown(value)}, but must be a list.")
        (item,) = {*get_args(expected)} - {Ellipsis}
        return tuple(
            value if item is Any else (_read_value(item, v, source, f"{key}[{i}]") for i, v in enumerate(value))
        )
    kind, accepted = {
        float: ("a number", (int, float)),
        int: ("a whole number", (int,)),
        str: ("a text", (str,)),
        Path: ("a path", (str,)),
    }[expected]
    usable = isinstance(value, accepted) and not isinstance(value, bool)
    # Larger integers are no floats, and larger floats are infinite.
    if not usable or (isinstance(value, int | float) and not abs(value) < _LARGEST_NUMBER[type(value)]):
        raise InputError(f"{source}: {key} is {shown(value)}, but must be {kind}.")
    return expected(value)


def _union_member(union: Any, value: Any, source: str, key: str) -> Any:
    """The type of a union to which a value belongs: of dataclasses the one whose first field allows the value's."""
    kinds = [kind for kind in get_args(union) if kind is not types.NoneType]
    if len(kinds) == 1:
        return kinds[0]
    (name,) = {dataclasses.fields(kind)[0].name for kind in kinds}
    allowed = {choice: kind for kind in kinds for choice in get_args(get_type_hints(kind)[name])}
    if not isinstance(value, dict):
        return kinds[0]
    if name not in value:
        raise InputError(f"{source}: {key}.{name} is missing; add it.")
    _read_value(Literal[tuple(allowed)], value[name], source, f"{key}.{name}")
    return allowed[value[name]]


def check_ranges(values: Any, source: str, prefix: str) -> None:
    """Check the ranges of fields made by `between`, also of nested dataclasses; arguments as in `read_dataclass`.

    Raises:
        InputError: a value lies outside its range.
    """
    for name, value, limits in _outside_range(values, prefix):
        raise InputError(f"{source}: {name} is {value:g}, but must {limits}.")


def check_options(command: Any) -> None:
    """Check the ranges of a command's options, which are fields made by `between`.

    Raises:
        InputError: an option lies outside its range.
    """
    for name, value, limits in _outside_range(command, "--"):
        raise InputError(f"{name.replace('_', '-')} is {value}; it must {limits}.")


def _outside_range(values: Any, prefix: str) -> Iterator[tuple[str, float, str]]:
    """Name, value and description of the range of each field outside its range."""
    for f in dataclasses.fields(values):
        value = getattr(values, f.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from _outside_range(value, f"{prefix}{f.name}.")
        elif "range" in f.metadata and value is not None:
            low, high = f.metadata["range"]
            limits = f"lie between {low:g} and {high:g}" if high < math.inf else f"be at least {low:g}"
            for one in value if isinstance(value, tuple) else (value,):
                # Written so that NaN fails as well.
                if not low <= one <= high:
                    yield prefix + f.name, one, limits
