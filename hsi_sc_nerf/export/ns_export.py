"""Make ``ns-export pointcloud`` export spectra for runs of hsi-sc-nerf; other methods export as before.

nerfstudio's exporter has no extension point, and imports its plugins while it is being imported itself. So
``ExportPointCloud.main`` is wrapped at the first use of the complete module. A program that imports the plugin before
the exporter, as none of nerfstudio's does, calls `export_cloud` instead.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf.errors import InputError

_EXPORTER = "nerfstudio.scripts.exporter"


def extend_export_point_cloud() -> None:
    """Let ``ExportPointCloud.main`` export spectra for hsi-sc-nerf runs."""
    module = sys.modules.get(_EXPORTER)
    if module is not None:
        module.__class__ = _ExporterBeingImported
        hasattr(module, "entrypoint")  # wraps a module that is complete


def _wrap_main(module: types.ModuleType) -> None:
    original: Callable[[Any], None] = module.ExportPointCloud.main

    def main(self: Any) -> None:
        """Export point cloud."""
        from hsi_sc_nerf.models.spectral_model import SpectralModelConfig

        config = yaml.load(self.load_config.read_text(), Loader=yaml.Loader)
        if isinstance(config, TrainerConfig) and isinstance(config.pipeline.model, SpectralModelConfig):
            _export_spectral_cloud(self)
        else:
            original(self)

    module.ExportPointCloud.main = main


def _export_spectral_cloud(options: Any) -> None:
    """`export_cloud` with the options of nerfstudio's `ExportPointCloud`; bad input ends in one sentence."""
    from hsi_sc_nerf.export.options import CloudOptions
    from hsi_sc_nerf.export.spectral_export import export_cloud
    from hsi_sc_nerf.models.trained_run import open_run

    try:
        cloud_options = CloudOptions.from_nerfstudio(options)
        export_cloud(open_run(options.load_config), options.output_dir, cloud_options)
    except InputError as error:
        raise SystemExit(f"hsi-sc-nerf: {error}") from error


class _ExporterBeingImported(types.ModuleType):
    """The exporter during its import: wraps ``main`` at the first use of the complete module."""

    def __getattribute__(self, name: str) -> Any:
        if name in ("entrypoint", "ExportPointCloud"):
            complete = "entrypoint" in vars(self)
            if complete:
                self.__class__ = types.ModuleType  # type: ignore[assignment]
                _wrap_main(self)
        return types.ModuleType.__getattribute__(self, name)
