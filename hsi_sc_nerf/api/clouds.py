"""A cloud as a notebook has it: its indices, its calibrations, its table, its file."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis.calibrations import Calibration, read_calibration
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud, material_spectra, read_spectral_ply, stream
from hsi_sc_nerf.export.formats import format_of, write_cloud
from hsi_sc_nerf.export.table import from_xarray, to_xarray
from hsi_sc_nerf.export.trial_reading import require_readable, require_room
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.indices.formula import index_values

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class Cloud(SpectralCloud):
    """Points with their spectra, as arrays: those of `SpectralCloud`.

    ``spectra`` are as measured. `index` and `calibration` take the material's where the cloud has them.
    """

    def __repr__(self) -> str:
        nm = self.wavelengths_nm
        columns = ", ".join(("points", "normals", "colours", "spectra", *self.extra))
        return f"<Cloud of {len(self):,} points, {len(nm)} bands from {nm[0]:g} to {nm[-1]:g} nm; {columns}>"

    @classmethod
    def of(cls, cloud: SpectralCloud) -> Cloud:
        """The same points."""
        return cls(**{field.name: getattr(cloud, field.name) for field in fields(SpectralCloud)})

    @property
    def material(self) -> Float[np.ndarray, "n bands"] | None:
        """Reflectance of the material; None without the columns of `hsi-sc-nerf material`."""
        return material_spectra(self)

    def index(self, word: str) -> Float[np.ndarray, "n"]:
        """An index at each point; NaN where it has no value.

        Args:
            word: a name of the catalogue (``"NDVI"``), or a formula (``"CRI = 1/R510 - 1/R550"``).

        Raises:
            InputError: it is neither, or a wavelength has no band near it.

        Example:
            >>> cloud = read_cloud("point_cloud.ply")
            >>> cloud.index("NDVI").shape == (len(cloud),)
            True
        """
        (index,) = find_indices([word], self.wavelengths_nm)
        return index_values(index, self._analysed(), self.wavelengths_nm)

    def calibration(self, calibration: Path | str | Calibration) -> Float[np.ndarray, "n"]:
        """A regression's prediction, or the number of a classifier's class (from 0), at each point.

        NaN outside of what it was fitted on.

        Args:
            calibration: a table (docs/how-to/calibrations.md), or what `read_calibration` read of it.

        Raises:
            InputError: the table cannot be read, or needs wavelengths that the cloud does not have.
        """
        one = calibration if isinstance(calibration, Calibration) else read_calibration(calibration)
        return one.of(self._analysed(), self.wavelengths_nm, only_inside=True)

    def to_xarray(self) -> xarray.Dataset:
        """The cloud as an xarray dataset by the CF conventions: reflectance (point, wavelength), x, y, z in metres.

        Raises:
            InputError: xarray is not installed.
        """
        return to_xarray(self)

    def save(self, path: Path | str) -> Path:
        """Write the cloud as ``.ply``, ``.las``, ``.nc`` or ``.zarr``, whole or not at all, and return the path.

        Raises:
            InputError: the name ends in none of these, a package is missing, or the file cannot be written.
        """
        path = Path(path)
        return write_cloud(path.with_suffix(""), stream(self), format_of(path))

    def _analysed(self) -> Float[np.ndarray, "n bands"]:
        material = self.material
        return (self.spectra if material is None else material).astype(float)


def read_cloud(path: Path | str) -> Cloud:
    """Read a cloud that was exported as PLY, NetCDF or Zarr.

    A NetCDF file is read by a process of its own first (`export.trial_reading`).

    Raises:
        InputError: the file is missing, is none of these, or lacks something of a cloud.

    Example:
        >>> cloud = read_cloud("point_cloud.ply")
        >>> cloud.spectra.shape, read_cloud("point_cloud.nc").spectra.shape
        ((30, 204), (30, 204))
    """
    path = Path(path)
    kind = format_of(path)
    if kind == "ply":
        return Cloud.of(read_spectral_ply(path))
    if kind == "las":
        raise InputError(f"{path}: LAS is not read; give the cloud as PLY, NetCDF or Zarr.")
    if kind == "netcdf":
        require_readable(path)
    try:
        import xarray

        zarr = {"engine": "zarr", "backend_kwargs": {"consolidated": False}}
        options: dict[str, Any] = zarr if kind == "zarr" else {"engine": "h5netcdf"}
        with xarray.open_dataset(path, **options) as table:
            require_room(table.nbytes, sum(part.stat().st_size for part in (path, *path.rglob("*"))))
            return Cloud.of(from_xarray(table.load()))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # those of the libraries' readers have no common class
        raise InputError(
            f"{path}: cannot be read ({error}); check the file, and run `pip install 'hsi-sc-nerf[formats]'`."
        ) from error
