"""``hsi-sc-nerf sample``: add spectra to the points of any cloud or mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import between, check_options

_METRES = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True)
class SampleCommand:
    """Add spectra of a trained run to the points of any PLY file, such as a scanner's cloud or a mesh.

    The points must be in the object frame: origin where the turntable's axis meets the disc, z up along the axis.
    All content of the file is kept. Each point gets its reflectance in every band, averaged over training views, the
    number of these views (sampled_views) and the standard deviation over them (sampled_std).
    """

    points: tyro.conf.Positional[Path]
    """Point cloud or mesh (PLY)."""
    load_config: Path
    """The config.yml of a trained run."""
    output: Path | None = None
    """File to write. By default NAME-spectral.ply in the folder of the points."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the coordinates in the file; they are written in the same unit."""
    max_distance_mm: float = between(0.001, 1000.0, default=3.0)
    """Largest distance of a point from the run's surface, in millimetres; points further away get no spectrum."""
    views: int = between(1, math.inf, default=4)
    """Training views to average at each point, the most frontal first. More take longer."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the points or the run cannot be used, no point lies on the object, or the result cannot be
                written.
        """
        check_options(self)
        from hsi_sc_nerf.export.cloud import run_name
        from hsi_sc_nerf.export.sample_points import read_points, sample_points, write_sampled_ply
        from hsi_sc_nerf.models.trained_run import open_run

        given = read_points(self.points)
        normals = given.normals()
        run = open_run(self.load_config)
        points_m = given.positions * _METRES[self.unit]
        found = sample_points(run, points_m, normals, self.max_distance_mm / 1e3, self.views)
        count, no_spectrum = len(found.views), int((found.views == 0).sum())
        if no_spectrum == count:
            raise InputError(
                f"{self.points}: none of its points lies on the object; give them in the object's frame (origin on "
                "the turntable's disc, z up), in metres or with --unit mm."
            )
        output = self.output or self.points.with_name(f"{self.points.stem}-spectral.ply")
        name = run_name(self.load_config)
        write_sampled_ply(output, given, found, run.dataset.wavelengths_nm, run.model.rgb_bands, name)
        console = Console()
        if no_spectrum:
            console.print(
                f"[yellow]{no_spectrum:,} of {count:,} points have no spectrum (NaN): no training camera that "
                f"faces them sees a surface within {self.max_distance_mm:g} mm of them."
            )
        bands = len(run.dataset.wavelengths_nm)
        console.print(f"{escape(str(output))}: {count - no_spectrum:,} points with spectra of {bands} bands.")
