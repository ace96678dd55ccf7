"""The benchmark's results: CSV, JSON, tables on the screen and in Markdown."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from hsi_sc_nerf.benchmark.run import Checkpoint
from hsi_sc_nerf.files import atomic_write, write_json

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
_GPU_COLUMN = {"GPU memory, MiB": "{gpu_memory_mib:.0f}"}
TABLE_WIDTH = 150
"""Characters that the table needs on a terminal."""


@dataclass(frozen=True)
class TrainedRun:
    """A configuration's finished run.

    Attributes:
        name: of the configuration.
        method: nerfstudio method.
        words: as after ``ns-train METHOD``, those that all configurations share included.
        setup_seconds: wall time before the first step: reading the dataset, building the model.
        checkpoints: in the order of iterations.
    """

    name: str
    method: str
    words: tuple[str, ...]
    setup_seconds: float
    checkpoints: tuple[Checkpoint, ...]

    @property
    def stage_ends(self) -> tuple[Checkpoint, ...]:
        """The last checkpoint of each stage."""
        return tuple(checkpoint for checkpoint in self.checkpoints if checkpoint.ends_stage)


def table(runs: Sequence[TrainedRun]) -> tuple[list[str], list[list[str]]]:
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


def screen_table(runs: Sequence[TrainedRun]) -> Table:
    """The table for a terminal."""
    titles, rows = table(runs)
    shown = Table(*titles, title="Held-out views, masked to the object, at the end of each stage")
    for row in rows:
        shown.add_row(*row)
    return shown


def markdown_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, without a line break at its end."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (titles, ["---"] * len(titles), *rows))


def describe_in_words(machine: dict[str, str]) -> str:
    """One line that says what the figures were measured on."""
    return ", ".join(f"{key} {value}" for key, value in machine.items())


def write_csv(path: Path, runs: Sequence[TrainedRun]) -> None:
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


def _csv_line(run: TrainedRun, checkpoint: Checkpoint) -> dict[str, Any]:
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


def write_results(path: Path, runs: Sequence[TrainedRun], settings: dict[str, Any], machine: dict[str, str]) -> None:
    """Everything as JSON.

    Raises:
        InputError: the operating system refused to write.
    """
    write_json(path, {"machine": machine, "settings": settings, "runs": [asdict(run) for run in runs]})


def write_page(path: Path, runs: Sequence[TrainedRun], settings: dict[str, Any], machine: dict[str, str]) -> None:
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
