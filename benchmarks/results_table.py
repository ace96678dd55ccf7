"""Benchmark results as CSV files, from which the documentation makes its tables.

A file has the table's own columns, then where the figures come from: commit, seed and machine.
"""

from __future__ import annotations

import csv
import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path

import torch

RESULTS = Path(__file__).parent / "results"
SOURCE_COLUMNS = ("commit", "seed", "machine")


def write_results(
    name: str, columns: Sequence[str], rows: Sequence[Sequence[str]], seed: str = "scene", folder: Path = RESULTS
) -> Path:
    """Write ``folder/NAME.csv`` and return its path.

    Args:
        name: of the table, as a page of the documentation names it.
        columns: titles of the table.
        rows: one cell a column.
        seed: seed or seeds of the runs; ``scene`` is the seed of each shipped scene.
        folder: where the results are kept.

    Example:
        >>> write_results("pose_hard_cases", ["case", "rotation, deg"], [["even turn", "0.005"]])
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.csv"
    source = (current_commit(), seed, machine_name())
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*columns, *SOURCE_COLUMNS])
        writer.writerows([*row, *source] for row in rows)
    return path


def current_commit() -> str:
    """Short name of the commit that is checked out, with ``+`` where files differ from it."""
    folder = Path(__file__).parent
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True)
    changed = subprocess.run(["git", "status", "--porcelain", "-uno"], cwd=folder, capture_output=True, text=True)
    return (commit.stdout.strip() or "unknown") + ("+" if changed.stdout.strip() else "")


def machine_name() -> str:
    """Cores and GPU of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{os.cpu_count()} cores ({platform.machine()}), {gpu}"
