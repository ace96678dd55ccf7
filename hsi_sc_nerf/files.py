"""Files that appear whole or not at all."""

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
    """Temporary siblings to write to, moved on to ``paths`` (in their order) when the block ends well.

    A sibling keeps its file's suffix and is hidden (its name begins with a dot). When the block fails, the
    siblings are deleted and the files that were at ``paths`` stay as they were. Missing folders are made.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).
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
            # What cannot be deleted was not written either; the error above says why.
            with suppress(OSError):
                source.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and what it lies in, where they are missing.

    Raises:
        InputError: the operating system refused, or something else has that name.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made a folder ({error.strerror or error}); choose another one."
        ) from error


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` as readable JSON, whole or not at all.

    Raises:
        InputError: the operating system refused to write.
    """
    with atomic_write(path) as (temporary,):
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_png(path: Path, image: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write an 8-bit gray or RGB picture, whole or not at all.

    Raises:
        InputError: the operating system refused to write.
    """
    in_opencv_order = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(in_opencv_order))
    with atomic_write(path) as (temporary,):
        temporary.write_bytes(encoded.tobytes())
