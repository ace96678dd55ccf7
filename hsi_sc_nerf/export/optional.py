"""Packages that only some file formats need."""

from __future__ import annotations

import importlib
from types import ModuleType

from hsi_sc_nerf.errors import InputError


def require(package: str, file_kind: str) -> ModuleType:
    """Import a package that a kind of file needs.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"{file_kind} needs the package {package}, which is not installed; run "
            "`pip install 'hsi-sc-nerf[formats]'`, or export as PLY."
        ) from error
