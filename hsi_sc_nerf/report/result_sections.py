"""Sections on the geometry (`hsi-sc-nerf compare`) and the traits (`hsi-sc-nerf traits`)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.page import Block, Figure, Folded, KeyFigure, Missing, Section, Table, embedded_file

_MM_PER_M = 1000.0
_CURVES = {"precision": "precision", "recall": "recall", "f_score": "F-score"}
_SCORES = {"chosen": "at the chosen threshold", "knee": "at the knee of the F-score"}
_DISTANCES = {"cloud_to_reference": "cloud to reference", "reference_to_cloud": "reference to cloud"}
_STATISTICS = {"mean_m": "mean", "median_m": "median", "rms_m": "RMS", "percentile_95_m": "95th percentile"}
_COMPARE_COMMAND = "hsi-sc-nerf compare CLOUD.ply REFERENCE --output-dir RUN"
_UNITS = {"m": "m", "m2": "m²", "l": "L", "rad": "rad", "deg": "°", "nm": "nm", "percent": "%"}
_TRAITS_COMMAND = "hsi-sc-nerf traits CLOUD.ply --output-dir RUN"
# What the user named: keys in these are no words of ours, whatever they end in or hold.
_NAMES_IN = ("regions", "areas_m2", "mixture_areas_m2")
# How traits were measured is no trait.
_NOT_SHOWN = ("settings", "version")
Row = tuple[str, str, str, str]


def comparison_section(comparison: Mapping[str, Any] | None, source: Path | None = None) -> Section:
    """Precision, recall and F-score over the distance threshold (paper, section "Spatial Evaluation Metrics").

    Args:
        comparison: what ``comparison.json`` holds; None where there is none.
        source: that file. The picture ``distances.png`` beside it is shown as well.

    Raises:
        InputError: the file lacks what it should hold.
    """
    title = "Precision and recall"
    if comparison is None:
        return Section(
            "comparison", title, [Missing("The geometry was not compared with a reference.", _COMPARE_COMMAND)]
        )
    try:
        blocks = _blocks(comparison)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{source}: is no comparison ({error}); make one with `hsi-sc-nerf compare`.") from error
    picture = None if source is None else source.with_name("distances.png")
    if picture is not None and picture.is_file():
        alt = "The cloud and the reference, coloured by the distance to the other"
        blocks.append(Folded("Where the distances are", [Figure([embedded_file(picture, alt)], f"{alt}.")]))
    return Section("comparison", title, blocks)


def comparison_key_figure(comparison: Mapping[str, Any]) -> KeyFigure:
    """The F-score at the chosen threshold, for the head of the page."""
    score = comparison["scores"]["chosen"]
    return KeyFigure(f"{score['f_score']:.1f} %", f"F-score at {_MM_PER_M * score['threshold_m']:.1f} mm")


def _blocks(comparison: Mapping[str, Any]) -> list[Block]:
    found, scores = comparison["curves"], comparison["scores"]
    thresholds_mm = _MM_PER_M * np.array(found["thresholds_m"], float)
    curves = [Curve(name, thresholds_mm, _as_long(found[key], thresholds_mm)) for key, name in _CURVES.items()]
    marks_mm = {key: _MM_PER_M * float(scores[key]["threshold_m"]) for key in _SCORES}
    chart = line_chart(
        curves,
        x_label="distance threshold (mm)",
        y_label="per cent",
        alt="Precision, recall and F-score over the distance threshold",
        from_zero=True,
        marks={f"{key} {at:.2f} mm": at for key, at in marks_mm.items()},
    )
    score_rows = [
        (f"{name}, {marks_mm[key]:.2f} mm", *(f"{float(scores[key][measure]):.2f} %" for measure in _CURVES))
        for key, name in _SCORES.items()
    ]
    distance_rows = [
        (name, *(f"{_MM_PER_M * float(comparison[key][statistic]):.3f}" for statistic in _STATISTICS))
        for key, name in _DISTANCES.items()
        if key in comparison
    ]
    return [
        Table(
            "Precision: fraction of the cloud within the threshold of the reference. Recall: the converse.",
            ("", *_CURVES.values()),
            score_rows,
        ),
        Figure([chart], "Precision, recall and F-score over the distance threshold, per cent."),
        Table("Distances, mm.", ("", *_STATISTICS.values()), distance_rows),
    ]


def _as_long(values: Any, as_these: np.ndarray) -> np.ndarray:
    array = np.array(values, float)
    if array.shape != as_these.shape:
        raise ValueError("a curve has not as many values as thresholds")
    return array


def traits_section(traits: Mapping[str, Any] | None, source: Path | None = None) -> Section:
    """Whatever was found of the object's shape and spectra.

    Args:
        traits: what ``traits.json`` holds; None where there is none.
        source: that file, for the error's text.

    Raises:
        InputError: the file holds nothing that could be shown.
    """
    if traits is None:
        return Section("traits", "Traits", [Missing("The object's traits were not measured.", _TRAITS_COMMAND)])
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
