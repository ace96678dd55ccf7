"""Checkpoints: written whole or not at all, found, and read with torch's safe loader."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from hsi_sc_nerf.errors import InputError

CONTENT = {"step", "pipeline", "optimizers", "scalers", "training"}
"""What the staged trainer's checkpoints hold, beside what nerfstudio's commands expect."""


def allow_nerfstudio_checkpoints() -> None:
    """Name the NumPy types that nerfstudio 1.1.5 puts into its checkpoints as safe.

    Since torch 2.6 ``torch.load`` refuses what it does not know, and ns-eval, ns-export and ns-viewer fail on
    nerfstudio's own files. Allowing these few types keeps the safe loader on.
    """
    torch.serialization.add_safe_globals(
        [np._core.multiarray.scalar, np.dtype, *(type(np.dtype(t)) for t in (np.float32, np.float64, np.int64))]
    )


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where nerfstudio looks for the checkpoint of ``step``."""
    return folder / f"step-{step:09d}.ckpt"


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint.

    nerfstudio takes every file of a checkpoint folder for a checkpoint: half of one, even of a run that was killed,
    must never lie there. It grows in a folder beside it.

    Raises:
        InputError: it could not be written; the folder of ``path`` is as it was.
    """
    growing = path.parent.with_name(f".{path.parent.name}-writing")
    try:
        growing.mkdir(parents=True, exist_ok=True)
        torch.save(state, growing / path.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(growing / path.name, path)
    except (OSError, RuntimeError) as error:  # torch's writer raises the latter on a full disk
        raise InputError(
            f"{path}: the checkpoint could not be written ({error}); free some space and resume with --load-dir from "
            "the checkpoint before it."
        ) from error
    finally:
        shutil.rmtree(growing, ignore_errors=True)


def link_checkpoint(path: Path, folder: Path) -> None:
    """Keep a checkpoint in a second folder, where it takes no space of its own if the file system can do that.

    Raises:
        InputError: there is no space for a copy.
    """
    kept = folder / path.name
    growing = path.parent.with_name(f".{folder.name}-writing") / path.name
    try:
        growing.parent.mkdir(parents=True, exist_ok=True)
        growing.unlink(missing_ok=True)
        try:
            os.link(path, growing)
        except OSError:
            shutil.copy2(path, growing)
        folder.mkdir(parents=True, exist_ok=True)
        os.replace(growing, kept)
    except OSError as error:
        raise InputError(f"{kept}: cannot be written ({error}); free some space.") from error
    finally:
        shutil.rmtree(growing.parent, ignore_errors=True)


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """The checkpoint of ``step`` in ``folder``, or the latest.

    Raises:
        InputError: there is none.
    """
    path = checkpoint_path(folder, step) if step is not None else max(folder.glob("step-*.ckpt"), default=None)
    if path is None or not path.is_file():
        wanted = "checkpoint" if step is None else f"checkpoint of step {step}"
        raise InputError(f"{folder}: holds no {wanted}; --load-dir takes a run's nerfstudio_models or stage folder.")
    return path


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint of the staged trainer to the CPU.

    Raises:
        InputError: the file is damaged, missing or no such checkpoint.
    """
    try:
        state = torch.load(path, map_location="cpu")
    except (OSError, EOFError, RuntimeError, UnpicklingError) as error:
        raise InputError(f"{path}: is no readable checkpoint ({error}); take an earlier one.") from error
    if not isinstance(state, dict) or not state.keys() >= CONTENT:
        raise InputError(f"{path}: is no checkpoint that hsi-sc-nerf can go on from; train anew.")
    return state
