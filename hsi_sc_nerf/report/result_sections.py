"""Sections on the geometry (`hsi-sc-nerf compare`) and the traits (`hsi-sc-nerf traits`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf.analysis.report import trait_tables
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison_report import comparison_tables
from hsi_sc_nerf.findings import Finding, judged
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.page import Block, Figure, Folded, Missing, Section, Table, embedded_file

_MM_PER_M = 1000.0
_CURVES = {"precision": "precision", "recall": "recall", "f_score": "F-score"}
# What reading figures from another content, however damaged, ends in.
_WRONG_CONTENT = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError, ZeroDivisionError)
_F_SCORE_MISSING_PERCENT = (10.0, 30.0)
_UNSEEN_FRACTION = 0.15
_DRAWN_THRESHOLDS = 2.0
"""Curves end at this many times the largest threshold of interest."""


def comparison_section(comparison: Mapping[str, Any] | None, source: Path) -> Section:
    """Precision, recall and F-score over the distance threshold (paper, section "Spatial Evaluation Metrics").

    Args:
        comparison: content of ``comparison.json``; None if there is none.
        source: that file. The picture ``distances.png`` beside it is shown as well.

    Raises:
        InputError: the file lacks what it should hold.
    """
    title, blocks = "Precision and recall", list[Block]()
    if comparison is None:
        command = "hsi-sc-nerf compare CLOUD.ply REFERENCE --output-dir RUN"
        return Section("comparison", title, [Missing("The geometry was not compared with a reference.", command)])
    try:
        blocks += _comparison_blocks(comparison)
        findings = judge_comparison(comparison)
    except _WRONG_CONTENT as error:
        raise InputError(f"{source}: is no comparison ({error}); make one with `hsi-sc-nerf compare`.") from error
    picture = source.with_name("distances.png")
    if picture.is_file():
        alt = "The cloud and the reference, coloured by the distance to the other"
        blocks.append(Folded("Where the distances are", [Figure([embedded_file(picture, alt)], f"{alt}.")]))
    return Section("comparison", title, blocks, findings)


def judge_comparison(comparison: Mapping[str, Any]) -> list[Finding]:
    """The F-score at the chosen threshold."""
    score = comparison["scores"]["chosen"]
    missing_percent = 100.0 - float(score["f_score"])
    sentence = (
        f"The F-score at {1000.0 * float(score['threshold_m']):.1f} mm is {100.0 - missing_percent:.1f} % (good from "
        f"{100.0 - _F_SCORE_MISSING_PERCENT[0]:g} %)"
    )
    lower = "precision" if score["precision"] < score["recall"] else "recall"
    return [
        judged("f-score", missing_percent, _F_SCORE_MISSING_PERCENT, sentence, f"{lower} is the lower of the two")
    ]


def comparison_key_figure(comparison: Mapping[str, Any]) -> dict[str, str]:
    """The F-score at the chosen threshold, for the head of the page."""
    score = comparison["scores"]["chosen"]
    return {f"F-score at {_MM_PER_M * score['threshold_m']:.1f} mm": f"{score['f_score']:.1f} %"}


def _comparison_blocks(comparison: Mapping[str, Any]) -> list[Block]:
    found, scores = comparison["curves"], comparison["scores"]
    thresholds_mm = _MM_PER_M * np.array(found["thresholds_m"], float)
    marks_mm = {key: _MM_PER_M * float(scores[key]["threshold_m"]) for key in ("chosen", "knee")}
    drawn = thresholds_mm <= _DRAWN_THRESHOLDS * max(marks_mm.values())
    curves = [
        Curve(name, thresholds_mm[drawn], np.array(found[key], float).reshape(len(thresholds_mm))[drawn])
        for key, name in _CURVES.items()
    ]
    chart = line_chart(
        curves,
        x_label="distance threshold (mm)",
        y_label="per cent",
        alt="Precision, recall and F-score over the distance threshold",
        from_zero=True,
        marks={f"{key} {at:.2f} mm": at for key, at in marks_mm.items()},
    )
    scored, distances = comparison_tables(comparison)
    caption = "Precision: fraction of the cloud within the threshold of the reference. Recall: the converse."
    return [
        Table(caption, *scored),
        Figure([chart], "Precision, recall and F-score over the distance threshold, per cent."),
        Table("Distances, mm.", *distances),
    ]


def traits_section(traits: Mapping[str, Any] | None, source: Path) -> Section:
    """The object's traits, in the tables of ``traits.md``.

    Args:
        traits: content of ``traits.json``; None if there is none.
        source: that file, for the error's text.

    Raises:
        InputError: the file holds no traits.
    """
    if traits is None:
        command = "hsi-sc-nerf traits CLOUD.ply --output-dir RUN"
        return Section("traits", "Traits", [Missing("The object's traits were not measured.", command)])
    try:
        tables, findings = trait_tables(traits), judge_traits(traits)
    except _WRONG_CONTENT as error:
        raise InputError(f"{source}: holds no traits ({error}); make it again with `hsi-sc-nerf traits`.") from error
    blocks = [Table(f"{table.heading}. {table.note}", table.header, table.rows) for table in tables]
    return Section("traits", "Traits", blocks, findings)


def judge_traits(traits: Mapping[str, Any]) -> list[Finding]:
    """Whether the mesh encloses a volume, and how much of it was not seen."""
    if not traits["watertight"]:
        return [Finding("watertight", "red", "The mesh has holes, so its volume cannot be trusted; mesh it anew.")]
    fraction = 1.0 - traits["seen_area_m2"] / traits["size"]["area_m2"]
    sentence = (
        f"The mesh is closed; {100.0 * fraction:.1f} % of its area was not seen (good up to "
        f"{100.0 * _UNSEEN_FRACTION:.0f} %)"
    )
    advice = "give the container's height (--data), and see which side was not seen"
    return [judged("closed-area", fraction, (_UNSEEN_FRACTION, np.inf), sentence, advice)]
