"""Make ``ns-export pointcloud`` export spectra for runs of hsi-sc-nerf; other methods export as before.

nerfstudio's exporter has no extension point, and imports its plugins while it is being imported itself. So
``ExportPointCloud.main`` is wrapped as soon as the exporter's module is complete: at once if it is, at the first use
of its names if it is being imported, or after its import if that is still to come.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig

_EXPORTER = "nerfstudio.scripts.exporter"


def extend_export_point_cloud() -> None:
    """Let ``ExportPointCloud.main`` export spectra for hsi-sc-nerf runs."""
    module = sys.modules.get(_EXPORTER)
    if module is None:
        sys.meta_path.insert(0, _ExporterFinder())
    elif hasattr(module, "entrypoint"):
        _wrap_main(module)
    else:
        module.__class__ = _ExporterBeingImported


def _wrap_main(module: types.ModuleType) -> None:
    original: Callable[[Any], None] = module.ExportPointCloud.main

    def main(self: Any) -> None:
        """Export point cloud."""
        from hsi_sc_nerf.export.spectral_export import export_spectral_point_cloud
        from hsi_sc_nerf.models.spectral_config import SpectralModelConfig

        config = yaml.load(self.load_config.read_text(), Loader=yaml.Loader)
        if isinstance(config, TrainerConfig) and isinstance(config.pipeline.model, SpectralModelConfig):
            export_spectral_point_cloud(self)
        else:
            original(self)

    module.ExportPointCloud.main = main


class _ExporterBeingImported(types.ModuleType):
    """The exporter during its import: wraps ``main`` at the first use of the complete module."""

    def __getattribute__(self, name: str) -> Any:
        if name in ("entrypoint", "ExportPointCloud"):
            complete = "entrypoint" in vars(self)
            if complete:
                self.__class__ = types.ModuleType  # type: ignore[assignment]
                _wrap_main(self)
        return types.ModuleType.__getattribute__(self, name)


class _ExporterFinder(importlib.abc.MetaPathFinder):
    """Wraps ``main`` after the exporter's import, and removes itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != _EXPORTER:
            return None
        sys.meta_path.remove(self)
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            loader = spec.loader
            execute = loader.exec_module

            def exec_module(module: types.ModuleType) -> None:
                execute(module)
                _wrap_main(module)

            loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
