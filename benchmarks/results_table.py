"""Benchmark results as CSV files, from which the documentation makes its tables.

A file has the table's own columns, then where the figures of a row come from: commit, seed and machine.
"""

from __future__ import annotations

import csv
import os
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.terminal import screen_table

RESULTS = Path(__file__).parent / "results"
SOURCE_COLUMNS = ("commit", "seed", "machine")


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """The option of every benchmark that writes a table."""

    results: Path = RESULTS
    """Folder of the CSV file."""


def write_results(
    name: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    keys: int = 0,
    seed: str = "scene",
    commit: str | None = None,
    machine: str | None = None,
    folder: Path = RESULTS,
) -> Path:
    """Print a table, write it to ``folder/NAME.csv``, and return that path.

    Args:
        name: of the table, as a page of the documentation names it.
        columns: titles of the table.
        rows: one cell a column.
        keys: the first ``keys`` cells tell which measurement a row is. Rows of the file that are measured again are
            replaced in their place; the file's other rows are kept with their own sources. With 0, ``rows`` are the
            whole table.
        seed: seed or seeds of the runs; ``scene`` is the seed of each shipped scene.
        commit: of the code; by default the one that is checked out.
        machine: that measured; by default this one.
        folder: where the results are kept.

    Raises:
        ValueError: rows are to be kept, but the file has other columns.

    Example:
        >>> write_results("pose_hard_cases", ["case", "rotation, deg"], [["even turn", "0.005"]], keys=1)
    """
    Console(width=220).print(screen_table(columns, rows, title=name))
    path = folder / f"{name}.csv"
    source = (commit or current_commit(), seed, machine or machine_name())
    titles = [*columns, *SOURCE_COLUMNS]
    table = [[*row, *source] for row in rows]
    if keys and path.is_file():
        kept_titles, *kept = read_results(path)
        if kept_titles != titles:
            raise ValueError(f"{path} has other columns than this table: {kept_titles}. Move it away to start anew.")
        table = list({tuple(row[:keys]): row for row in (*kept, *table)}.values())
    with atomic_write(path) as (temporary,), temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([titles, *table])
    return path


def read_results(path: Path) -> list[list[str]]:
    """Titles and rows of a results file, sources included."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def current_commit(folder: Path = Path(__file__).parent) -> str:
    """Short name of the commit that is checked out at a folder, with ``+`` where files differ from it."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True)
    changed = subprocess.run(["git", "status", "--porcelain", "-uno"], cwd=folder, capture_output=True, text=True)
    return (commit.stdout.strip() or "unknown") + ("+" if changed.stdout.strip() else "")


def machine_name() -> str:
    """Cores and GPU of this machine."""
    # PyTorch takes 500 MiB, which benchmarks of memory must not count.
    import torch

    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{os.cpu_count()} cores ({platform.machine()}), {gpu}"
