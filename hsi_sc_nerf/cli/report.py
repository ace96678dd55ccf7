"""``hsi-sc-nerf report``: one HTML file that tells how a run came about and how good it is."""

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
    """Folder of the run, the one that holds config.yml; or that file."""
    output: Path | None = None
    """The HTML file; report.html in the run's folder where it is not given."""
    cloud: Path | None = None
    """Point cloud (PLY) of the run to show. Where it is not given, point_cloud.ply in the run's folder is shown or,
    where there is none, the surface is sampled from the model."""
    comparison: Path | None = None
    """comparison.json that `hsi-sc-nerf compare` made; the one in the run's folder where it is not given."""
    traits: Path | None = None
    """traits.json that `hsi-sc-nerf traits` made; the one in the run's folder where it is not given."""
    views: int | None = None
    """Render this many of the held-out views, evenly spread, instead of all."""
    points: int = 50_000
    """Points of the object to show; 50 000 make about 5 MB."""

    def main(self) -> None:
        """Write the report and tell where it is.

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
