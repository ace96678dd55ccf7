"""Spectral point clouds as tables that xarray opens, with the wavelength as a coordinate: NetCDF-4 and Zarr.

Dimensions ``point`` and ``wavelength``; ``reflectance`` (point, wavelength); ``wavelength`` in nm; ``x y z`` (metres,
object frame), ``nx ny nz``, ``red green blue`` and the extra columns, a value a point. Written without xarray, which
would want the whole table at once.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CHUNK_POINTS, CloudStream, SpectralCloud
from hsi_sc_nerf.export.optional import require
from hsi_sc_nerf.files import TEMPORARY_PREFIX, atomic_write

_ATTRIBUTES = {"title": "spectral point cloud", "frame": "object: z along the turntable's axis, up; metres"}


@dataclass(frozen=True)
class _Variable:
    """A variable of the table with a row a point, and where its rows come from."""

    name: str
    rows_of: Callable[[SpectralCloud], np.ndarray]
    dtype: str = "<f4"
    dimensions: tuple[str, ...] = ("point",)
    attributes: dict[str, str] = field(default_factory=dict)


def _variables(cloud: CloudStream) -> list[_Variable]:
    def column(name: str, axis: int) -> Callable[[SpectralCloud], np.ndarray]:
        return lambda chunk: getattr(chunk, name)[:, axis]

    def extra(name: str) -> Callable[[SpectralCloud], np.ndarray]:
        return lambda chunk: chunk.extra[name]

    reflectance = {"units": "1", "long_name": "reflectance", "coordinates": "x y z"}
    return [
        _Variable("reflectance", lambda chunk: chunk.spectra, "<f4", ("point", "wavelength"), reflectance),
        *(_Variable(axis, column("points", i), attributes={"units": "m"}) for i, axis in enumerate("xyz")),
        *(_Variable(f"n{axis}", column("normals", i), attributes={"units": "1"}) for i, axis in enumerate("xyz")),
        *(_Variable(name, column("colours", i), "u1") for i, name in enumerate(("red", "green", "blue"))),
        *(_Variable(name, extra(name)) for name in cloud.extra_names),
    ]


_WAVELENGTH_ATTRIBUTES = {"units": "nm", "long_name": "centre of the band"}


def write_netcdf_stream(path: Path, cloud: CloudStream) -> None:
    """Write a cloud as NetCDF-4, piece by piece, whole or not at all.

    Raises:
        InputError: the package h5netcdf is missing, or the file cannot be written.
        ValueError: the pieces do not fit together.
    """
    h5netcdf = require("h5netcdf", "a NetCDF file")
    variables = _variables(cloud)
    with atomic_write(path) as (temporary,), h5netcdf.File(temporary, "w") as file:
        file.attrs.update(_ATTRIBUTES)
        file.dimensions = {"point": cloud.count, "wavelength": len(cloud.wavelengths_nm)}
        wavelength = file.create_variable("wavelength", ("wavelength",), "<f8", data=cloud.wavelengths_nm)
        wavelength.attrs.update(_WAVELENGTH_ATTRIBUTES)
        for variable in variables:
            created = file.create_variable(variable.name, variable.dimensions, variable.dtype)
            created.attrs.update(variable.attributes)
        for rows, chunk in cloud.placed():
            for variable in variables:
                file.variables[variable.name][rows] = variable.rows_of(chunk)


def require_replaceable(path: Path) -> None:
    """Refuse a place where something else than a Zarr folder is.

    Raises:
        InputError: it is.
    """
    if path.exists() and not (path / "zarr.json").is_file():
        raise InputError(f"{path}: is no Zarr folder and will not be replaced by one; choose another output folder.")


def write_zarr_stream(path: Path, cloud: CloudStream) -> None:
    """Write a cloud as a Zarr folder (format 3), piece by piece, whole or not at all; one that is there is replaced.

    Raises:
        InputError: the package zarr is missing, ``path`` is something else than a Zarr folder, or cannot be written.
        ValueError: the pieces do not fit together.
    """
    zarr = require("zarr", "a Zarr folder")
    require_replaceable(path)
    sizes = {"point": cloud.count, "wavelength": len(cloud.wavelengths_nm)}
    pieces = {"point": max(1, min(CHUNK_POINTS, cloud.count)), "wavelength": len(cloud.wavelengths_nm)}
    variables = _variables(cloud)
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        group = zarr.open_group(str(temporary), mode="w", zarr_format=3)
        group.attrs.update(_ATTRIBUTES)

        def create(name: str, dtype: str, dimensions: tuple[str, ...], attributes: dict[str, str]) -> Any:
            return group.create_array(
                name,
                shape=tuple(sizes[dimension] for dimension in dimensions),
                chunks=tuple(pieces[dimension] for dimension in dimensions),
                dtype=dtype,
                dimension_names=dimensions,
                attributes=attributes,
            )

        create("wavelength", "<f8", ("wavelength",), _WAVELENGTH_ATTRIBUTES)[:] = cloud.wavelengths_nm
        arrays = [create(v.name, v.dtype, v.dimensions, v.attributes) for v in variables]
        for rows, chunk in cloud.placed():
            for variable, array in zip(variables, arrays, strict=True):
                array[rows] = variable.rows_of(chunk)
        if path.exists():
            shutil.rmtree(path)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or choose another folder."
        ) from error
    finally:
        with suppress(FileNotFoundError):
            shutil.rmtree(temporary)
