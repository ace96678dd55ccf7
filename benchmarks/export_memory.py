"""Memory of exporting clouds of several sizes, each in a process of its own.

    uv run python benchmarks/export_memory.py RUN/config.yml --points 10000 100000 1000000

Writes the table into docs/export.md.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from page import write_table

from hsi_sc_nerf.cli.steps import nerfstudio_command, run_step

PAGE = Path(__file__).parent.parent / "docs" / "export.md"


@dataclass(frozen=True)
class ExportMemory:
    """Export a run's cloud with several numbers of points and measure the most memory held at once."""

    load_config: tyro.conf.Positional[Path]
    """The config.yml of a run."""
    points: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    """Numbers of points."""
    page: Path = PAGE
    """Page that gets the table."""

    def main(self) -> None:
        """Export, and write the table."""
        rows = []
        for points in self.points:
            with tempfile.TemporaryDirectory() as folder:
                words = ["pointcloud", "--load-config", str(self.load_config), "--output-dir", folder]
                words += ["--num-points", str(points)]
                cost = run_step("export", [*nerfstudio_command("exporter"), *words], Path(folder) / "log.txt")
                size_mib = (Path(folder) / "point_cloud.ply").stat().st_size / 2**20
            figures = (f"{points:,}", f"{size_mib:.0f}", f"{cost.peak_memory_mib:.0f}")
            print(json.dumps(figures))
            rows.append(figures)
        write_table(self.page, "export memory", ("points", "file, MiB", "peak memory, MiB"), rows)


if __name__ == "__main__":
    tyro.cli(ExportMemory).main()
