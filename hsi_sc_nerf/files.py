"""Atomic writing: files appear whole or not at all."""

from __future__ import annotations

import glob
import json
import math
import os
import shutil
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from hsi_sc_nerf.errors import InputError

TEMPORARY_PREFIX = ".partial-"
# Bytes that DEFLATE makes of one byte at most.
LARGEST_DEFLATION = 1032
_MODES = {1: cv2.IMREAD_GRAYSCALE, 3: cv2.IMREAD_COLOR}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Number of channels by PNG's number of the kind of colour."""


@contextmanager
def atomic_write(*paths: Path) -> Iterator[list[Path]]:
    """Context manager that gives a temporary file for each path and renames it to the path at the end of the block.

    The temporary files lie beside the paths, are hidden, and have the same suffixes. If the block fails, they are
    deleted and the files at ``paths`` stay as they are. Missing folders are made. What processes that were killed
    left of the same files is deleted. In place of a file the block may make a folder, which replaces a folder.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).

    Example:
        >>> with atomic_write(Path("out/table.csv")) as (temporary,):
        ...     temporary.write_text("a,b")
    """
    temporary = [path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}") for path in paths]
    earlier = [path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-earlier-{path.name}") for path in paths]
    try:
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            delete_remains(path)
        yield temporary
        for source, target, aside in zip(temporary, paths, earlier, strict=True):
            if source.is_dir() and target.is_dir():
                os.rename(target, aside)  # a folder cannot replace one that holds something
            os.replace(source, target)
    except OSError as error:
        # Not the temporary name that an outer `atomic_write` has given.
        target = paths[0].with_name(paths[0].name.removeprefix(f"{TEMPORARY_PREFIX}{os.getpid()}-"))
        raise InputError(
            f"{target}: cannot be written ({error.strerror or error}); free some space or choose another folder."
        ) from error
    finally:
        for remains in (*temporary, *earlier):
            _delete(remains)


def delete_remains(path: Path) -> None:
    """Delete the temporary files and folders of ``path`` whose processes have ended: these were killed."""
    for remains in path.parent.glob(f"{TEMPORARY_PREFIX}*-{glob.escape(path.name)}"):
        process = remains.name.removeprefix(TEMPORARY_PREFIX).partition("-")[0]
        if process.isdecimal() and not _is_running(int(process)):
            _delete(remains)


def _delete(path: Path) -> None:
    """Delete a file or a folder; what cannot be deleted stays."""
    if os.path.isdir(path):  # unlike that of a path, it takes a folder that may not be looked into
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name != "posix":  # where asking would end it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def make_folder(path: Path) -> None:
    """Make a folder and its missing parents.

    Raises:
        InputError: the operating system refused, or something else has that name.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be created as a folder ({error.strerror or error}); choose another one."
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


def require_writable_file(path: Path) -> None:
    """`require_writable` for a file to be written.

    Raises:
        InputError: a folder has its name, or its own folder cannot be written to.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file in it.")
    require_writable(path.parent)


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """The object in a JSON file.

    Args:
        remedy: what to do if it cannot be read, the end of the error's sentence.

    Raises:
        InputError: the file cannot be read or is not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        # JSON can spell halves of characters, which no file can be written with.
        json.dumps(content, ensure_ascii=False).encode("utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {remedy}.") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not a JSON object ({error}); {remedy}.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: is not a JSON object; {remedy}.")
    return content


@contextmanager
def content_of(path: Path, what: str, remedy: str = "make it again") -> Iterator[None]:
    """Refuse a file in one sentence if reading figures from its content fails, however damaged that is.

    Raises:
        InputError: it does.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no {what} ({error}); {remedy}.") from error


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` as indented JSON.

    Raises:
        InputError: the operating system refused to write.
    """
    with atomic_write(path) as (temporary,):
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def nan_to_none(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values with None for NaN, which JSON has no word for."""
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in values.items()}


def read_picture(path: Path, channels: Literal[1, 3]) -> UInt8[np.ndarray, "h w *channels"] | None:
    """A PNG as 8-bit gray values (h, w) or RGB (h, w, 3); None where the file is none that can be read."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if not _is_whole_png(content):
        return None
    image = cv2.imdecode(np.frombuffer(content, np.uint8), _MODES[channels])
    return None if image is None else image if channels == 1 else image[..., ::-1]


def _is_whole_png(content: bytes) -> bool:
    """Whether a PNG's parts fit their checksums, and its head the file: OpenCV makes room for whatever they claim."""
    if content[:16] != b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR":
        return False
    at, view = 8, memoryview(content)
    while at < len(content):
        end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big") or end + 4 > len(content):
            return False
        at = end + 4
    width, height, depth, colour = struct.unpack(">IIBB", view[16:26])
    return width * height * depth * _PNG_CHANNELS.get(colour, 4) // 8 <= LARGEST_DEFLATION * len(content)


def write_png(path: Path, image: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write an 8-bit gray or RGB image.

    Raises:
        InputError: the operating system refused to write.
    """
    bgr = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(bgr))
    with atomic_write(path) as (temporary,):
        temporary.write_bytes(encoded.tobytes())
