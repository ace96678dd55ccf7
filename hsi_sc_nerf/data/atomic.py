"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
            source.unlink(missing_ok=True)
