"""A comparison's results: tables on the screen and in Markdown, JSON, pictures, the cloud with its distances."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyElement
from rich.table import Table

from hsi_sc_nerf import __version__, paper
from hsi_sc_nerf.evaluation.comparison import Comparison
from hsi_sc_nerf.evaluation.comparison_pictures import (
    colour_limit_m,
    distance_colours,
    draw_curves,
    draw_distances,
)
from hsi_sc_nerf.evaluation.spatial import distance_statistics, score_at, threshold_for_m
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.tables import markdown_table, screen_table

_SCORE_TITLES = ["threshold, mm", "precision, %", "recall, %", "F-score, %"]
_DISTANCE_TITLES = ["distance, mm", "mean", "median", "RMS", "95th percentile", "largest"]
_REACHED_PERCENT = (90.0, 95.0, 99.0)


def score_rows(comparison: Comparison) -> list[list[str]]:
    """Precision, recall and F-score at the chosen threshold and at the knee."""
    chosen_m = comparison.config.threshold_m
    chosen = " (the paper's)" if chosen_m == paper.F_SCORE_THRESHOLD_M else " (chosen)"
    rows = []
    for threshold_m, label in ((chosen_m, chosen), (comparison.best_threshold_m, " (knee)")):
        score = score_at(comparison.to_reference_m, comparison.to_cloud_m, threshold_m)
        figures = (f"{percent:.2f}" for percent in (score.precision, score.recall, score.f_score))
        rows.append([f"{1000 * threshold_m:.2f}{label}", *figures])
    return rows


def distance_rows(comparison: Comparison) -> list[list[str]]:
    """Statistics of the distances, both ways."""
    return [
        [label, *(f"{1000 * value:.3f}" for value in asdict(distance_statistics(distances)).values())]
        for label, distances in (
            ("cloud to reference", comparison.to_reference_m),
            ("reference to cloud", comparison.to_cloud_m),
        )
    ]


def screen_tables(comparison: Comparison) -> list[Table]:
    """The tables for a terminal."""
    return [
        screen_table(_SCORE_TITLES, score_rows(comparison)),
        screen_table(_DISTANCE_TITLES, distance_rows(comparison)),
    ]


def summary(comparison: Comparison) -> dict[str, Any]:
    """Every figure, in metres and percent, as JSON takes it."""
    forth, back = comparison.to_reference_m, comparison.to_cloud_m
    curves = {key: values.tolist() for key, values in asdict(comparison.curves).items()}
    return {
        "scores": {
            name: {"threshold_m": threshold_m, **asdict(score_at(forth, back, threshold_m))}
            for name, threshold_m in (
                ("chosen", comparison.config.threshold_m),
                ("knee", comparison.best_threshold_m),
            )
        },
        "f_score_reaches": {
            f"{percent:g}_percent_m": threshold_for_m(forth, back, percent) for percent in _REACHED_PERCENT
        },
        "cloud_to_reference": {"points": len(forth), **asdict(distance_statistics(forth))},
        "reference_to_cloud": {"points": len(back), **asdict(distance_statistics(back))},
        "alignment": _alignment(comparison),
        "seen_fraction_of_reference": comparison.seen_fraction,
        "settings": asdict(comparison.config),
        "curves": curves,
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
        "matched_rms_m": distance_statistics(matched).rms_m if len(matched) else None,
    }


def write_comparison(folder: Path, comparison: Comparison, cloud_name: str, reference_name: str) -> None:
    """``comparison.md``, ``comparison.json``, ``curves.png``, ``distances.png`` and ``distances.ply``, all or none.

    Raises:
        InputError: the operating system refused to write.
    """
    names = ("comparison.md", "comparison.json", "curves.png", "distances.png", "distances.ply")
    limit_m = colour_limit_m(comparison.to_reference_m, comparison.to_cloud_m)
    figures = summary(comparison)
    with atomic_write(*(folder / name for name in names)) as (page, numbers, curves, pictures, cloud):
        write_json(numbers, {"cloud": cloud_name, "reference": reference_name, **figures})
        knee, chosen = (
            (figures["scores"][name]["threshold_m"], figures["scores"][name]["f_score"])
            for name in ("knee", "chosen")
        )
        draw_curves(curves, comparison.curves, knee, chosen)
        shapes = [
            ("cloud", comparison.cloud.points_m, comparison.to_reference_m),
            ("reference", comparison.reference.points_m, comparison.to_cloud_m),
        ]
        draw_distances(pictures, shapes, limit_m)
        write_distance_ply(cloud, comparison.cloud.points_m, comparison.to_reference_m, limit_m)
        page.write_text(_page(comparison, figures, cloud_name, reference_name, limit_m), encoding="utf-8")


def write_distance_ply(
    path: Path, points_m: Float[np.ndarray, "n 3"], distances_m: Float[np.ndarray, "n"], limit_m: float
) -> None:
    """Points with their distance as colour and as ``scalar_distance_m``, a scalar field in CloudCompare."""
    columns = [*((axis, "f4") for axis in "xyz"), ("scalar_distance_m", "f4")]
    columns[3:3] = [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points_m), columns)
    for name, values in zip("xyz", points_m.T, strict=True):
        vertices[name] = values
    for name, values in zip(("red", "green", "blue"), distance_colours(distances_m, limit_m).T, strict=True):
        vertices[name] = values
    vertices["scalar_distance_m"] = distances_m
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))


def _page(
    comparison: Comparison, figures: dict[str, Any], cloud_name: str, reference_name: str, limit_m: float
) -> str:
    reached = ", ".join(
        f"{percent:g} % at {1000 * figures['f_score_reaches'][f'{percent:g}_percent_m']:.2f} mm"
        for percent in _REACHED_PERCENT
    )
    return f"""# {cloud_name} against {reference_name}

{markdown_table(_SCORE_TITLES, score_rows(comparison))}

The F-score reaches {reached}. It never falls as the threshold grows; the knee is where it stops rising steeply, seen
from 0 to {1000 * comparison.config.largest_threshold_m:g} mm.

{markdown_table(_DISTANCE_TITLES, distance_rows(comparison))}

{_alignment_sentences(figures["alignment"])} {_distances_sentence(comparison)}{_seen_sentence(comparison)}

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
        f"{100 * alignment['matched_fraction']:.1f} % of its points within {1000 * alignment['within_m']:.2f} mm."
        f"{ambiguous}"
    )


def _distances_sentence(comparison: Comparison) -> str:
    targets = [
        f"to the nearest of {name}'s points" if surface.triangles is None else f"to {name}'s surface (triangles)"
        for name, surface in (("the reference", comparison.reference), ("the cloud", comparison.cloud))
    ]
    return f"Distances are {targets[0]} and {targets[1]}."


def _seen_sentence(comparison: Comparison) -> str:
    if comparison.seen_fraction is None:
        return ""
    return (
        f" Recall counts the {100 * comparison.seen_fraction:.1f} % of the true surface that some view sees; "
        "distances of the cloud are to all of it."
    )
