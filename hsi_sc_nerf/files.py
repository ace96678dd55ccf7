"""Atomic writing: files appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from hsi_sc_nerf.errors import InputError

TEMPORARY_PREFIX = ".partial-"


@contextmanager
def atomic_write(*paths: Path) -> Iterator[list[Path]]:
    """Context manager that gives a temporary file for each path and renames it to the path at the end of the block.

    The temporary files lie beside the paths, are hidden, and have the same suffixes. If the block fails, they are
    deleted and the files at ``paths`` stay as they are. Missing folders are made.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).

    Example:
        >>> with atomic_write(Path("out/table.csv")) as (temporary,):
        ...     temporary.write_text("a,b")
    """
    temporary = [path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}") for path in paths]
    try:
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        for source, target in zip(temporary, paths, strict=True):
            os.replace(source, target)
    except OSError as error:
        raise InputError(
            f"{paths[0]}: cannot be written ({error.strerror or error}); free some space or choose another folder."
        ) from error
    finally:
        for source in temporary:
            # A file that cannot be deleted was not written; the error above says why.
            with suppress(OSError):
                source.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and its missing parents.

    Raises:
        InputError: the operating system refused, or something else has that name.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made a folder ({error.strerror or error}); choose another one."
        ) from error


def require_writable(folder: Path) -> None:
    """Refuse a folder that could not be written to, before anything is computed for it; nothing is made.

    Raises:
        InputError: something else has its name or a parent's, or the system does not permit to write there.
    """
    there = folder.absolute()
    while not os.path.lexists(there):
        there = there.parent
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        why = "may not be written to" if there.is_dir() else "is no folder"
        raise InputError(f"{folder}: cannot be written to, because {there} {why}; choose another folder.")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` as indented JSON.

    Raises:
        InputError: the operating system refused to write.
    """
    with atomic_write(path) as (temporary,):
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_png(path: Path, image: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write an 8-bit gray or RGB image.

    Raises:
        InputError: the operating system refused to write.
    """
    bgr = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(bgr))
    with atomic_write(path) as (temporary,):
        temporary.write_bytes(encoded.tobytes())
