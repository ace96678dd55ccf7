"""The kinds of file that clouds are written as."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from hsi_sc_nerf.export.cloud import CloudStream
from hsi_sc_nerf.export.las import write_las_stream
from hsi_sc_nerf.export.optional import require
from hsi_sc_nerf.export.ply import write_ply_stream
from hsi_sc_nerf.export.tables import write_netcdf_stream, write_zarr_stream

CloudFormat = Literal["ply", "las", "netcdf", "zarr"]
_WRITERS: dict[CloudFormat, tuple[str, Callable[[Path, CloudStream], None]]] = {
    "ply": (".ply", write_ply_stream),
    "las": (".las", write_las_stream),
    "netcdf": (".nc", write_netcdf_stream),
    "zarr": (".zarr", write_zarr_stream),
}
_PACKAGES: dict[CloudFormat, tuple[str, str]] = {
    "las": ("laspy", "a LAS file"),
    "netcdf": ("h5netcdf", "a NetCDF file"),
    "zarr": ("zarr", "a Zarr folder"),
}


def require_format(file_format: CloudFormat) -> None:
    """Refuse a kind of file whose package is missing, before anything is computed.

    Raises:
        InputError: a package is missing.
    """
    if file_format in _PACKAGES:
        require(*_PACKAGES[file_format])


def write_cloud(path_without_suffix: Path, cloud: CloudStream, file_format: CloudFormat) -> Path:
    """Write a cloud, whole or not at all, and return its path (``.ply``, ``.las``, ``.nc``, ``.zarr``).

    Raises:
        InputError: a package is missing, or the file cannot be written.
        ValueError: the pieces do not fit together.
    """
    suffix, write = _WRITERS[file_format]
    path = path_without_suffix.with_name(path_without_suffix.name + suffix)
    write(path, cloud)
    return path
