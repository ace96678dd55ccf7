"""``hsi-sc-nerf report``: one HTML file on the quality of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape


@dataclass(frozen=True)
class ReportCommand:
    """Write one HTML file on a trained run: the object in 3D with its spectra, how well held-out views are rendered,
    the training, the calibration, the masks, the poses. It opens in any browser, without a network."""

    run: tyro.conf.Positional[Path]
    """Folder of the run that holds config.yml, or that file."""
    output: Path | None = None
    """The HTML file. Default: report.html in the run's folder."""
    cloud: Path | None = None
    """Point cloud (PLY) of the run. Default: point_cloud.ply in the run's folder, or, if there is none, points
    sampled from the model."""
    comparison: Path | None = None
    """comparison.json of `hsi-sc-nerf compare`. Default: the one in the run's folder."""
    traits: Path | None = None
    """traits.json of `hsi-sc-nerf traits`. Default: the one in the run's folder."""
    views: int | None = None
    """Number of held-out views to render, evenly spread. Default: all."""
    points: int = 50_000
    """Number of points to show; 50 000 need about 5 MB."""

    def main(self) -> None:
        """Write the report and print its path.

        Raises:
            InputError: the run, its dataset or a file given cannot be used, or the report cannot be written.
        """
        from hsi_sc_nerf.report.build import ReportSources, write_report

        run = self.run.parent if self.run.name == "config.yml" else self.run
        output = self.output or run / "report.html"
        sources = ReportSources(self.cloud, self.comparison, self.traits, self.views, self.points)
        write_report(run, output, sources)
        size_mb = output.stat().st_size / 1e6
        Console().print(f"{escape(str(output))} ({size_mb:.1f} MB)", soft_wrap=True)
