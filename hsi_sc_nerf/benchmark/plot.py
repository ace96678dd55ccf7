"""The benchmark as a picture: held-out metrics against seconds of training, and peak memory."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from hsi_sc_nerf.benchmark.results import TrainedRun
from hsi_sc_nerf.benchmark.timing import Clock
from hsi_sc_nerf.plotting.result_pictures import _COLOURS, _STYLE, _figure, _save

_PANELS = {"sam": "SAM (rad)", "rmse": "RMSE", "psnr": "PSNR (dB)", "ssim": "SSIM"}
_LOGARITHMIC = ("sam", "rmse")
_SECONDS = {"wall": "train_seconds", "cpu": "cpu_seconds"}


@rc_context(_STYLE)
def draw_accuracy_and_time(path: Path, runs: Sequence[TrainedRun], clock: Clock = "wall") -> None:
    """A panel for each metric, a curve for each run, rings where a stage ends; peak memory as bars.

    Args:
        path: The PNG file.
        runs: One or more.
        clock: What the seconds are of.
    """
    figure = _figure(11.0, 5.2 + 0.12 * len(runs))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.6, 1))[0]
    panels = left.subplots(2, 2, sharex=True)
    colours = list(islice(cycle(_COLOURS), len(runs)))
    # Where there are more runs than colours, the line tells them apart.
    lines = [("-", "--", ":", "-.")[(i // len(_COLOURS)) % 4] for i in range(len(runs))]
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
    _save(figure, path)


def _draw_run(axes: Axes, run: TrainedRun, metric: str, time: str, colour: str, line: str) -> None:
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
