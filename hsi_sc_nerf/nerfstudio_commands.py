"""What nerfstudio's own commands do with runs of this package.

``ns-export pointcloud`` writes the spectral cloud, what a command cannot do ends in one sentence, and commands start
sooner.

nerfstudio's scripts have no extension point, and import their plugins while they are being imported themselves. So
the ``main`` of a script's commands is wrapped at the first use of the complete script. Runs of other methods pass as
they are.
"""

from __future__ import annotations

import errno
import shutil
import sys
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerfstudio.configs import external_methods
from nerfstudio.utils.rich_utils import CONSOLE

from hsi_sc_nerf import interruption
from hsi_sc_nerf.data.dataparser import split_frames
from hsi_sc_nerf.errors import InputError, one_sentence
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.models.checkpoints import find_checkpoint, require_model, require_no_others
from hsi_sc_nerf.models.run_settings import read_config, relocated_run, require_method
from hsi_sc_nerf.models.spectral_model import SpectralModelConfig
from hsi_sc_nerf.packed.dataset import is_packed, open_packed

_SCRIPTS = tuple(f"nerfstudio.scripts.{name}" for name in ("eval", "exporter", "render", "viewer.run_viewer"))
_REFUSED = {
    "ExportMarchingCubesMesh": "ns-export marching-cubes needs a signed distance, which this method does not have; "
    "take ns-export poisson or tsdf, or `hsi-sc-nerf traits`, whose mesh.ply is closed and in metres.",
    "ExportGaussianSplat": "ns-export gaussian-splat needs a model of Gaussians, which this method is not; take "
    "ns-export pointcloud.",
}
"""Commands that cannot work, by the name of their class, and what to do instead."""
_EXPORTED = (
    *("tsdf_mesh.ply", "poisson_mesh.ply", "mesh.obj", "material_0.mtl", "material_0.png"),
    *("transforms_train.json", "transforms_eval.json"),
)
"""Files that nerfstudio's exports write, and do not write whole."""
_RENDERED = (".png", ".jpg", ".mp4", ".gz")
"""And endings of those that its renders write."""
_FULL_BYTES = 1 << 12
"""A disk with less free is full."""
_PICTURES = ("gt-rgb", "rgb", "accumulation", "depth", "expected_depth")
"""Outputs that are pictures, which ``ns-render dataset`` writes if it is given no names."""


def extend_nerfstudio_commands() -> None:
    """Extend the scripts of nerfstudio that are being imported or are imported."""
    # For each method that could be installed nerfstudio asks for the name of its caller. `inspect.stack` looks
    # through the sources of all modules for it, which takes longer than all else that a command does at its start.
    external_methods.inspect = types.SimpleNamespace(stack=_callers)  # type: ignore[assignment]
    for name in _SCRIPTS:
        # ``python -m`` runs a script under another name.
        module = sys.modules.get(name)
        if module is not None:
            # At the first use of the entry point, which is defined last, the commands are wrapped.
            module.__class__ = _ScriptBeingImported
            hasattr(module, "entrypoint")  # wraps a script that is complete


def _callers() -> list[types.SimpleNamespace]:
    """The functions that are being called, the caller of this one first, as `inspect.stack` lists them."""
    found, frame = [], sys._getframe(1)
    while frame is not None:
        found.append(types.SimpleNamespace(function=frame.f_code.co_name))
        frame = frame.f_back  # type: ignore[assignment]
    return found


class _ScriptBeingImported(types.ModuleType):
    def __getattribute__(self, name: str) -> Any:
        if name == "entrypoint" and name in vars(self):
            self.__class__ = types.ModuleType  # type: ignore[assignment]
            for kind in list(vars(self).values()):
                if isinstance(kind, type) and kind.__module__ == self.__name__ and "main" in vars(kind):
                    kind.main = _adapted(kind.main)  # type: ignore[attr-defined]
        return types.ModuleType.__getattribute__(self, name)


def _adapted(original: types.FunctionType) -> Callable[[Any], None]:
    def main(self: Any) -> None:
        with one_sentence():
            if not prepare(self):
                interruption.leave_alone()
                original(self)
                return
            try:
                with interruption.one_line(), _nothing_half_exported(self), _opening_moved_runs(original.__globals__):
                    _export_spectral_cloud(self) if type(self).__name__ == "ExportPointCloud" else original(self)
            except OSError as error:
                if error.filename is None:
                    raise
                raise InputError(f"{error.filename}: {error.strerror}; choose another path.") from error
            interruption.ignore_when_done()

    main.__doc__ = original.__doc__
    return main


@contextmanager
def _opening_moved_runs(script: dict[str, Any]) -> Iterator[None]:
    """Let a script open runs where they lie; nerfstudio takes the paths as they were typed for the training.

    Args:
        script: what the script's module holds.
    """
    opens = script.get("eval_setup")

    def opened(load_config: Path, *, update_config_callback: Any = None, **options: Any) -> Any:
        def updated(config: Any) -> Any:
            config = relocated_run(config, load_config)
            return config if update_config_callback is None else update_config_callback(config)

        return opens(load_config, update_config_callback=updated, **options)  # type: ignore[misc]

    if opens is not None:
        script["eval_setup"] = opened
    try:
        yield
    finally:
        if opens is not None:
            script["eval_setup"] = opens


@contextmanager
def _nothing_half_exported(command: Any) -> Iterator[None]:
    """On a full disk, delete what an export or a render had begun; libraries tell of it in their own ways or not.

    Raises:
        InputError: the disk is full.
    """
    folder = getattr(command, "output_dir", None) or getattr(command, "output_path", None)
    # Not by the clock: a disk's own clock lags behind, and that of a network drive may be minutes off.
    earlier = {} if folder is None else _written(folder, command)
    failure: Exception | None = None
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        failure = error
    if folder is None or not _is_full(folder, failure):
        if failure is not None:
            raise failure
        return
    for path, written_ns in _written(folder, command).items():
        if earlier.get(path) != written_ns:
            path.unlink()
    raise InputError(f"{folder}: cannot be written to, because the disk is full; free some space.") from failure


def _written(folder: Path, command: Any) -> dict[Path, int]:
    """When the files that an export or a render writes were written, of those that are there."""
    paths = [folder / name for name in _EXPORTED]
    # Renders write a file, or pictures in a folder of its name.
    if hasattr(command, "rendered_output_names"):
        pictures = folder.parent / folder.stem  # of a path without a name, as `.` is, the folder itself
        places = [folder, *folder.rglob("*"), *pictures.rglob("*")]
        paths = [path for path in places if path.suffix in _RENDERED]
    return {path: path.stat().st_mtime_ns for path in paths if path.is_file()}


def _is_full(folder: Path, failure: Exception | None) -> bool:
    """Whether the disk of a folder, which may not be there yet, is full, or that is what a command failed of."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    told = isinstance(failure, OSError) and failure.errno in (errno.ENOSPC, errno.EDQUOT)
    return told or shutil.disk_usage(there).free < _FULL_BYTES


def _export_spectral_cloud(options: Any) -> None:
    """`export_cloud` with the options of nerfstudio's `ExportPointCloud`."""
    from hsi_sc_nerf.export.cloud import run_name
    from hsi_sc_nerf.export.options import CloudOptions
    from hsi_sc_nerf.export.spectral_export import export_cloud
    from hsi_sc_nerf.models.trained_run import open_trained_run

    cloud_options = CloudOptions.from_nerfstudio(options)
    run = open_trained_run(options.load_config)
    export_cloud(run, options.output_dir, cloud_options, run_name(options.load_config))


def prepare(command: Any) -> bool:
    """Check and adapt one of nerfstudio's commands for a run of this package; those of other methods are left alone.

    Args:
        command: with the option ``load_config``.

    Returns:
        Whether the run is one of this package.

    Raises:
        InputError: the run cannot be read by this version, has no checkpoint beside it, or the
            command cannot work with it.
    """
    name = type(command).__name__
    path = command.load_config
    if _is_of_another_method(path):
        return False
    config = read_config(path)
    if not isinstance(config.pipeline.model, SpectralModelConfig):
        return False
    require_method(config, path)
    relocated_run(config, path)
    if name in _REFUSED:
        raise InputError(_REFUSED[name])
    if name == "ComputePSNR" and command.output_path.suffix != ".json":
        raise InputError(f"{command.output_path}: ns-eval writes JSON; give an --output-path that ends in .json.")
    if name == "DatasetRender" and command.downscale_factor is not None:
        raise InputError(
            "ns-render dataset --downscale-factor: this method renders frames at their own size; leave the option "
            "out, or take `hsi-sc-nerf render`."
        )
    shown = getattr(command, "rendered_output_names", None)
    if shown is not None and not {"spectral", "gt-spectral"}.isdisjoint(shown):
        raise InputError(
            "ns-render cannot show spectral, which has a channel for each band; take `hsi-sc-nerf render`, which "
            "writes cubes."
        )
    if name == "DatasetRender" and shown is None:
        normals = ["normals", "pred_normals"] if config.pipeline.model.predict_normals else []
        command.rendered_output_names = [*_PICTURES, *normals]
    if name == "RenderInterpolated" and command.pose_source == "eval" and _held_out_views(config) == 1:
        raise InputError(
            "ns-render interpolate goes from held-out view to held-out view, and this dataset has one; add "
            "--pose-source train."
        )
    if name == "ExportPointCloud":  # `open_trained_run` checks the same
        return True
    checkpoints = config.get_checkpoint_dir()
    latest = find_checkpoint(checkpoints, config.load_step, "the run has saved none, so train it again")
    require_no_others(checkpoints)
    require_model(latest)
    if name == "ComputePSNR":
        command.output_path = _WrittenWhole(command.output_path)
    if name == "ExportTSDFMesh":
        from nerfstudio.exporter.tsdf_utils import TSDF

        TSDF.export_mesh = staticmethod(_write_mesh)  # type: ignore[method-assign]
    no_normals = not config.pipeline.model.predict_normals
    if name == "ExportPoissonMesh" and command.normal_method == "model_output" and no_normals:
        CONSOLE.print("hsi-sc-nerf: the model predicts no normals; they are estimated from the points (open3d).")
        command.normal_method = "open3d"
    return True


def _is_of_another_method(path: Path) -> bool:
    """Whether a file holds settings of a run, and does not name this package."""
    with suppress(OSError):
        text = path.read_text(encoding="utf-8", errors="replace")
        return "!!python/object" in text and "hsi_sc_nerf" not in text
    return False


class _WrittenWhole(type(Path())):  # type: ignore[misc]
    """A path whose text is written whole or not at all."""

    def write_text(self, data: str, encoding: str | None = None, *_: Any) -> int:
        with atomic_write(Path(self)) as (temporary,):
            return temporary.write_text(data, encoding)


def _held_out_views(config: Any) -> int | None:
    """Number of held-out views of a run's dataset; None where it is a session, or gone."""
    manager = config.pipeline.datamanager
    data = manager.data or manager.dataparser.data
    if not is_packed(data):
        return None
    return len(split_frames(len(open_packed(data).frames), manager.dataparser.train_split_fraction)[1])


def _write_mesh(mesh: Any, filename: str) -> None:
    """What `TSDF.export_mesh` does by pymeshlab, which dies when it is given arrays of NumPy 2."""
    import trimesh

    vertices, faces, normals, colours = (
        values.cpu().numpy() for values in (mesh.vertices, mesh.faces, mesh.normals, mesh.colors)
    )
    rgb = (255 * colours.clip(0.0, 1.0)).astype("uint8")
    trimesh.Trimesh(vertices, faces, vertex_normals=normals, vertex_colors=rgb, process=False).export(filename)
