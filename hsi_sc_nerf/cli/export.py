"""``hsi-sc-nerf export``: the spectral point cloud of a trained run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hsi_sc_nerf.export.options import CloudOptions


@dataclass(frozen=True)
class ExportCommand:
    """Write the spectral point cloud of a trained run, in metres, evenly spread over the object.

    Each point has a spectrum, the opacity of its ray (opacity), the ray's angle of incidence (incidence_deg), the
    number of training frames that see it (views), the standard deviation of their measurements (spectral_std), and
    the fraction of them that are saturated or without data (saturated). `ns-export pointcloud` writes the same cloud,
    with its own options.
    """

    load_config: Path
    """The config.yml of the run."""
    output_dir: Path
    """Folder to write point_cloud.ply (.las, .nc, .zarr) to."""
    options: Annotated[CloudOptions, tyro.conf.arg(name="")] = field(default_factory=CloudOptions)
    """Options of the cloud."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the run cannot be used, an option cannot be met, or the cloud cannot be written.
        """
        from hsi_sc_nerf.export.cloud import run_name
        from hsi_sc_nerf.export.spectral_export import export_cloud
        from hsi_sc_nerf.models.trained_run import open_run

        export_cloud(open_run(self.load_config), self.output_dir, self.options, run_name(self.load_config))
