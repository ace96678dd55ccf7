"""Reading a run's ``config.yml`` without executing what it says.

nerfstudio writes its settings as Python objects and reads them with ``yaml.Loader``, which calls whatever a file
names, the shell included. Here, a file may name what settings are made of, and nothing else is imported or called.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import shutil
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.packed.of_run import find_dataset

_PACKAGES = ("nerfstudio", "hsi_sc_nerf")
_OPTIMIZERS = "torch.optim"
_BEFORE_TRAINING = ("config.yml", "dataparser_transforms.json", "viewer_log_filename.txt")
# Functions that settings name for calling them later.
_FUNCTIONS = (
    "hsi_sc_nerf.config.pipeline_with_panel",
    "nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate",
)


def read_config(load_config: Path) -> TrainerConfig:
    """The settings of a run, of any method.

    Raises:
        InputError: there is no such file, it is not one that this version can read, or it names something other than
            classes of nerfstudio and this package; nothing of it has been executed then.
    """
    if not load_config.is_file():
        raise InputError(f"{load_config}: there is no such file; give the config.yml of a trained run.")
    reason: Exception | None = None
    try:
        config = yaml.load(load_config.read_text(encoding="utf-8"), Loader=_SettingsLoader)
    except ForeignNameError as error:
        raise InputError(
            f"{load_config}: {error.problem}, which is no part of a run's settings and might do anything when it is "
            "read; use only runs that you trust."
        ) from error
    # Old files name modules and classes that are gone, and damaged ones fail in as many ways.
    except (
        *(yaml.YAMLError, AttributeError, ImportError, IndexError, KeyError, OSError, RecursionError, TypeError),
        ValueError,
    ) as error:
        config, reason = None, error
    if not isinstance(config, TrainerConfig) or _missing_settings(config):
        raise InputError(
            f"{load_config}: cannot be read; give the config.yml of a run that this version of hsi-sc-nerf trained."
        ) from reason
    return config


def relocated_run(config: TrainerConfig, load_config: Path) -> TrainerConfig:
    """Settings with the paths of where the run lies, which may have been moved, or trained from another folder.

    Checkpoints are looked for beside the file, the dataset by `find_dataset`.

    Args:
        config: the settings, which are changed.
        load_config: the file that holds them.
    """
    # By path alone: ns-eval writes the names of experiment and method, which a moved folder need not have.
    config.get_base_dir = lambda: load_config.parent  # type: ignore[method-assign]
    manager = config.pipeline.datamanager
    if manager.data is not None:
        manager.data = find_dataset(manager.data, load_config) or manager.data
    return config


def require_method(config: TrainerConfig, load_config: Path) -> None:
    """Refuse settings that name no method, which nerfstudio looks up to open a run.

    Raises:
        InputError: there is no such method, or none is named.
    """
    from nerfstudio.configs.method_configs import all_methods  # which imports the plugins, and so this file

    if not (isinstance(config.method_name, str) and config.method_name in all_methods):
        raise InputError(
            f"{load_config}: names the method {shown(config.method_name)}, which nerfstudio does not know; set "
            "its method_name to that of the training, such as hsi-sc-nerf."
        )


def discard_unbegun(folder: Path) -> None:
    """Delete the folder of a run that was refused, if all in it was written before training, and empty ones above."""
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if not files or any(path.parent != folder or path.name not in _BEFORE_TRAINING for path in files):
        return
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):  # those of the experiment and the method may hold other runs
        for above in folder.parents[:2]:
            above.rmdir()


class ForeignNameError(yaml.constructor.ConstructorError):
    """The file names something that settings of a run are not made of."""


class _SettingsLoader(yaml.Loader):
    """yaml.Loader that takes names from `_PACKAGES` and torch's optimisers, and makes settings, paths and enums."""

    def flatten_mapping(self, node: yaml.Node) -> None:
        """Settings have no merge keys, by which a short file could stand for more than fits into memory."""

    def find_python_name(self, name: str, mark: Any) -> Any:
        package = name.partition(".")[0]
        if name.startswith("pathlib."):
            found = getattr(importlib.import_module("pathlib"), name.removeprefix("pathlib."), None)
            allowed = isinstance(found, type) and issubclass(found, PurePath)
        elif name in _FUNCTIONS:
            found, allowed = super().find_python_name(name, mark), True  # type: ignore[misc]
        elif package in _PACKAGES or name.startswith(f"{_OPTIMIZERS}."):
            found = super().find_python_name(name, mark)  # type: ignore[misc]
            # A module of ours may have imported something else, such as Popen.
            home = found.__module__ if isinstance(found, type) else ""
            allowed = home.partition(".")[0] in _PACKAGES or home.startswith(f"{_OPTIMIZERS}.")
        else:
            allowed = False
        if not allowed:
            raise ForeignNameError(None, None, f"it names {name}", mark)
        return found

    def find_python_module(self, name: str, mark: Any) -> Any:
        raise ForeignNameError(None, None, f"it names the module {name}", mark)

    def make_python_instance(
        self,
        suffix: str,
        node: yaml.Node,
        args: list | None = None,
        kwds: dict | None = None,
        newobj: bool = False,
    ) -> Any:
        kind = self.find_python_name(suffix, node.start_mark)
        made_by_call = isinstance(kind, type) and issubclass(kind, enum.Enum | PurePath)
        if not (made_by_call or (newobj and dataclasses.is_dataclass(kind))):
            raise ForeignNameError(None, None, f"it makes a {suffix}", node.start_mark)
        return super().make_python_instance(suffix, node, args, kwds, newobj)  # type: ignore[misc]


def _missing_settings(value: object) -> bool:
    """Whether a dataclass of this package, anywhere in the settings, lacks a field that an older version had not."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return False
    own = type(value).__module__.startswith("hsi_sc_nerf")
    names = [field.name for field in dataclasses.fields(value)]
    missing = own and not all(hasattr(value, name) for name in names)
    return missing or any(_missing_settings(getattr(value, name, None)) for name in names)
