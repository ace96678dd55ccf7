"""The table and the picture of `accuracy_and_time.py`: means and ranges over seeds, differences, the Pareto front."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context

from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure

DEFAULT = "default"
"""Name of the row that the others are compared with."""
CAPTURE_SECONDS = 120
"""Of a view at the instrument: a SPECIM IQ takes about two minutes."""
CLOSEST_TICKS = 1.4
"""Ratio of two training times whose labels would touch."""

TITLES = (
    *("part", "", "training, s", "steps", "memory, MiB", "SAM, rad", "RMSE", "without the noise: SAM"),
    *(" RMSE", "F at 2 mm, %", "F at 0.5 mm, %", "area, %", "volume, %", "spots, %", "bruise, %"),
    *("beside the default", "front"),
)
_SHOWN = {  # figure: digits after the point; the last eight are against the truth
    "sam": 4,
    "rmse": 4,
    "clean_sam": 4,
    "clean_rmse": 4,
    "f_2_mm": 1,
    "f_half_mm": 1,
    "area_percent": 2,
    "volume_percent": 2,
    "spots_percent": 1,
    "bruise_percent": 1,
}


def table_rows(part: str, found: Mapping[str, Sequence[Mapping[str, float]]]) -> list[list[str]]:
    """A row of the table for each name: means and ranges over the seeds."""
    front = pareto_front(
        {
            name: (_mean(runs, "seconds"), _mean(runs, "memory_mib"), _mean(runs, "clean_sam"))
            for name, runs in found.items()
        }
    )
    rows = []
    for name, runs in found.items():
        cells = [f"{_mean(runs, figure):.0f}" for figure in ("seconds", "steps", "memory_mib")]
        cells += [
            mean_and_range([run[figure] for run in runs], digits) if figure in runs[0] else ""
            for figure, digits in _SHOWN.items()
        ]
        beside = "" if DEFAULT not in found else difference(runs, found[DEFAULT])
        rows.append([part, name, *cells, beside, "yes" if name in front else ""])
    return rows


def _mean(runs: Sequence[Mapping[str, float]], figure: str) -> float:
    return float(np.mean([run[figure] for run in runs]))


def mean_and_range(values: Sequence[float], digits: int) -> str:
    """The mean, and the least and the largest of more than one."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def difference(runs: Sequence[Mapping[str, float]], default: Sequence[Mapping[str, float]]) -> str:
    """Change of the error against noise-free views, where the ranges of the seeds do not overlap.

    Example:
        >>> difference([{"clean_sam": 0.02, "clean_rmse": 0.01}], [{"clean_sam": 0.01, "clean_rmse": 0.01}])
        'SAM +100 %'
    """
    told = []
    for figure, title in (("clean_sam", "SAM"), ("clean_rmse", "RMSE")):
        mine, others = ([run[figure] for run in one] for one in (runs, default))
        if min(mine) > max(others) or max(mine) < min(others):
            told.append(f"{title} {100.0 * (np.mean(mine) / np.mean(others) - 1.0):+.0f} %")
    return ", ".join(told) or "none"


@rc_context(STYLE)
def draw_front(path: Path, rows: Sequence[Sequence[str]]) -> None:
    """Error over seconds of training, and surface and spectra over minutes at the instrument.

    Args:
        path: of the PNG file.
        rows: of the CSV file.
    """
    figure = new_figure(11.0, 4.2)
    by_time, by_views = figure.subplots(1, 2)
    column = {title: TITLES.index(title) for title in TITLES}
    by_seconds = sorted(rows, key=lambda row: parse_range(row[column["training, s"]])[0])

    def ranges(title: str, *parts: str) -> np.ndarray:
        """Mean, least and largest, a row of the parts, by training time."""
        return np.array([parse_range(row[column[title]]) for row in by_seconds if row[0] in parts])

    def curve(axes: Any, at: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
        spread = np.abs(values[:, 1:] - values[:, :1]).T
        axes.errorbar(at, values[:, 0], spread, color=colour, marker="o", markersize=4, capsize=2, label=label)

    runs = ("budgets", "presets")
    seconds = ranges("training, s", *runs)[:, 0]
    curve(by_time, seconds, ranges("without the noise: SAM", *runs), COLOURS[0], "SAM (rad), default")
    curve(by_time, seconds, ranges(" RMSE", *runs), COLOURS[1], "RMSE, default")
    for title, colour in (("without the noise: SAM", COLOURS[0]), (" RMSE", COLOURS[1])):
        at, others = (ranges(name, "settings")[:, 0] for name in ("training, s", title))
        by_time.plot(at, others, "x", color=colour, markersize=4, label=f"{title.split()[-1]}, one setting changed")
    by_time.set(xscale="log", yscale="log", xlabel="training (s of one core)", ylabel="error without the noise")
    ticks: list[float] = []
    for second in seconds:
        if not ticks or second > CLOSEST_TICKS * ticks[-1]:
            ticks.append(second)
    by_time.set_xticks(ticks, [f"{second:.0f}" for second in ticks])
    for name, second, error in zip(
        [row[1] for row in by_seconds if row[0] == "presets"],
        ranges("training, s", "presets")[:, 0],
        np.maximum(*(ranges(name, "presets")[:, 0] for name in ("without the noise: SAM", " RMSE"))),
        strict=True,
    ):
        by_time.annotate(name, (second, error), (0, 9), textcoords="offset points", ha="center", fontsize=8)
    errors_drawn = (0.01, 0.02, 0.03, 0.04)
    by_time.set_yticks(errors_drawn, [f"{error:g}" for error in errors_drawn])
    by_time.minorticks_off()
    by_time.legend(fontsize=7)

    minutes = np.array([int(row[1].split()[0]) for row in by_seconds if row[0] == "views"]) * CAPTURE_SECONDS / 60.0
    curve(by_views, minutes, ranges("F at 0.5 mm, %", "views"), COLOURS[2], "F-score at 0.5 mm (%)")
    by_views.set(xscale="log", xlabel="capture (min, two minutes a view)", ylabel="F-score (%)", xticks=minutes)
    by_views.set_xticks(minutes, [f"{minute:.0f}" for minute in minutes])
    by_views.minorticks_off()
    errors = by_views.twinx()
    errors.grid(visible=False)
    curve(errors, minutes, np.abs(ranges("volume, %", "views")), COLOURS[3], "error of the volume (%)")
    curve(errors, minutes, 100.0 * ranges(" RMSE", "views"), COLOURS[1], "RMSE without the noise (% reflectance)")
    errors.set(ylabel="error (%)", ylim=(0.0, None))
    drawn = map(list.__add__, by_views.get_legend_handles_labels(), errors.get_legend_handles_labels())
    by_views.legend(*drawn, fontsize=7, loc="upper right", bbox_to_anchor=(1.0, 0.76))
    save_figure(figure, path)


def parse_range(cell: str) -> tuple[float, float, float]:
    """Mean, least and largest of `mean_and_range`.

    Example:
        >>> parse_range("1.5 (1.0 to 2.0)"), parse_range("3")
        ((1.5, 1.0, 2.0), (3.0, 3.0, 3.0))
    """
    numbers = [float(number) for number in re.findall(r"[-+]?[0-9.]+", cell)]
    return (numbers[0], numbers[0], numbers[0]) if len(numbers) == 1 else (numbers[0], numbers[1], numbers[2])


def pareto_front(costs: Mapping[str, tuple[float, ...]]) -> set[str]:
    """Names whose costs no other name has all at most, and one less.

    Example:
        >>> sorted(pareto_front({"a": (1.0, 3.0), "b": (2.0, 2.0), "c": (2.0, 3.0)}))
        ['a', 'b']
    """

    def dominates(other: tuple[float, ...], mine: tuple[float, ...]) -> bool:
        return all(o <= m for o, m in zip(other, mine, strict=True)) and other != mine

    return {name for name, mine in costs.items() if not any(dominates(other, mine) for other in costs.values())}
