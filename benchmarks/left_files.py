"""Whether a command left the same files as another run of it: half-written ones, other results, leftovers."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import torch

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import read_picture
from hsi_sc_nerf.models.checkpoints import read_checkpoint, require_whole
from hsi_sc_nerf.models.run_settings import read_config

NOT_COMPARED = "events.out.tfevents"
SPEEDS = ("num_rays_per_sec", "fps")


def half_written(folder: Path, reference: Path) -> list[Path]:
    """Files under their final names that are not whole."""
    return [
        path
        for path in files_in(folder)
        if not any(part.startswith(".partial-") or part.endswith("-writing") for part in path.parts)
        and not _is_whole(folder / path, reference / path)
    ]


def state_of(folder: Path) -> set[tuple[Path, int]]:
    """The files in ``folder/out`` and when they were written."""
    out = folder / "out"
    found = set()
    for path in files_in(out):
        with contextlib.suppress(FileNotFoundError):  # temporary ones come and go
            found.add((path, (out / path).stat().st_mtime_ns))
    return found


def _is_whole(path: Path, reference: Path) -> bool:
    if reference.is_file() and reference.read_bytes() == path.read_bytes():
        return True
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".ckpt":
            require_whole(path)
        elif path.name == "config.yml":
            read_config(path)
        else:
            return path.suffix == ".png" and read_picture(path, 3) is not None
    except (InputError, ValueError):
        return False
    return True


def differences(reference: Path, folder: Path) -> list[Path]:
    """Files of the reference that are missing or have other contents."""
    return [path for path in files_in(reference) if not _is_same(reference / path, folder / path)]


def _is_same(reference: Path, found: Path) -> bool:
    if not found.is_file():
        return False
    if reference.suffix == ".ckpt":
        return _same_values(read_checkpoint(reference), read_checkpoint(found))
    if reference.name == "config.yml":
        one, other = (dataclasses.replace(read_config(path), load_dir=None) for path in (reference, found))
        return bool(one == other)
    if reference.parent.name.startswith("stage-"):
        return _metrics(reference) == _metrics(found)
    return reference.read_bytes() == found.read_bytes()


def _metrics(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text())
    results = {key: value for key, value in content["results"].items() if not key.startswith(SPEEDS)}
    return content | {"results": results}


def _same_values(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same_values(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_same_values, one, other))
    return bool(one == other)


def leftovers(folder: Path, reference: Path) -> list[Path]:
    """Files that the reference lacks."""
    return sorted(set(files_in(folder)) - set(files_in(reference)))


def files_in(folder: Path) -> list[Path]:
    """All files under a folder but TensorBoard's, relative to it; folders may vanish meanwhile."""
    paths = (Path(root, name).relative_to(folder) for root, _, names in os.walk(folder) for name in names)
    return sorted(path for path in paths if not path.name.startswith(NOT_COMPARED))
