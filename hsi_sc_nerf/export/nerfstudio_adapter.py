"""``ns-export pointcloud`` with spectra for runs of hsi-sc-nerf; every other method's export stays as it is.

nerfstudio's exporter has no extension point, and it imports its plugins while it is itself half imported. So the one
method that matters, ``ExportPointCloud.main``, is wrapped as soon as its module is complete: at once if it already
is, when its first name is asked for if it is being imported, and after its import if that is still to come.
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
    """Arrange for ``ExportPointCloud.main`` to export spectra for hsi-sc-nerf runs."""
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
        from hsi_sc_nerf.models.spectral_model import SpectralModelConfig

        config = yaml.load(self.load_config.read_text(), Loader=yaml.Loader)
        if isinstance(config, TrainerConfig) and isinstance(config.pipeline.model, SpectralModelConfig):
            export_spectral_point_cloud(self)
        else:
            original(self)

    module.ExportPointCloud.main = main


class _ExporterBeingImported(types.ModuleType):
    """The exporter while it is being imported: wraps ``main`` when the finished module is first used."""

    def __getattribute__(self, name: str) -> Any:
        if name in ("entrypoint", "ExportPointCloud"):
            complete = "entrypoint" in vars(self)
            if complete:
                self.__class__ = types.ModuleType  # type: ignore[assignment]
                _wrap_main(self)
        return types.ModuleType.__getattribute__(self, name)


class _ExporterFinder(importlib.abc.MetaPathFinder):
    """Wraps ``main`` after the exporter's import, then is gone."""

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
