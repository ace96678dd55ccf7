"""The kinds of file that clouds are written as."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from hsi_sc_nerf.export.cloud import CloudStream
from hsi_sc_nerf.export.las import require_room, write_las_stream
from hsi_sc_nerf.export.optional import require
from hsi_sc_nerf.export.ply import write_ply_stream
from hsi_sc_nerf.export.tables import require_replaceable, write_netcdf_stream, write_zarr_stream

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


def require_format(path_without_suffix: Path, file_format: CloudFormat, num_bands: int, num_extra: int) -> None:
    """Refuse what `write_cloud` could not write, before anything is computed.

    Args:
        path_without_suffix: as `write_cloud` takes it.
        file_format: likewise.
        num_bands: of the cloud.
        num_extra: extra columns of the cloud.

    Raises:
        InputError: a package is missing, the file has no room for so many bands, or something else is in its place.
    """
    if file_format in _PACKAGES:
        require(*_PACKAGES[file_format])
    path = _with_suffix(path_without_suffix, file_format)
    if file_format == "las":
        require_room(path, num_bands, num_extra)
    elif file_format == "zarr":
        require_replaceable(path)


def write_cloud(path_without_suffix: Path, cloud: CloudStream, file_format: CloudFormat) -> Path:
    """Write a cloud, whole or not at all, and return its path (``.ply``, ``.las``, ``.nc``, ``.zarr``).

    Raises:
        InputError: a package is missing, or the file cannot be written.
        ValueError: the pieces do not fit together.
    """
    path = _with_suffix(path_without_suffix, file_format)
    _, write = _WRITERS[file_format]
    write(path, cloud)
    return path


def _with_suffix(path: Path, file_format: CloudFormat) -> Path:
    return path.with_name(path.name + _WRITERS[file_format][0])
