"""Named reference spectra from an ENVI spectral library or a CSV table, resampled to the bands of a cloud.

SPy writes libraries. It does not read them: its reader ignores the header's offset and knows only one spelling of the
file type.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from spectral.io import envi

from hsi_sc_nerf.capture.envi_header import read_header
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.number_table import read_number_table

# Wavelengths of a table that are all below this are in micrometres.
_SMALLEST_NM = 100.0
# The USGS library marks "deleted channels" by -1.23e34.
_DELETED = -1e20


@dataclass(frozen=True)
class SpectralLibrary:
    """Named reference spectra; spectra of one name are references of one class.

    Attributes:
        names: one for each spectrum.
        wavelengths_nm: band centres.
        spectra: reflectance; NaN where it is missing.
    """

    names: tuple[str, ...]
    wavelengths_nm: Float[np.ndarray, "bands"]
    spectra: Float[np.ndarray, "references bands"]

    def at(self, wavelengths_nm: Float[np.ndarray, "other"]) -> SpectralLibrary:
        """The library at a cloud's wavelengths, by linear interpolation.

        Raises:
            InputError: the library does not cover the wavelengths (to within 1 nm), lacks reflectance at one of them,
                or there is only one, at which spectral angles are not defined.
        """
        if len(wavelengths_nm) < 2:
            raise InputError("the cloud has one band, which tells no classes; give one with more, or no --library.")
        low, high = self.wavelengths_nm.min(), self.wavelengths_nm.max()
        if wavelengths_nm.min() < low - 1.0 or wavelengths_nm.max() > high + 1.0:
            raise InputError(
                f"the spectral library goes from {low:g} to {high:g} nm and the cloud from {wavelengths_nm.min():g} "
                f"to {wavelengths_nm.max():g} nm; give a library that covers the cloud."
            )
        order = np.argsort(self.wavelengths_nm)
        rows = [np.interp(wavelengths_nm, self.wavelengths_nm[order], row[order]) for row in self.spectra]
        missing = {name: np.isnan(row) for name, row in zip(self.names, rows, strict=True) if np.isnan(row).any()}
        if missing:
            where = [f"{name} at {wavelengths_nm[row.argmax()]:g} nm" for name, row in missing.items()]
            raise InputError(
                f"the spectral library has no reflectance of {', '.join(where)}; leave such spectra out (--classes), "
                "or export the cloud without these bands (--bands)."
            )
        return SpectralLibrary(self.names, wavelengths_nm, np.stack(rows))

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

    The table's first column is the wavelength in nm (in µm if all numbers are below 100), each other column is a
    spectrum with its name in the first line.

    Raises:
        InputError: the file is missing, is neither of the two, or holds numbers that cannot be read.

    Example:
        >>> _ = Path("materials.csv").write_text("wavelength_nm,skin,leaf\\n500,0.1,0.2\\n700,0.6,0.3\\n")
        >>> read_library(Path("materials.csv")).names
        ('skin', 'leaf')
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give an ENVI spectral library (.sli) or a CSV table.")
    names, wavelengths_nm, spectra = _read_table(path) if path.suffix.lower() == ".csv" else _read_envi(path)
    if len(names) != len(spectra) or min(spectra.shape) == 0:
        raise InputError(f"{path}: holds {len(spectra)} spectra and names {len(names)}; export the library again.")
    return SpectralLibrary(tuple(names), wavelengths_nm, np.where(spectra < _DELETED, np.nan, spectra))


def write_library(path: Path | str, library: SpectralLibrary) -> None:
    """Write a file that `read_library` reads: an ENVI spectral library (``.sli``, with its header) or a CSV table.

    In the names of an ENVI library commas and braces become low lines, because they end a name there.

    Raises:
        InputError: the file's name ends in neither, or the operating system refused to write.

    Example:
        >>> library = SpectralLibrary(("skin", "leaf"), np.array([500.0, 700.0]), np.array([[0.1, 0.6], [0.2, 0.3]]))
        >>> write_library("materials.sli", library)
        >>> read_library("materials.sli").names
        ('skin', 'leaf')
    """
    path = Path(path)
    if path.suffix == ".csv":
        with atomic_write(path) as (temporary,), temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["wavelength_nm", *library.names])
            rows = zip(library.wavelengths_nm, *library.spectra, strict=True)
            writer.writerows([f"{number:.6g}" for number in row] for row in rows)
    elif path.suffix == ".sli":
        names = [re.sub(r"[,{}\n\r]", "_", name) for name in library.names]
        nm = [float(wavelength) for wavelength in library.wavelengths_nm]
        header = {"wavelength": nm, "wavelength units": "Nanometers", "spectra names": names}
        with atomic_write(path, path.with_suffix(".hdr")) as (temporary, _):
            envi.SpectralLibrary(np.asarray(library.spectra, "<f4"), header).save(str(temporary.with_suffix("")))
    else:
        raise InputError(f"{path}: is no name of a library; let it end in .sli or .csv.")


def _read_table(path: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    try:
        table = read_number_table(path)
        if len(table.titles) < 2 or len(table.numbers) == 0:
            raise ValueError("it has no names, or no columns and lines below them")
        if not np.isfinite(table.numbers).all():
            raise ValueError("it holds numbers that are not finite, or empty cells")
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: is no table of spectra ({error}); give names in the first line, wavelengths in nm in the first "
            "column, and a spectrum in each other column."
        ) from error
    wavelengths = table.numbers[:, 0]
    nm_per_unit = 1000.0 if wavelengths.max() < _SMALLEST_NM else 1.0
    return list(table.titles[1:]), wavelengths * nm_per_unit, table.numbers[:, 1:].T


def _read_envi(path: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    """An ENVI library is an image of one band: each line a spectrum, each sample a wavelength."""
    header_path, data = envi_pair(path)
    header = read_header(header_path, library=True)
    if header.wavelengths_nm is None:
        raise InputError(f"{header_path}: lists no wavelengths; add them.")
    lines, samples, _ = header.shape
    if data.stat().st_size < header.data_bytes:
        raise InputError(f"{data}: is smaller than its header {header_path.name} says; export the library again.")
    try:
        numbers = np.fromfile(data, header.dtype, lines * samples, offset=header.offset)
    except OSError as error:
        raise InputError(f"{data}: cannot be read ({error}); check the file.") from error
    spectra = numbers.reshape(lines, samples).astype(float)
    if header.ignore_value is not None:
        spectra[np.isclose(spectra, header.ignore_value, rtol=1e-6, atol=0.0)] = np.nan
    names = np.atleast_1d(header.fields.get("spectra names") or np.arange(1, lines + 1).astype(str))
    return names.tolist(), header.wavelengths_nm, spectra / header.reflectance_scale


def envi_pair(path: Path) -> tuple[Path, Path]:
    """Header and data file of a library, either of which is given.

    Raises:
        InputError: the other one is missing.
    """
    given_header, base = path.suffix.lower() == ".hdr", path.with_suffix("")
    stems, endings = ([base], ("", ".sli", ".SLI")) if given_header else ([base, path], (".hdr", ".HDR"))
    candidates = [stem.with_name(stem.name + ending) for stem in stems for ending in endings]
    other = next((one for one in candidates if one.is_file()), None)
    if other is None:
        missing = f"library {base.name}.sli" if given_header else f"header {base.name}.hdr"
        raise InputError(f"{path}: its {missing} is missing; put it there.")
    return (path, other) if given_header else (other, path)
