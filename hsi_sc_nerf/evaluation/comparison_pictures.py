"""A comparison as pictures: curves over the threshold, and both shapes coloured by distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection

from hsi_sc_nerf.evaluation.spatial import ThresholdCurves
from hsi_sc_nerf.plotting.false_colour import INDEX_COLOURS
from hsi_sc_nerf.plotting.figures import COLOURS, STYLE, new_figure, save_figure

_DRAWN_POINTS = 60_000
# Title, direction of y across and of x towards the viewer; z is up.
_SIDES = (("seen from +x", 1), ("seen from −x", -1))
_PANEL_IN = 2.5


def colour_limit_m(*distances_m: Float[np.ndarray, "n"]) -> float:
    """Where the colours end: the largest 95th percentile, so that a few outliers do not make all the rest dark."""
    return max(float(np.percentile(distances, 95)) for distances in distances_m) or 1e-6


def distance_colours(distances_m: Float[np.ndarray, "n"], limit_m: float) -> UInt8[np.ndarray, "n 3"]:
    """Dark blue at 0 to yellow at the limit and beyond (viridis)."""
    return colormaps[INDEX_COLOURS](np.clip(distances_m / limit_m, 0, 1), bytes=True)[:, :3]


@rc_context(STYLE)
def draw_curves(path: Path, curves: ThresholdCurves, knee: tuple[float, float], chosen: tuple[float, float]) -> None:
    """Precision, recall and F-score over the threshold; the knee dashed, the chosen threshold dotted.

    Args:
        path: The PNG file.
        curves: What to draw.
        knee: Threshold (metres) and F-score (percent) of the curve's knee.
        chosen: Of the threshold that was asked for, which may lie beyond the curves.
    """
    figure = new_figure(6.0, 3.4)
    axes = figure.subplots()
    millimetres = 1000 * curves.thresholds_m
    drawn = {"precision": curves.precision, "recall": curves.recall, "F-score": curves.f_score}
    for (name, values), colour in zip(drawn.items(), COLOURS, strict=False):
        axes.plot(millimetres, values, color=colour, linewidth=2.2 if name == "F-score" else 1.3, label=name)
    for (place_m, score), name, line in ((knee, "knee", "--"), (chosen, "chosen", ":")):
        label = f"{name}: {1000 * place_m:.2f} mm, F-score {score:.1f} %"
        axes.axvline(1000 * place_m, color="black", linestyle=line, linewidth=1.1, label=label)
    axes.set(
        xlabel="distance threshold (mm)",
        ylabel="%",
        xlim=(0, max(millimetres[-1], 1000 * chosen[0])),
        ylim=(0, 102),
    )
    axes.legend(loc="lower right")
    save_figure(figure, path)


@rc_context(STYLE)
def draw_distances(
    path: Path, shapes: Sequence[tuple[str, Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]], limit_m: float
) -> None:
    """Points coloured by distance, each shape from two sides, in parallel projection and to one scale.

    Args:
        path: The PNG file.
        shapes: Title, points and their distances, in metres.
        limit_m: Where the colours end.
    """
    low, high = _extent([points for _, points, _ in shapes])
    width, height = 1000 * (high[1] - low[1]), 1000 * (high[2] - low[2])
    inch_per_mm = _PANEL_IN / max(width, height)
    panels = len(shapes) * len(_SIDES)
    figure = new_figure(panels * (width * inch_per_mm + 0.45) + 1.0, height * inch_per_mm + 0.9)
    rows = figure.subplots(1, panels, squeeze=False, sharey=True)[0]
    for index, (axes, (title, points, distances)) in enumerate(
        zip(rows, (shape for shape in shapes for _ in _SIDES), strict=True)
    ):
        side, sign = _SIDES[index % len(_SIDES)]
        stride = math.ceil(len(points) / _DRAWN_POINTS)
        order = np.argsort(sign * points[::stride, 0])
        # A side shows about half of the points; twice their spacing leaves hardly a gap.
        dot_mm = 2.2 * math.sqrt(2.0 * width * height / len(order))
        drawn = _scatter(
            axes,
            1000 * points[::stride][order][:, 1:],
            1000 * distances[::stride][order],
            1000 * limit_m,
            max(0.6, dot_mm * inch_per_mm * 72) ** 2,
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


def _extent(clouds: Sequence[Float[np.ndarray, "n 3"]]) -> tuple[np.ndarray, np.ndarray]:
    """Of what is drawn, a few outliers left out."""
    low, high = np.percentile(np.concatenate(clouds), (0.1, 99.9), axis=0)
    margin = 0.05 * float((high - low).max())
    return low - margin, high + margin


def _scatter(
    axes: Axes, places: Float[np.ndarray, "n 2"], distances: Float[np.ndarray, "n"], limit: float, size: float
) -> PathCollection:
    axes.set_axisbelow(True)
    across, up = places.T
    return axes.scatter(
        across, up, c=distances, s=size, cmap=INDEX_COLOURS, vmin=0, vmax=limit, linewidths=0, rasterized=True
    )
