"""The benchmark's results: CSV, JSON, tables on the screen and in Markdown."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from rich.table import Table

from hsi_sc_nerf.benchmark.run import BenchmarkRun, Checkpoint, Clock
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.plotting.figures import COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.tables import markdown_table, screen_table

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
            column.format(**{"name": run.name, "setup_seconds": run.setup_seconds, **asdict(end), **end.metrics})
            for column in columns.values()
        ]
        for run in runs
        for end in run.stage_ends
    ]
    return list(columns), rows


def results_table(runs: Sequence[BenchmarkRun]) -> Table:
    """The table for a terminal."""
    return screen_table(*table(runs), title="Held-out views, masked to the object, at the end of each stage")


def describe_in_words(machine: dict[str, str]) -> str:
    """One line that says what the figures were measured on."""
    return ", ".join(f"{key} {value}" for key, value in machine.items())


def write_csv(path: Path, runs: Sequence[BenchmarkRun]) -> None:
    """A line for each checkpoint of each run.

    Raises:
        InputError: the operating system refused to write.
    """
    lines = [_csv_line(run, checkpoint) for run in runs for checkpoint in run.checkpoints]
    columns = list(dict.fromkeys(key for line in lines for key in line))
    with atomic_write(path) as (temporary,), temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)


def _csv_line(run: BenchmarkRun, checkpoint: Checkpoint) -> dict[str, Any]:
    measured = asdict(checkpoint)
    metrics = measured.pop("metrics")
    words = " ".join(run.words)
    return {
        "configuration": run.name,
        "method": run.method,
        "words": words,
        "setup_seconds": run.setup_seconds,
        **measured,
        **metrics,
    }


def write_results(
    path: Path, runs: Sequence[BenchmarkRun], settings: dict[str, Any], machine: dict[str, str]
) -> None:
    """Everything as JSON.

    Raises:
        InputError: the operating system refused to write.
    """
    write_json(path, {"machine": machine, "settings": settings, "runs": [asdict(run) for run in runs]})


def write_page(path: Path, runs: Sequence[BenchmarkRun], settings: dict[str, Any], machine: dict[str, str]) -> None:
    """The table as Markdown, with what it was measured on and how.

    Raises:
        InputError: the operating system refused to write.
    """
    told = "\n".join(f"- {key}: {value}" for key, value in settings.items())
    made_of = "\n".join(f"- `{run.name}`: `ns-train {' '.join((run.method, *run.words))}`" for run in runs)
    text = f"""# What accuracy costs in time

![Held-out metrics against seconds of training]({path.with_suffix(".png").name})

{markdown_table(*table(runs))}

Held-out views at the end of each stage: mean over the views, masked to the object, and over whole frames where the
column says so. Seconds are of training alone: setting up and evaluating do not count. Memory is the most that the
process held until then, earlier evaluations included.

Measured on: {describe_in_words(machine)}.

{told}

{made_of}
"""
    with atomic_write(path) as (temporary,):
        temporary.write_text(text, encoding="utf-8")


@rc_context(STYLE)
def draw_accuracy_and_time(path: Path, runs: Sequence[BenchmarkRun], clock: Clock = "wall") -> None:
    """A panel for each metric, a curve for each run, rings where a stage ends; peak memory as bars.

    Args:
        path: The PNG file.
        runs: One or more.
        clock: What the seconds are of.
    """
    figure = new_figure(11.0, 5.2 + 0.12 * len(runs))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.6, 1))[0]
    panels = left.subplots(2, 2, sharex=True)
    colours = list(islice(cycle(COLOURS), len(runs)))
    # Where there are more runs than colours, the line tells them apart.
    lines = [("-", "--", ":", "-.")[(i // len(COLOURS)) % 4] for i in range(len(runs))]
    for axes, (metric, title) in zip(panels.ravel(), _PANELS.items(), strict=True):
        for run, colour, line in zip(runs, colours, lines, strict=True):
            _draw_run(axes, run, metric, _SECONDS[clock], colour, line)
        if metric in _LOGARITHMIC:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(f"{title}, {'lower' if metric in _LOGARITHMIC else 'higher'} is better")
    for axes in panels[1]:
        axes.set_xlabel(f"training ({'wall' if clock == 'wall' else 'processor'} seconds)")
    panels[0, 0].set_xlim(left=0)
    left.suptitle("Held-out views, masked to the object; rings: ends of stages", fontsize=9)

    # The bars' names are the curves' legend.
    axes = right.subplots()
    memory = [run.checkpoints[-1].gpu_memory_mib or run.checkpoints[-1].peak_memory_mib for run in runs]
    on_gpu = any(run.checkpoints[-1].gpu_memory_mib for run in runs)
    places = np.arange(len(runs))
    axes.barh(places, memory, color=colours, height=0.36)
    for place, run, amount in zip(places, runs, memory, strict=True):
        axes.annotate(f"{run.name}: {amount:.0f}", (0, place - 0.2), va="bottom", fontsize=8)
    axes.set(yticks=[], ylim=(len(runs) - 0.5, -0.8), xlabel="MiB", title=f"Peak {'GPU ' if on_gpu else ''}memory")
    axes.grid(axis="y", visible=False)
    save_figure(figure, path)


def _draw_run(axes: Axes, run: BenchmarkRun, metric: str, time: str, colour: str, line: str) -> None:
    seconds = [getattr(checkpoint, time) for checkpoint in run.checkpoints]
    values = [checkpoint.metrics[metric] for checkpoint in run.checkpoints]
    axes.plot(seconds, values, color=colour, linestyle=line, linewidth=1.2, marker="o", markersize=2.5)
    axes.plot(
        [getattr(end, time) for end in run.stage_ends],
        [end.metrics[metric] for end in run.stage_ends],
        linestyle="",
        marker="o",
        markersize=7,
        markerfacecolor="none",
        markeredgecolor=colour,
    )
