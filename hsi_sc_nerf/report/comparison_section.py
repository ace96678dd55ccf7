"""Section on the geometry: what `hsi-sc-nerf compare` found."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.report.blocks import Block, Figure, Folded, KeyFigure, Missing, Section, Table
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.embed import embedded_file

_MM_PER_M = 1000.0
_CURVES = {"precision": "precision", "recall": "recall", "f_score": "F-score"}
_SCORES = {"chosen": "at the chosen threshold", "knee": "at the knee of the F-score"}
_DISTANCES = {"cloud_to_reference": "cloud to reference", "reference_to_cloud": "reference to cloud"}
_STATISTICS = {"mean_m": "mean", "median_m": "median", "rms_m": "RMS", "percentile_95_m": "95th percentile"}
_COMMAND = "hsi-sc-nerf compare CLOUD.ply REFERENCE --output-dir RUN"


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
        return Section("comparison", title, [Missing("The geometry was not compared with a reference.", _COMMAND)])
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
            "Precision: share of the cloud within the threshold of the reference. Recall: the converse.",
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
