"""``hsi-sc-nerf sample``: spectra for the points of somebody else's cloud or mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.errors import InputError

_METRES = {"m": 1.0, "mm": 1e-3}
_EXTRA = ("sampled_views", "sampled_std")


@dataclass(frozen=True)
class SampleCommand:
    """Add the spectra that a trained run holds to the points of any PLY file, a scanner's cloud or a mesh.

    The file has to lie in the object's frame: origin where the turntable's axis meets the disc, z up along the axis.
    Everything that is in the file stays as it is. Each point gets its reflectance in every band, the number of
    training views that it is the mean of (sampled_views), and their spread (sampled_std).
    """

    points: tyro.conf.Positional[Path]
    """Point cloud or mesh (PLY)."""
    load_config: Path
    """The config.yml of a trained run."""
    output: Path | None = None
    """File to write. By default NAME-spectral.ply beside the points."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the coordinates in the file; they are written as they were."""
    reach_mm: float = 3.0
    """How far a point may lie from the surface that the run has found, in millimetres; one further away gets no
    spectrum."""
    views: int = 4
    """Training views that are averaged at each point, those from straight ahead first. More take longer."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the points or the run cannot be used, no point lies on the object, or the result cannot be
                written.
        """
        if self.reach_mm <= 0.0 or self.views < 1:
            raise InputError("--reach-mm has to be greater than 0 and --views at least 1; correct them.")
        from hsi_sc_nerf.export.sampled_ply import SpectralColumns, read_points

        given = read_points(self.points)
        normals = given.normals()
        output = self.output or self.points.with_name(f"{self.points.stem}-spectral.ply")

        from hsi_sc_nerf.export.sample_points import sample_points
        from hsi_sc_nerf.models.trained_run import open_run
        from hsi_sc_nerf.progress import progress_bar

        run = open_run(self.load_config)
        columns = SpectralColumns(given, run.dataset.wavelengths_nm, _EXTRA)
        without = 0
        points_m = given.positions() * _METRES[self.unit]
        parts = sample_points(run, points_m, normals, self.reach_mm / 1e3, self.views)
        with progress_bar("sampling", "points", len(given)) as done:
            for rows, outward, found in parts:
                extra = dict(zip(_EXTRA, (found.views, found.spectral_std), strict=True))
                columns.fill(rows, outward, found.spectra, run.model.rgb_bands, extra)
                without += int((found.views == 0).sum())
                done(rows.stop)
        if without == len(given):
            raise InputError(
                f"{self.points}: none of its points lies on the object; give them in the object's frame (origin on "
                "the turntable's disc, z up), in metres or with --unit mm."
            )
        columns.write(output)
        console = Console()
        if without:
            console.print(
                f"[yellow]{without:,} of {len(given):,} points have no spectrum (NaN): no training camera that faces "
                f"them sees a surface within {self.reach_mm:g} mm of them."
            )
        bands = len(run.dataset.wavelengths_nm)
        console.print(f"{escape(str(output))}: {len(given) - without:,} points with spectra of {bands} bands.")
