"""Reference spectra by name: an ENVI spectral library or a CSV table, brought to the bands of a cloud."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError

_UNIT_NM = {"micrometers": 1000.0, "micrometer": 1000.0, "um": 1000.0, "µm": 1000.0}
# Micrometres without a unit are told by their size: no band of a camera is below 100 nm.
_SMALLEST_NM = 100.0


@dataclass(frozen=True)
class SpectralLibrary:
    """Named reference spectra; those of equal name are references of one class.

    Attributes:
        names: of each spectrum.
        wavelengths_nm: band centres.
        spectra: reflectance.
    """

    names: tuple[str, ...]
    wavelengths_nm: Float[np.ndarray, "bands"]
    spectra: Float[np.ndarray, "references bands"]

    def at(self, wavelengths_nm: Float[np.ndarray, "other"]) -> SpectralLibrary:
        """The library at other wavelengths, straight between its own.

        Raises:
            InputError: the library does not reach as far as the wavelengths (1 nm of grace).
        """
        low, high = self.wavelengths_nm.min(), self.wavelengths_nm.max()
        if wavelengths_nm.min() < low - 1.0 or wavelengths_nm.max() > high + 1.0:
            raise InputError(
                f"the spectral library goes from {low:g} to {high:g} nm and the cloud from {wavelengths_nm.min():g} "
                f"to {wavelengths_nm.max():g} nm; give a library that covers the cloud."
            )
        order = np.argsort(self.wavelengths_nm)
        spectra = np.stack(
            [np.interp(wavelengths_nm, self.wavelengths_nm[order], row[order]) for row in self.spectra]
        )
        return SpectralLibrary(self.names, wavelengths_nm, spectra)

    def only(self, names: tuple[str, ...]) -> SpectralLibrary:
        """The spectra of these names, in the library's order.

        Raises:
            InputError: a name is not in the library.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            known = ", ".join(dict.fromkeys(self.names))
            raise InputError(f"the spectral library has no {', '.join(unknown)}; it has {known}.")
        rows = [row for row, name in enumerate(self.names) if name in names]
        return SpectralLibrary(tuple(self.names[row] for row in rows), self.wavelengths_nm, self.spectra[rows])


def read_library(path: Path) -> SpectralLibrary:
    """Read an ENVI spectral library (``.sli`` with its header, or the header) or a CSV table.

    The table's first column is the wavelength in nm (in µm if its numbers are below 100), each other column a
    spectrum with its name in the first line.

    Raises:
        InputError: the file is missing, is neither of the two, or holds numbers that cannot be read.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give an ENVI spectral library (.sli) or a CSV table.")
    names, wavelengths, spectra = _read_table(path) if path.suffix.lower() == ".csv" else _read_envi(path)
    if wavelengths.size and wavelengths.max() < _SMALLEST_NM:
        wavelengths = wavelengths * 1000.0
    if spectra.shape != (len(names), len(wavelengths)) or min(spectra.shape) == 0:
        raise InputError(f"{path}: holds no spectra, or they do not fit its wavelengths; export the library again.")
    if not (np.isfinite(spectra).all() and np.isfinite(wavelengths).all()):
        raise InputError(f"{path}: holds numbers that are not finite; correct them.")
    return SpectralLibrary(tuple(names), wavelengths, spectra)


def _read_table(path: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, *rows = [row for row in csv.reader(file) if row]
        table = np.array(rows, float)
        if table.ndim != 2 or table.shape[1] != len(header) or len(header) < 2:
            raise ValueError("its lines do not have the same number of columns")
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: is no table of spectra ({error}); its first line names the columns, its first column is the "
            "wavelength in nm, and each other column is a spectrum."
        ) from error
    return [name.strip() for name in header[1:]], table[:, 0], table[:, 1:].T


def _read_envi(path: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    from spectral.io import envi

    candidates = (path,) if path.suffix.lower() == ".hdr" else (path.with_suffix(".hdr"), Path(f"{path}.hdr"))
    header = next((candidate for candidate in candidates if candidate.is_file()), None)
    if header is None:
        raise InputError(f"{path}: its header {candidates[0].name} is missing; put it beside the library.")
    data = path if header != path else path.with_suffix(".sli")
    if not data.is_file():
        raise InputError(f"{header}: its library {data.name} is missing; put it beside the header.")
    try:
        library = envi.open(str(header), str(data))
        scale = float(library.metadata.get("reflectance scale factor", 1.0))
        wavelengths = np.array(library.bands.centers, float)
        spectra = np.asarray(library.spectra, float) / scale
    except (envi.EnviException, AttributeError, TypeError, ValueError, OSError) as error:
        raise InputError(f"{header}: is no readable ENVI spectral library ({error}); export it again.") from error
    unit = str(library.bands.band_unit or "").strip().lower()
    return list(library.names), wavelengths * _UNIT_NM.get(unit, 1.0), spectra
