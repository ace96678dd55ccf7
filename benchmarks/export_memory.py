"""Memory of exporting clouds of several sizes, each in a process of its own.

uv run python benchmarks/export_memory.py RUN/config.yml --points 20000 1000000
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from results_table import RESULTS, write_results

from hsi_sc_nerf.cli.steps import nerfstudio_command, run_step


@dataclass(frozen=True)
class ExportMemory:
    """Export a run's cloud with several numbers of points and measure the most memory held at once."""

    load_config: tyro.conf.Positional[Path]
    """The config.yml of a run."""
    points: tuple[int, ...] = (20_000, 1_000_000)
    """Numbers of points."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Export, print the table, write it."""
        rows = []
        for points in self.points:
            with tempfile.TemporaryDirectory() as folder:
                words = ["pointcloud", "--load-config", str(self.load_config), "--output-dir", folder]
                words += ["--num-points", str(points)]
                cost = run_step("export", [*nerfstudio_command("exporter"), *words], Path(folder) / "log.txt")
                size_mib = (Path(folder) / "point_cloud.ply").stat().st_size / 2**20
            rows.append((f"{points:,}", f"{size_mib:.0f}", f"{cost.peak_memory_mib:.0f}"))
        columns = ("points", "file, MiB", "peak memory, MiB")
        write_results("export_memory", columns, rows, folder=self.results)


if __name__ == "__main__":
    tyro.cli(ExportMemory).main()
