"""The benchmark's results: CSV, JSON, tables on the screen and in Markdown."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import LogLocator

from hsi_sc_nerf.benchmark.run import BenchmarkRun
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.models.schedule import Clock
from hsi_sc_nerf.plotting import COLOURS, STYLE, logarithmic_axis, new_figure, save_figure
from hsi_sc_nerf.terminal import markdown_table

_COLUMNS = {
    "configuration": "{name}",
    "stage": "{stage}",
    "iterations": "{iteration}",
    "set up, s": "{setup_seconds:.0f}",
    "train, s": "{train_seconds:.0f}",
    "CPU, s": "{cpu_seconds:.0f}",
    "SAM, rad": "{sam:.4f}",
    "RMSE": "{rmse:.4f}",
    "SSIM": "{ssim:.3f}",
    "PSNR, dB": "{psnr:.2f}",
    "whole frame: SAM": "{full_sam:.4f}",
    "PSNR, dB ": "{full_psnr:.2f}",
    "memory, MiB": "{peak_memory_mib:.0f}",
}
_PANELS = {"sam": "SAM (rad)", "rmse": "RMSE", "psnr": "PSNR (dB)", "ssim": "SSIM"}
_LOGARITHMIC = ("sam", "rmse")
_SECONDS = {"wall": "train_seconds", "cpu": "cpu_seconds"}
_GPU_COLUMN = {"GPU memory, MiB": "{gpu_memory_mib:.0f}"}
TABLE_WIDTH = 150
"""Characters that the table needs on a terminal."""


def table(runs: Sequence[BenchmarkRun]) -> tuple[list[str], list[list[str]]]:
    """Titles, and a row for each stage of each run: what held-out views were like at the stage's end."""
    on_gpu = any(checkpoint.gpu_memory_mib > 0 for run in runs for checkpoint in run.checkpoints)
    columns = _COLUMNS | (_GPU_COLUMN if on_gpu else {})
    rows = [
        [
            # A single band has no spectral angle.
            column.format_map(defaultdict(lambda: math.nan, asdict(run) | asdict(end) | end.metrics))
            for column in columns.values()
        ]
        for run in runs
        for end in run.stage_ends
    ]
    return list(columns), rows


def write_csv(path: Path, runs: Sequence[BenchmarkRun]) -> None:
    """A line for each checkpoint of each run.

    Raises:
        InputError: the operating system refused to write.
    """
    lines = []
    for run in runs:
        about = {"configuration": run.name, "method": run.method, "words": " ".join(run.words)}
        for checkpoint in run.checkpoints:
            measured = asdict(checkpoint)
            metrics = measured.pop("metrics")
            lines.append({**about, "setup_seconds": run.setup_seconds, **measured, **metrics})
    columns = list(dict.fromkeys(key for line in lines for key in line))
    with atomic_write(path) as (temporary,), temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)


def write_results_page(
    path: Path, runs: Sequence[BenchmarkRun], settings: dict[str, Any], machine: dict[str, str]
) -> None:
    """The table as Markdown, with what it was measured on and how.

    Raises:
        InputError: the operating system refused to write.
    """
    listed = "\n".join(f"- {key}: {value}" for key, value in settings.items())
    made_of = "\n".join(f"- `{run.name}`: `ns-train {' '.join((run.method, *run.words))}`" for run in runs)
    text = f"""# What accuracy costs in time

![Held-out metrics against seconds of training]({path.with_suffix(".png").name})

{markdown_table(*table(runs))}

Held-out views at the end of each stage: mean over the views, masked to the object, and over whole frames where the
column says so. Seconds are of training alone: setting up and evaluating do not count. Memory is the most that the
process held until then, earlier evaluations included.

Measured on: {", ".join(f"{key} {value}" for key, value in machine.items())}.

{listed}

{made_of}
"""
    with atomic_write(path) as (temporary,):
        temporary.write_text(text, encoding="utf-8")


@rc_context(STYLE)
def draw_accuracy_and_time(path: Path, runs: Sequence[BenchmarkRun], clock: Clock = "wall") -> None:
    """A panel for each metric, a curve for each run over the clock's seconds, rings where a stage ends."""
    figure = new_figure(11.0, 5.2 + 0.12 * len(runs))
    panels = figure.subplots(2, 2, sharex=True)
    colours = list(islice(cycle(COLOURS), len(runs)))
    # Where there are more runs than colours, the line tells them apart.
    lines = [("-", "--", ":", "-.")[(i // len(COLOURS)) % 4] for i in range(len(runs))]
    for axes, (metric, title) in zip(panels.ravel(), _PANELS.items(), strict=True):
        for run, colour, line in zip(runs, colours, lines, strict=True):
            ends = [point.ends_stage for point in run.checkpoints]
            seconds = [getattr(point, _SECONDS[clock]) for point in run.checkpoints]
            curve = np.array([seconds, [point.metrics.get(metric, math.nan) for point in run.checkpoints]])
            axes.plot(*curve, color=colour, linestyle=line, label=run.name, marker="o", markersize=2.5)
            axes.plot(*curve[:, ends], "o", color=colour, markersize=7, fillstyle="none")
        if metric in _LOGARITHMIC:
            logarithmic_axis(axes, "y")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        axes.set_title(f"{title}, {'lower' if metric in _LOGARITHMIC else 'higher'} is better")
    for axes in panels[1]:
        axes.set_xlabel(f"training ({'wall' if clock == 'wall' else 'processor'} seconds)")
    panels[0, 0].set_xlim(left=0)
    figure.suptitle("Held-out views, masked to the object; rings: ends of stages", fontsize=9)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)
