"""Results of a comparison: tables, Markdown page, JSON, pictures, and the cloud with its distances."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from plyfile import PlyData

from hsi_sc_nerf import __version__, paper
from hsi_sc_nerf.evaluation.comparison import LARGEST_THRESHOLD_M, Comparison
from hsi_sc_nerf.evaluation.spatial import (
    ThresholdCurves,
    best_threshold_m,
    distance_statistics,
    score_at,
    threshold_for_m,
)
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.geometry.ply_file import ply_vertices
from hsi_sc_nerf.plotting import COLOURS, INDEX_COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.terminal import markdown_table, markdown_text

_STATISTICS = {
    "mean_m": "mean",
    "median_m": "median",
    "rms_m": "RMS",
    "percentile_95_m": "95th percentile",
    "largest_m": "largest",
}
TextTable = tuple[list[str], list[list[str]]]
"""Titles and rows."""
_REACHED_PERCENT = (90.0, 95.0, 99.0)
_DRAWN_POINTS = 60_000
# Title, direction of y across and of x towards the viewer; z is up.
_SIDES = (("seen from +x", 1), ("seen from −x", -1))
_PANEL_IN = 2.5


def comparison_tables(figures: Mapping[str, Any]) -> tuple[TextTable, TextTable]:
    """Precision, recall and F-score at the chosen threshold and at the knee; statistics of the distances both ways.

    Args:
        figures: figures of `comparison_summary`, or the content of ``comparison.json``.

    Raises:
        KeyError, TypeError, ValueError: it is no such content.
    """
    scores = []
    for name, score in figures["scores"].items():
        threshold_m = float(score["threshold_m"])
        label = "the paper's" if name == "chosen" and threshold_m == paper.F_SCORE_THRESHOLD_M else name
        percent = (f"{float(score[key]):.2f}" for key in ("precision", "recall", "f_score"))
        scores.append([f"{1000 * threshold_m:.2f} ({label})", *percent])
    distances = [
        [key.replace("_", " "), *(f"{1000 * float(figures[key][statistic]):.3f}" for statistic in _STATISTICS)]
        for key in ("cloud_to_reference", "reference_to_cloud")
    ]
    titles = ["threshold, mm", "precision, %", "recall, %", "F-score, %"]
    return (titles, scores), (["distance, mm", *_STATISTICS.values()], distances)


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """All figures in metres and percent, for JSON."""
    forth, back = comparison.to_reference_m, comparison.to_cloud_m
    return {
        "scores": {
            name: {"threshold_m": threshold_m, **asdict(score_at(forth, back, threshold_m))}
            for name, threshold_m in (
                ("chosen", comparison.config.threshold_m),
                ("knee", best_threshold_m(comparison.curves)),
            )
        },
        "f_score_reaches": {
            f"{percent:g}_percent_m": threshold_for_m(forth, back, percent) for percent in _REACHED_PERCENT
        },
        "cloud_to_reference": {"points": len(forth), **distance_statistics(forth)},
        "reference_to_cloud": {"points": len(back), **distance_statistics(back)},
        "alignment": _alignment(comparison),
        "seen_fraction_of_reference": comparison.seen_fraction,
        "settings": asdict(comparison.config),
        "curves": {key: values.tolist() for key, values in asdict(comparison.curves).items()},
        "version": __version__,
    }


def _alignment(comparison: Comparison) -> dict[str, Any]:
    registration = comparison.registration
    if registration is None:
        return {"method": comparison.alignment}
    matched = comparison.to_reference_m[comparison.to_reference_m <= registration.within_m]
    return {
        "method": comparison.alignment,
        "cloud_to_reference": registration.transform.matrix().tolist(),
        "turn_deg": registration.transform.turn_deg(),
        "scale": registration.transform.scale,
        "rival": None if registration.rival is None else asdict(registration.rival),
        "within_m": registration.within_m,
        "matched_fraction": len(matched) / len(comparison.to_reference_m),
        "matched_rms_m": distance_statistics(matched)["rms_m"] if len(matched) else None,
    }


def write_comparison(folder: Path, comparison: Comparison, cloud_name: str, reference_name: str) -> dict[str, Any]:
    """``comparison.md``, ``comparison.json``, ``curves.png``, ``distances.png`` and ``distances.ply``, all or none.

    Returns:
        The figures, as `comparison_summary` gives them.

    Raises:
        InputError: the operating system refused to write.
    """
    names = ("comparison.md", "comparison.json", "curves.png", "distances.png", "distances.ply")
    # Colours end at the larger 95th percentile, so that outliers do not darken the rest.
    limit_m = max(float(np.percentile(m, 95)) for m in (comparison.to_reference_m, comparison.to_cloud_m)) or 1e-6
    figures = comparison_summary(comparison)
    with atomic_write(*(folder / name for name in names)) as (page, numbers, curves, pictures, cloud):
        write_json(numbers, {"cloud": cloud_name, "reference": reference_name, **figures})
        _draw_curves(curves, comparison.curves, figures["scores"])
        surfaces = [
            ("cloud", comparison.cloud.points_m, comparison.to_reference_m),
            ("reference", comparison.reference.points_m, comparison.to_cloud_m),
        ]
        _draw_distances(pictures, surfaces, limit_m)
        distances_m = comparison.to_reference_m  # also as a column that is a scalar field in CloudCompare
        colours = colormaps[INDEX_COLOURS](np.clip(distances_m / limit_m, 0, 1), bytes=True)[:, :3]
        columns = dict(zip("xyz", comparison.cloud.points_m.T, strict=True))
        columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
        columns["scalar_distance_m"] = distances_m.astype(np.float32)
        PlyData([ply_vertices(columns)], byte_order="<").write(str(cloud))
        page.write_text(_page(comparison, figures, cloud_name, reference_name, limit_m), encoding="utf-8")
    return figures


def _page(
    comparison: Comparison, figures: dict[str, Any], cloud_name: str, reference_name: str, limit_m: float
) -> str:
    reached = ", ".join(
        f"{percent:g} % at {1000 * figures['f_score_reaches'][f'{percent:g}_percent_m']:.2f} mm"
        for percent in _REACHED_PERCENT
    )
    scores, distances = comparison_tables(figures)
    nearest = [
        f"to the nearest of {name}'s points" if surface.triangles is None else f"to {name}'s surface (triangles)"
        for name, surface in (("the reference", comparison.reference), ("the cloud", comparison.cloud))
    ]
    seen = (
        ""
        if comparison.seen_fraction is None
        else (
            f" Recall counts the {100 * comparison.seen_fraction:.1f} % of the true surface that some view sees; "
            "distances of the cloud are to all of it."
        )
    )
    return f"""# {markdown_text(cloud_name)} against {markdown_text(reference_name)}

{markdown_table(*scores)}

The F-score reaches {reached}. It never falls as the threshold grows; the knee is where it stops rising steeply, seen
from 0 to {1000 * LARGEST_THRESHOLD_M:g} mm.

{markdown_table(*distances)}

{_alignment_sentences(figures["alignment"])} Distances are {" and ".join(nearest)}.{seen}

![Precision, recall and F-score over the distance threshold](curves.png)

![Cloud and reference coloured by distance](distances.png)

Colours end at {1000 * limit_m:.2f} mm. `distances.ply` is the cloud in the reference's frame, with its
`scalar_distance_m`.
"""


def _alignment_sentences(alignment: dict[str, Any]) -> str:
    if alignment["method"] == "none":
        return "The cloud was compared where it lies, without alignment."
    methods = {"features": "features, then ICP", "icp": "ICP"}
    rms = "none" if alignment["matched_rms_m"] is None else f"{1000 * alignment['matched_rms_m']:.3f} mm"
    rival = alignment["rival"]
    ambiguous = (
        ""
        if rival is None
        else f" **Turned by {rival['turn_deg']:.0f} degrees it fits as well** (RMS {1000 * rival['rms_m']:.2f} mm "
        f"against {1000 * rival['taken_rms_m']:.2f} mm): the scores hold for either, but a place on the cloud need "
        "not be that place on the reference."
    )
    return (
        f"The cloud was aligned by {methods[alignment['method']]}: turned by {alignment['turn_deg']:.2f} degrees, "
        f"scaled by {alignment['scale']:.5f}. RMS after ICP: {rms}, of the "
        f"{100 * alignment['matched_fraction']:.1f} % of its points within "
        f"{1000 * alignment['within_m']:.2f} mm.{ambiguous}"
    )


@rc_context(STYLE)
def _draw_curves(path: Path, curves: ThresholdCurves, scores: Mapping[str, Mapping[str, float]]) -> None:
    """Precision, recall and F-score over the threshold; the knee dashed, the chosen threshold dotted.

    Args:
        scores: of `comparison_summary`; the chosen threshold may lie beyond the curves.
    """
    figure = new_figure(6.0, 3.4)
    axes = figure.subplots()
    millimetres = 1000 * curves.thresholds_m
    drawn = {"precision": curves.precision, "recall": curves.recall, "F-score": curves.f_score}
    for (name, values), colour in zip(drawn.items(), COLOURS, strict=False):
        axes.plot(millimetres, values, color=colour, linewidth=2.2 if name == "F-score" else 1.3, label=name)
    for name, line in (("knee", "--"), ("chosen", ":")):
        place_mm = 1000 * scores[name]["threshold_m"]
        label = f"{name}: {place_mm:.2f} mm, F-score {scores[name]['f_score']:.1f} %"
        axes.axvline(place_mm, color="black", linestyle=line, linewidth=1.1, label=label)
    axes.set(xlabel="distance threshold (mm)", ylabel="%", xlim=(0, max(millimetres[-1], place_mm)), ylim=(0, 102))
    axes.legend(loc="lower right")
    save_figure(figure, path)


@rc_context(STYLE)
def _draw_distances(
    path: Path, surfaces: Sequence[tuple[str, Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]], limit_m: float
) -> None:
    """Points coloured by distance, each surface from two sides, in parallel projection and to one scale.

    Args:
        surfaces: title, points and their distances, in metres.
    """
    low, high = np.percentile(np.concatenate([points for _, points, _ in surfaces]), (0.1, 99.9), axis=0)
    margin_m = 0.05 * float((high - low).max())
    low, high = low - margin_m, high + margin_m
    width, height = 1000 * (high[1] - low[1]), 1000 * (high[2] - low[2])
    inch_per_mm = _PANEL_IN / max(width, height)
    panels = len(surfaces) * len(_SIDES)
    figure = new_figure(panels * (width * inch_per_mm + 0.45) + 1.0, height * inch_per_mm + 1.3)
    rows = figure.subplots(1, panels, squeeze=False, sharey=True)[0]
    for index, (axes, (title, points, distances)) in enumerate(
        zip(rows, (surface for surface in surfaces for _ in _SIDES), strict=True)
    ):
        side, sign = _SIDES[index % len(_SIDES)]
        stride = math.ceil(len(points) / _DRAWN_POINTS)
        order = np.argsort(sign * points[::stride, 0])
        # Each side shows about half of the points; dots of twice their spacing leave few gaps.
        dot_mm = 2.2 * math.sqrt(2.0 * width * height / len(order))
        drawn = axes.scatter(
            *(1000 * points[::stride][order][:, 1:].T),
            c=1000 * distances[::stride][order],
            s=max(0.6, dot_mm * inch_per_mm * 72) ** 2,
            cmap=INDEX_COLOURS,
            vmin=0,
            vmax=1000 * limit_m,
            linewidths=0,
            rasterized=True,
        )
        axes.set(
            title=f"{title},\n{side}",
            xlabel="y (mm)",
            xlim=(1000 * low[1], 1000 * high[1])[::sign],
            ylim=(1000 * low[2], 1000 * high[2]),
            aspect="equal",
        )
    rows[0].set_ylabel("z (mm)")
    figure.colorbar(drawn, ax=rows.tolist(), label="distance (mm)", extend="max", fraction=0.05, pad=0.01)
    save_figure(figure, path)
