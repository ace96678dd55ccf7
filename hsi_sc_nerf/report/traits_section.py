"""Section on the object's traits: what `hsi-sc-nerf traits` found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.report.blocks import Block, Folded, Missing, Section, Table

_UNITS = {"m": "m", "m2": "m²", "l": "L", "rad": "rad", "deg": "°", "nm": "nm", "percent": "%"}
_COMMAND = "hsi-sc-nerf traits CLOUD.ply --output-dir RUN"
# What the user named: keys in these are no words of ours, whatever they end in or hold.
_NAMES_IN = ("regions", "areas_m2", "mixture_areas_m2")
# How traits were measured is no trait.
_NOT_SHOWN = ("settings", "version")

Row = tuple[str, str, str, str]


def traits_section(traits: Mapping[str, Any] | None, source: Path | None = None) -> Section:
    """Whatever was found of the object's shape and spectra.

    Args:
        traits: what ``traits.json`` holds; None where there is none.
        source: that file, for the error's text.

    Raises:
        InputError: the file holds nothing that could be shown.
    """
    if traits is None:
        return Section("traits", "Traits", [Missing("The object's traits were not measured.", _COMMAND)])
    shown = {key: part for key, part in traits.items() if key not in _NOT_SHOWN}
    everything, summary = list(trait_rows(shown)), list(trait_rows(_without_lists(shown)))
    if not everything:
        raise InputError(f"{source}: holds no traits; make it again with `hsi-sc-nerf traits`.")
    caption = "±: standard deviation, over resampled points for sizes and over the surface for spectra."
    header = ("", "value", "±", "unit")
    blocks: list[Block] = [Table(caption, header, summary)]
    if len(everything) > len(summary):
        blocks.append(Folded("All entries, each region by itself", [Table(caption, header, everything)]))
    return Section("traits", "Traits", blocks)


def _without_lists(content: Any) -> Any:
    """Nested mappings without what they hold in lists of mappings."""
    if not isinstance(content, Mapping):
        return content
    parts = {key: part for key, part in content.items() if not _lists_mappings(part)}
    return {key: _without_lists(part) for key, part in parts.items()}


def _lists_mappings(content: Any) -> bool:
    return isinstance(content, list) and any(isinstance(part, Mapping) for part in content)


def trait_rows(
    content: Any, words: tuple[str, ...] = (), unit: str = "", spread: Any = None, named: bool = False
) -> Iterator[Row]:
    """Name, value, uncertainty and unit of everything in nested JSON.

    An entry is a mapping with ``value`` (and perhaps ``uncertainty``, ``unit``, ``name``) or with ``mean`` and
    ``sd``, or it is a bare value. What a mapping has under ``KEY_sd`` is the spread of what it has under ``KEY``. A
    value's unit is the end of the innermost key that ends in one. What is null is left out.

    Args:
        content: the JSON.
        words: that lead to it.
        unit: of what leads to it.
        spread: of the same shape as ``content``, or None.
        named: whether the keys of ``content`` are names that the user gave to regions and classes.
    """
    if named:
        for name, part in content.items():
            yield from trait_rows(part, (*words, name), unit)
    elif isinstance(content, Mapping) and content.keys() & {"value", "mean"}:
        value, sd = content.get("value", content.get("mean")), content.get("uncertainty", content.get("sd"))
        name = str(content.get("name", ", ".join(words)))
        yield name, _text(value), _text(sd), str(content.get("unit", unit))
    elif isinstance(content, Mapping):
        for key, part in content.items():
            if not (key.endswith("_sd") and key.removesuffix("_sd") in content):
                inner = spread.get(key) if isinstance(spread, Mapping) else content.get(f"{key}_sd")
                word, own = _split(key)
                holds_names = key in _NAMES_IN and isinstance(part, Mapping)
                yield from trait_rows(part, (*words, word), own or unit, inner, holds_names)
    elif _lists_mappings(content):
        for number, part in enumerate(content, start=1):
            label = f"{part['label']} {number}" if isinstance(part, Mapping) and "label" in part else str(number)
            yield from trait_rows(part, (*words, label), unit)
    elif content is not None:
        yield ", ".join(words), _text(content), _text(spread), unit


def _split(key: str) -> tuple[str, str]:
    """A key as words, and the unit that it ends in."""
    stem, _, end = key.rpartition("_")
    word, unit = (stem, _UNITS[end]) if stem and end in _UNITS else (key, "")
    return word.replace("_", " "), unit


def _text(value: Any) -> str:
    """Numbers with four digits, lists with commas, nothing for nothing."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(_text(part) for part in value)
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "-"
    return str(value)
