"""``hsi-sc-nerf export``: the spectral point cloud of a trained run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hsi_sc_nerf.export.options import CloudOptions


@dataclass(frozen=True)
class ExportCommand:
    """Write the point cloud of a trained run: a spectrum a point, in metres, evenly spread over the object.

    Each point also says how opaque the model is there (opacity), how obliquely it is seen (incidence_deg), how many
    training frames see it (views), how much their measurements of it differ (spectral_std) and in which share of them
    it is saturated or not measured (saturated). `ns-export pointcloud` writes the same with the options that it has.
    """

    load_config: Path
    """The config.yml of the run."""
    output_dir: Path
    """Folder to write point_cloud.ply (.las, .nc, .zarr) to."""
    options: Annotated[CloudOptions, tyro.conf.arg(name="")] = field(default_factory=CloudOptions)
    """What to write."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the run cannot be used, an option cannot be met, or the cloud cannot be written.
        """
        from hsi_sc_nerf.export.spectral_export import export_cloud
        from hsi_sc_nerf.models.trained_run import open_run

        export_cloud(open_run(self.load_config), self.output_dir, self.options)
