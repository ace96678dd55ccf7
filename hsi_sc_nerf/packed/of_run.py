"""The packed dataset that a run was trained on, looked for in a moment: to open a run takes many seconds."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import transforms_path

_DATA_KEYS, _OUTPUT_KEYS = ("pipeline", "datamanager", "data"), ("output_dir",)
_DEPTH = 3
"""Folders from ``--output-dir`` to ``config.yml``: experiment, method and time."""


def require_dataset_of_run(load_config: Path) -> None:
    """Look for the dataset where `hsi_sc_nerf.models.trained_run.open_trained_run` will.

    A ``config.yml`` that is missing or that tells of no dataset is left to that.

    Raises:
        InputError: the dataset is not there.
    """
    named = _named_path(load_config, _DATA_KEYS)
    if named is not None and find_dataset(named, load_config) is None:
        raise InputError(
            f"{load_config}: was trained on the packed dataset {named}, which is not there; put it back, or call the "
            "command in the folder that the training was started in."
        )


def find_dataset(named: Path, load_config: Path) -> Path | None:
    """Where a run's dataset lies now, None if it is not there.

    A relative path is that of the folder in which the training was started. Where ``--output-dir`` was relative too,
    that folder follows from where the run lies; otherwise the working folder is tried, and then the run's folder
    upwards. With an absolute path, run and dataset may have been moved together.

    Args:
        named: path of the dataset in the run's settings.
        load_config: the run's ``config.yml``.
    """
    folders = load_config.resolve().parents
    candidates = [named, *(folder / named for folder in folders)]
    before = _named_path(load_config, _OUTPUT_KEYS)
    if before is not None and before.is_absolute() == named.is_absolute() and len(folders) > _DEPTH:
        beside = folders[_DEPTH] / os.path.relpath(named, before)
        # The same relative path can name another run's dataset in the working folder.
        candidates.insert(len(candidates) if named.is_absolute() else 0, beside)
    return next((path for path in candidates if transforms_path(path).is_file()), None)


def _named_path(load_config: Path, keys: tuple[str, ...]) -> Path | None:
    """A path in a run's settings, by the keys that lead to it; None where there is none."""
    try:
        # Nodes alone: nothing that the file names is made or called.
        node = yaml.compose(load_config.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError):
        return None
    for key in keys:
        if not isinstance(node, yaml.MappingNode):
            return None
        node = next((value for name, value in node.value if name.value == key), None)
    if not isinstance(node, yaml.SequenceNode) or not node.value:
        return None
    parts = [part.value for part in node.value]
    return Path(*parts) if all(isinstance(part, str) for part in parts) else None
