"""Checkpoints: written atomically, found, and read with torch's safe loader."""

from __future__ import annotations

import os
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from hsi_sc_nerf.errors import InputError

CHECKPOINT_KEYS = {"step", "pipeline", "optimizers", "scalers", "training"}
"""Keys of a checkpoint that a run can be resumed from."""
_EARLIER = "take an earlier one"
_NAME = re.compile(r"step-\d{9,}\.ckpt")


def allow_nerfstudio_checkpoints() -> None:
    """Register the NumPy types in nerfstudio 1.1.5's checkpoints as safe.

    Since torch 2.6, ``torch.load`` refuses unknown types, and ns-eval, ns-export and ns-viewer fail on nerfstudio's
    own files. Registering these few types keeps the safe loader in use.
    """
    torch.serialization.add_safe_globals(
        [np._core.multiarray.scalar, np.dtype, *(type(np.dtype(t)) for t in (np.float32, np.float64, np.int64))]
    )


def checkpoint_path(folder: Path, step: int) -> Path:
    """Path at which nerfstudio looks for the checkpoint of ``step``."""
    return folder / f"step-{step:09d}.ckpt"


@contextmanager
def _appearing_whole(path: Path) -> Iterator[Path]:
    """A temporary file in a folder beside that of ``path``, moved to it at the end of the block.

    nerfstudio takes every file of a checkpoint folder for a checkpoint, so that an unfinished one must never lie
    there.

    Raises:
        InputError: it could not be written; the folder of ``path`` has not changed.
    """
    folder = path.parent.with_name(f".{path.parent.name}-writing")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder / path.name
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(folder / path.name, path)
    except (OSError, RuntimeError) as error:  # torch's writer raises the latter on a full disk
        raise InputError(
            f"{path}: the checkpoint could not be written ({error}); free some space and resume with --load-dir from "
            "the checkpoint before it."
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint whole or not at all.

    Raises:
        InputError: it could not be written.
    """
    with _appearing_whole(path) as temporary:
        torch.save(state, temporary)


def link_checkpoint(path: Path, folder: Path) -> None:
    """Keep a checkpoint in a second folder, as a hard link where the file system has them, else as a copy.

    Raises:
        InputError: it could not be written.
    """
    with _appearing_whole(folder / path.name) as temporary:
        try:
            os.link(path, temporary)
        except OSError:
            shutil.copy2(path, temporary)


def find_checkpoint(
    folder: Path,
    step: int | None = None,
    remedy: str = "--load-dir takes a run's nerfstudio_models or stage folder",
) -> Path:
    """The checkpoint of ``step`` in ``folder``, or the latest; what has another name is none.

    Args:
        remedy: what to do if there is none, the end of the error's sentence.

    Raises:
        InputError: there is none.
    """
    path: Path | None = None if step is None else checkpoint_path(folder, step)
    if step is None:
        path = max((found for found in folder.glob("*.ckpt") if _NAME.fullmatch(found.name)), default=None)
    if path is None or not path.is_file():
        missing = "checkpoint" if step is None else f"checkpoint of step {step}"
        raise InputError(f"{folder}: holds no {missing}; {remedy}.")
    return path


def require_no_others(folder: Path) -> None:
    """Refuse a folder with other files than checkpoints: nerfstudio reads the step in every file's name.

    Raises:
        InputError: there is one.
    """
    for path in sorted(folder.iterdir()):
        if not _NAME.fullmatch(path.name):
            raise InputError(f"{path}: is no checkpoint, and nerfstudio takes it for one; move it elsewhere.")


def require_whole(path: Path) -> None:
    """Compare a checkpoint with the checksums in it; torch does not, and fails on damage in many ways.

    Raises:
        InputError: it is damaged, missing or no checkpoint.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (
        *(OSError, EOFError, NotImplementedError, OverflowError, RuntimeError, ValueError),
        *(struct.error, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise InputError(f"{path}: is not a readable checkpoint ({error}); {_EARLIER}.") from error
    if damaged is not None:
        raise InputError(f"{path}: is not a readable checkpoint (its part {damaged} is damaged); {_EARLIER}.")


def require_model(path: Path) -> None:
    """Refuse a checkpoint that is damaged or holds no model, before nerfstudio fails on it.

    Raises:
        InputError: it is such a checkpoint.
    """
    state = _load(path, mmap=True)
    step, model = state.get("step"), state.get("pipeline")
    if not (isinstance(step, int) and isinstance(model, dict) and all(map(torch.is_tensor, model.values()))):
        raise InputError(f"{path}: is no checkpoint of a model; {_EARLIER}.")


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint of the staged trainer to the CPU.

    Raises:
        InputError: the file is damaged, missing or no such checkpoint.
    """
    state = _load(path)
    if not state.keys() >= CHECKPOINT_KEYS:
        raise InputError(f"{path}: is not a checkpoint that hsi-sc-nerf can continue from; train anew.")
    return state


def _load(path: Path, mmap: bool = False) -> dict[str, Any]:
    """The content of a checkpoint that is whole; with ``mmap``, numbers are read when they are looked at."""
    require_whole(path)
    try:
        state = torch.load(path, map_location="cpu", mmap=mmap)
    except (OSError, EOFError, RuntimeError, UnpicklingError) as error:
        raise InputError(f"{path}: is not a readable checkpoint ({error}); {_EARLIER}.") from error
    return state if isinstance(state, dict) else {}
