"""The table that NetCDF, Zarr and xarray hold of a cloud: its variables, by the CF conventions 1.11.

The dimensions are ``point`` and ``wavelength`` (nm). ``reflectance`` (point, wavelength), likewise ``material`` where
the cloud has the material's columns; per point ``x y z`` (metres, object frame: a local frame, so that there is no
grid mapping), ``nx ny nz``, ``red green blue`` and the other extra columns. Standard deviations are the
``ancillary_variables`` of what they are of. Where nothing gave the scale, the attribute ``scale`` says so and
positions have the unit 1. Wavelengths ascend, also those of a camera whose bands do not: xarray finds the nearest
one only so.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Shaped

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    COLOURS,
    COLUMNS,
    MATERIAL,
    NORMALS,
    REFLECTANCE,
    UNSCALED,
    CloudStream,
    SpectralCloud,
    band_property_names,
    cloud_attributes,
    material_names,
    stream,
)

if TYPE_CHECKING:
    import xarray  # an optional package

WAVELENGTH_ATTRIBUTES = {"units": "nm", "long_name": "centre of the band", "standard_name": "radiation_wavelength"}
_ANCILLARY = {"reflectance": ("spectral_std", "sampled_std"), "irradiance": ("irradiance_std",)}
"""Standard deviations by the variable that they are of."""


def to_xarray(cloud: SpectralCloud, run: str = "") -> xarray.Dataset:
    """A cloud as an xarray dataset, as it is opened from the NetCDF file of the cloud.

    Raises:
        InputError: xarray is not installed.

    Example:
        >>> table = to_xarray(read_spectral_ply("point_cloud.ply"))
        >>> dict(table.sizes), table.reflectance.sel(wavelength=670, method="nearest").wavelength.units
        ({'point': 30, 'wavelength': 204}, 'nm')
    """
    try:
        import xarray
    except ImportError as error:
        raise InputError(
            "to_xarray needs the package xarray, which is not installed; run `pip install 'hsi-sc-nerf[formats]'`."
        ) from error
    cloud = cloud.with_ascending_bands()
    columns = table_columns(cloud)
    variables = {
        name: (dimensions, columns[name].astype(dtype), attributes)
        for name, dtype, dimensions, attributes in table_variables(stream(cloud))
    }
    positions = {axis: variables.pop(axis) for axis in "xyz"}
    wavelength = ("wavelength", np.asarray(cloud.wavelengths_nm, float), WAVELENGTH_ATTRIBUTES)
    return xarray.Dataset(variables, positions | {"wavelength": wavelength}, table_attributes(run, cloud.metric))


def from_xarray(table: xarray.Dataset) -> SpectralCloud:
    """The cloud in a dataset that `to_xarray` or a cloud's NetCDF file or Zarr folder gave.

    Raises:
        InputError: a variable of a cloud is missing, or has other dimensions, or one of the points holds no numbers.

    Example:
        >>> table = to_xarray(read_spectral_ply("point_cloud.ply"))
        >>> len(from_xarray(table.isel(point=slice(10))))
        10
    """
    needed = ("reflectance", "wavelength", *"xyz", *NORMALS, *COLOURS)
    missing = [name for name in needed if name not in table.variables]
    if missing or table["reflectance"].dims != ("point", "wavelength"):
        lacking = ", ".join(missing) or "reflectance (point, wavelength)"
        raise InputError(f"the table has no {lacking}; give one that to_xarray or `hsi-sc-nerf export` made.")
    wavelengths_nm = table["wavelength"].values
    others = [name for name in table.variables if name not in needed and table[name].dims == ("point",)]
    if no_numbers := [str(name) for name in others if table[name].dtype.kind not in "biuf"]:
        raise InputError(
            f"the table's {', '.join(no_numbers)} holds no numbers, which alone a cloud has for its points; drop it "
            f"(table.drop_vars({no_numbers})), or give numbers in its place."
        )
    extra = {str(name): table[name].values for name in others}
    if "material" in table:
        extra |= zip(band_property_names(wavelengths_nm, "material"), table["material"].values.T, strict=True)
    points, normals, colours = (
        np.stack([table[name].values for name in names], axis=1) for names in ("xyz", NORMALS, COLOURS)
    )
    metric = "scale" not in table.attrs
    return SpectralCloud(points, normals, colours, table["reflectance"].values, wavelengths_nm, extra, metric)


def table_variables(cloud: CloudStream) -> Iterator[tuple[str, str, tuple[str, ...], dict[str, str]]]:
    """Name, type, dimensions and attributes of each variable; the positions of points are coordinates."""
    extra_names = cloud.extra_names
    meanings = {"reflectance": REFLECTANCE, "material": MATERIAL} | COLUMNS
    meanings |= {} if cloud.metric else UNSCALED
    of_material = material_names(cloud.wavelengths_nm, extra_names)
    spectral = ("reflectance", "material") if of_material else ("reflectance",)
    others = (name for name in extra_names if name not in of_material)
    for name in (*spectral, *"xyz", *NORMALS, *COLOURS, *others):
        attributes = dict(zip(("units", "long_name"), meanings.get(name, ()), strict=False))
        if known := [std for std in _ANCILLARY.get(name, ()) if std in extra_names]:
            attributes["ancillary_variables"] = " ".join(known)
        if name in spectral:
            yield name, "<f4", ("point", "wavelength"), attributes
        else:
            yield name, "u1" if name in COLOURS else "<f4", ("point",), attributes


def table_columns(cloud: SpectralCloud) -> dict[str, Shaped[np.ndarray, "n *bands"]]:
    """The numbers of each variable."""
    extra = dict(cloud.extra)
    material = [extra.pop(name) for name in material_names(cloud.wavelengths_nm, tuple(extra))]
    return {
        "reflectance": cloud.spectra,
        **({"material": np.stack(material, axis=-1)} if material else {}),
        **dict(zip("xyz", cloud.points.T, strict=True)),
        **dict(zip(NORMALS, cloud.normals.T, strict=True)),
        **dict(zip(COLOURS, cloud.colours.T, strict=True)),
        **extra,
    }


def table_attributes(run: str, metric: bool) -> dict[str, str]:
    """What a table says of itself."""
    return {"Conventions": "CF-1.11", **cloud_attributes(run, metric)}
