"""Write spectral point clouds as PLY, LAS, NetCDF or Zarr.

LAS 1.4 holds each band as a dimension of extra bytes (ASPRS LAS 1.4 R15, "Extra Bytes"). NetCDF-4 and Zarr are the
tables of `table`, which xarray opens. They are written without xarray, which needs the whole table at once.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hsi_sc_nerf import __version__
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    CHUNK_POINTS,
    COLOURS,
    NORMALS,
    CloudStream,
    band_property_names,
    comment_lines,
    write_spectral_ply,
)
from hsi_sc_nerf.export.table import WAVELENGTH_ATTRIBUTES, table_attributes, table_columns, table_variables
from hsi_sc_nerf.files import atomic_write

CloudFormat = Literal["ply", "las", "netcdf", "zarr"]
_SUFFIXES: dict[CloudFormat, str] = {"ply": ".ply", "las": ".las", "netcdf": ".nc", "zarr": ".zarr"}
_PACKAGES: dict[CloudFormat, str] = {"las": "laspy", "netcdf": "h5netcdf", "zarr": "zarr"}

LAS_STEP_M = 1e-6
"""LAS stores positions as whole steps."""
LAS_MAX_DIMENSIONS = 341
"""A dimension of extra bytes is described by 192 bytes, and all descriptions share one record of at most 65535."""
_NETCDF_BYTES = 1 << 18
"""More than names, attributes and wavelengths take in a NetCDF file."""
_LAS_POINT_FORMAT = 7
"""Number of the LAS point format with colours."""
_LAS_TEXT_RECORD = 3
"""The specification's record for a text that describes the file."""
_LAS_NORMALS = ("NormalX", "NormalY", "NormalZ")  # CloudCompare takes these for normals
_EIGHT_TO_SIXTEEN_BITS = 257


def write_cloud(path_without_suffix: Path, cloud: CloudStream, file_format: CloudFormat) -> Path:
    """Write a cloud, whole or not at all, and return its path (``.ply``, ``.las``, ``.nc``, ``.zarr``).

    Raises:
        InputError: a package is missing, the format has no room for so many bands or for a column's name, or the file
            cannot be written.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> write_cloud(Path("out/point_cloud"), stream(cloud), "netcdf")
        PosixPath('out/point_cloud.nc')
    """
    path = require_format(path_without_suffix, file_format, len(cloud.wavelengths_nm), len(cloud.extra_names))
    if file_format in ("netcdf", "zarr"):
        names = ["wavelength", *(name for name, *_ in table_variables(cloud))]
        if odd := [name for name in names if "/" in name or names.count(name) > 1]:  # groups are separated by /
            raise InputError(f"{path}: cannot hold a column named {odd[0]}; give it another name, without /.")
        ascending = (chunk.with_ascending_bands() for chunk in cloud.chunks)
        cloud = replace(cloud, wavelengths_nm=np.sort(cloud.wavelengths_nm), chunks=ascending)
    writers: dict[CloudFormat, Callable[[Path, CloudStream], None]] = {
        "ply": write_spectral_ply,
        "las": _write_las,
        "netcdf": _write_netcdf,
        "zarr": _write_zarr,
    }
    writers[file_format](path, cloud)
    return path


def format_of(path: Path) -> CloudFormat:
    """The format that the suffix of a file names.

    Raises:
        InputError: it names none.
    """
    for file_format, suffix in _SUFFIXES.items():
        if path.suffix.lower() == suffix:
            return file_format
    raise InputError(f"{path}: is not a file name of a cloud; let it end in {', '.join(_SUFFIXES.values())}.")


def require_format(path_without_suffix: Path, file_format: CloudFormat, num_bands: int, num_extra: int) -> Path:
    """Refuse what `write_cloud` could not write, before anything is computed, and return the path with its suffix.

    Raises:
        InputError: a package is missing, the format has no room for so many bands, or the Zarr folder would replace
            something else.
    """
    path = path_without_suffix.with_name(path_without_suffix.name + _SUFFIXES[file_format])
    if file_format in _PACKAGES:
        try:
            importlib.import_module(_PACKAGES[file_format])
        except ImportError as error:
            raise InputError(
                f"the format {file_format} needs the package {_PACKAGES[file_format]}, which is not installed; run "
                "`pip install 'hsi-sc-nerf[formats]'`, or export as PLY."
            ) from error
    material = num_bands if num_extra >= num_bands else 0  # columns of the material, one a band
    room = (LAS_MAX_DIMENSIONS - len(_LAS_NORMALS) - (num_extra - material)) // (2 if material else 1)
    if file_format == "las" and num_bands > room:
        raise InputError(
            f"{path}: LAS has room for {room} bands and the cloud has {num_bands}"
            f"{' with as many columns of the material' if material else ''}; export it with fewer bands (--bands), "
            "or write .ply or .nc."
        )
    if file_format == "zarr" and path.exists() and not (path / "zarr.json").is_file():
        raise InputError(f"{path}: is not a Zarr folder and is not replaced by one; choose another output folder.")
    return path


def _write_las(path: Path, cloud: CloudStream) -> None:
    """Write a LAS file: positions in steps of a micrometre, 16-bit colours, all else as float dimensions."""
    import laspy

    bands = [name.removeprefix("scalar_") for name in band_property_names(cloud.wavelengths_nm)]
    names = [*_LAS_NORMALS, *bands, *cloud.extra_names]
    header = laspy.LasHeader(point_format=_LAS_POINT_FORMAT, version="1.4")
    header.scales = np.full(3, LAS_STEP_M)
    header.global_encoding.wkt = True  # which LAS asks of this point format, even without a coordinate system
    header.system_identifier, header.generating_software = "hyperspectral turntable", f"hsi-sc-nerf {__version__}"
    # LAS itself says what colours are: 16-bit numbers.
    text = "\n".join(comment_lines([*"xyz", *NORMALS, *cloud.extra_names], cloud.run, cloud.metric))
    header.vlrs.append(laspy.VLR("LASF_Spec", _LAS_TEXT_RECORD, "text area description", text.encode()))
    header.add_extra_dims([laspy.ExtraBytesParams(name, "f4") for name in names])
    with atomic_write(path) as (temporary,), laspy.open(str(temporary), mode="w", header=header) as writer:
        for chunk in cloud.chunks:
            record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
            record.x, record.y, record.z = np.asarray(chunk.points, np.float64).T
            for name in ("return_number", "number_of_returns"):  # readers take 0 for damaged
                record[name] = np.ones(len(chunk), np.uint8)
            for name, channel in zip(COLOURS, chunk.colours.T, strict=True):
                record[name] = channel.astype(np.uint16) * _EIGHT_TO_SIXTEEN_BITS
            columns = [*chunk.normals.T, *chunk.spectra.T, *chunk.extra.values()]
            for name, values in zip(names, columns, strict=True):
                record[name] = values
            writer.write_points(record)


def _variables(cloud: CloudStream) -> Iterator[tuple[str, str, tuple[str, ...], dict[str, str]]]:
    """Name, type, dimensions and attributes of each variable as they stand in a file."""
    for name, dtype, dimensions, attributes in table_variables(cloud):
        yield name, dtype, dimensions, attributes | ({"coordinates": "x y z"} if "wavelength" in dimensions else {})


def _fill(variables: Mapping[str, Any], cloud: CloudStream) -> None:
    """Write the chunks into the variables of a table."""
    start = 0
    for chunk in cloud.chunks:
        for name, values in table_columns(chunk).items():
            variables[name][start : start + len(chunk)] = values
        start += len(chunk)


def _write_netcdf(path: Path, cloud: CloudStream) -> None:
    import h5netcdf

    sizes = {"point": cloud.count, "wavelength": len(cloud.wavelengths_nm)}
    variables = list(_variables(cloud))
    values = sum(np.dtype(dtype).itemsize * math.prod(sizes[d] for d in dims) for _, dtype, dims, _ in variables)
    with atomic_write(path) as (temporary,):
        _require_space(temporary, values + _NETCDF_BYTES)
        with h5netcdf.File(temporary, "w") as file:
            file.attrs.update(table_attributes(cloud.run, cloud.metric))
            file.dimensions = sizes
            wavelength = file.create_variable("wavelength", ("wavelength",), "<f8", data=cloud.wavelengths_nm)
            wavelength.attrs.update(WAVELENGTH_ATTRIBUTES)
            for name, dtype, dimensions, attributes in variables:
                file.create_variable(name, dimensions, dtype).attrs.update(attributes)
            _fill(file.variables, cloud)


def _require_space(path: Path, size_bytes: int) -> None:
    """Fail while a file is still empty if the disk has no room for it: HDF5 on a full disk ends the process."""
    if hasattr(os, "posix_fallocate"):
        with path.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, size_bytes)


def _write_zarr(path: Path, cloud: CloudStream) -> None:
    """Write a Zarr folder (format 3); an existing one is replaced."""
    import zarr

    sizes = {"point": cloud.count, "wavelength": len(cloud.wavelengths_nm)}
    chunk_sizes = sizes | {"point": max(1, min(CHUNK_POINTS, cloud.count))}
    with atomic_write(path) as (temporary,):
        group = zarr.open_group(str(temporary), mode="w", zarr_format=3)
        group.attrs.update(table_attributes(cloud.run, cloud.metric))

        def create(name: str, dtype: str, dimensions: tuple[str, ...], attributes: Mapping[str, str]) -> Any:
            return group.create_array(
                name,
                shape=tuple(sizes[dimension] for dimension in dimensions),
                chunks=tuple(chunk_sizes[dimension] for dimension in dimensions),
                dtype=dtype,
                dimension_names=dimensions,
                attributes=dict(attributes),
            )

        create("wavelength", "<f8", ("wavelength",), WAVELENGTH_ATTRIBUTES)[:] = cloud.wavelengths_nm
        _fill({variable[0]: create(*variable) for variable in _variables(cloud)}, cloud)
