"""ENVI cubes through SPy: opened, not loaded; written whole or not at all.

SPy parses headers and maps data files. What it refuses and a user expects to open is mended here
(``_mended_header``), and what it accepts silently and would hurt later (a data file that is shorter than its
header says, bands without wavelengths) is refused here.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, Shaped
from spectral.io import envi
from spectral.io.bilfile import BilFile
from spectral.io.bipfile import BipFile
from spectral.io.bsqfile import BsqFile
from spectral.io.spyfile import InvalidFileError

from hsi_sc_nerf.data.atomic import atomic_write
from hsi_sc_nerf.errors import InputError

_SPY_FILES = {"bil": BilFile, "bip": BipFile, "bsq": BsqFile}
_DATA_SUFFIXES = ("", ".raw", ".dat", ".img", ".bil", ".bip", ".bsq")
_NM_PER_UNIT = {
    "nm": 1.0,
    "nanometer": 1.0,
    "nanometre": 1.0,
    "um": 1000.0,
    "µm": 1000.0,
    "micrometer": 1000.0,
    "micrometre": 1000.0,
    "micron": 1000.0,
}
# No imaging spectrometer measures below 100 nm or beyond 100 µm: smaller numbers without a unit are micrometres.
_SMALLEST_NM = 100.0


@dataclass(frozen=True, eq=False)
class Cube:
    """An ENVI cube on disk; nothing is read until it is asked for.

    Attributes:
        header_path: the header.
        data_path: the data file beside it.
        shape: (lines, samples, bands).
        wavelengths_nm: band centres.
        interleave: how the data file is ordered, "bil", "bip" or "bsq".
        dtype: the stored numbers, with their byte order.
        reflectance_scale: the header's ``reflectance scale factor`` (1 where it has none).
        header: all of the header's fields, as SPy parses them.
    """

    header_path: Path
    data_path: Path
    shape: tuple[int, int, int]
    wavelengths_nm: Float[np.ndarray, "bands"]
    interleave: str
    dtype: np.dtype
    reflectance_scale: float
    header: dict[str, Any]

    def memmap(self) -> Num[np.ndarray, "lines samples bands"]:
        """A read-only view of the data file; touching a pixel reads only its pages."""
        parameters = envi.gen_params(self.header)
        parameters.filename = str(self.data_path)
        return _SPY_FILES[self.interleave](parameters, self.header).open_memmap(interleave="bip")

    def read(self) -> Num[np.ndarray, "lines samples bands"]:
        """The stored numbers in memory, contiguous, in this machine's byte order."""
        return np.ascontiguousarray(self.memmap(), dtype=self.dtype.newbyteorder("="))

    def reflectance(self) -> Float[np.ndarray, "lines samples bands"]:
        """The stored numbers over ``reflectance_scale``, float32."""
        return np.ascontiguousarray(self.memmap(), dtype=np.float32) / np.float32(self.reflectance_scale)


def open_cube(header_path: Path) -> Cube:
    """Open the ENVI pair that ``header_path`` describes.

    The data file has the header's name with one of ENVI's usual endings or none. Any interleave, real data type,
    byte order (little endian where the header is silent) and header offset; wavelengths in nm or micrometres.

    Raises:
        InputError: no header, no ENVI header, a field that is missing or unreadable, no wavelengths, no data
            file, or a data file that is shorter or longer than the header says.
    """
    header_path = Path(header_path)
    header = _mended_header(header_path)
    try:
        shape = (int(header["lines"]), int(header["samples"]), int(header["bands"]))
        parameters = envi.gen_params(header)
        scale = float(header.get("reflectance scale factor", 1.0))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{header_path}: a field of this header cannot be read ({error}); correct it.") from error
    dtype = np.dtype(parameters.dtype)
    if dtype.kind == "c" or min(shape) < 1 or not scale > 0.0:
        raise InputError(
            f"{header_path}: {shape} values of type {dtype.name} with scale {scale} are no spectral image; "
            "correct the header."
        )
    wavelengths_nm = _wavelengths_nm(header_path, header, bands=shape[2])
    data_path = _find_data_file(header_path)
    expected = parameters.offset + int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    actual = data_path.stat().st_size
    if actual != expected:
        raise InputError(
            f"{data_path}: has {actual} bytes, {'fewer' if actual < expected else 'more'} than the {expected} that "
            f"its header {header_path} says; copy the capture again or correct the header."
        )
    return Cube(header_path, data_path, shape, wavelengths_nm, header["interleave"], dtype, scale, header)


def write_cube(
    header_path: Path,
    cube: Num[np.ndarray, "lines samples bands"],
    *,
    wavelengths_nm: Shaped[np.ndarray, "bands"],
    interleave: str = "bil",
    data_suffix: str = ".raw",
    byte_order: str = "little",
    extra_header: dict[str, Any] | None = None,
) -> None:
    """Write an ENVI pair: ``header_path`` (ending in ``.hdr``) and the data file with ``data_suffix`` beside it.

    Both appear whole or not at all, the data file first. The numbers keep the data type of ``cube``.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).
        ValueError: one wavelength a band was not given.
    """
    header_path = Path(header_path)
    if len(wavelengths_nm) != cube.shape[2]:
        raise ValueError(f"{len(wavelengths_nm)} wavelengths for {cube.shape[2]} bands")
    metadata = {
        "wavelength units": "nm",
        "wavelength": [float(w) for w in wavelengths_nm],
        **(extra_header or {}),
    }
    with atomic_write(header_path.with_suffix(data_suffix), header_path) as (_, temporary_header):
        envi.save_image(
            str(temporary_header),
            cube,
            interleave=interleave,
            ext=data_suffix,
            byteorder=byte_order,
            metadata=metadata,
            force=True,
        )


def _mended_header(header_path: Path) -> dict[str, Any]:
    """SPy's dictionary of the header, with what ENVI itself takes for granted filled in."""
    if not header_path.is_file():
        raise InputError(f"{header_path}: there is no such ENVI header; check the path.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # field names are case-insensitive; SPy warns that it lowers them
            header = envi.read_envi_header(str(header_path))
    except (InvalidFileError, UnicodeDecodeError) as error:
        raise InputError(f"{header_path}: is no readable ENVI header; export the cube again.") from error
    header.setdefault("byte order", "0")
    missing = [key for key in ("lines", "samples", "bands", "data type", "interleave") if key not in header]
    if missing:
        raise InputError(f"{header_path}: the header does not give {', '.join(missing)}; add it.")
    header["interleave"] = str(header["interleave"]).lower()
    if header["interleave"] not in _SPY_FILES:
        raise InputError(f"{header_path}: interleave {header['interleave']} is none of bil, bip, bsq; correct it.")
    return header


def _wavelengths_nm(header_path: Path, header: dict[str, Any], bands: int) -> Float[np.ndarray, "bands"]:
    listed = header.get("wavelength")
    if not listed:
        raise InputError(f"{header_path}: gives no wavelengths; add a 'wavelength' list with one number a band.")
    try:
        wavelengths = np.array([float(w) for w in np.atleast_1d(listed)])
    except ValueError as error:
        raise InputError(f"{header_path}: a wavelength is not a number ({error}); correct the list.") from error
    if len(wavelengths) != bands:
        raise InputError(f"{header_path}: lists {len(wavelengths)} wavelengths for {bands} bands; correct the list.")
    if not (np.isfinite(wavelengths).all() and (wavelengths > 0.0).all()):
        raise InputError(f"{header_path}: lists wavelengths that are not positive numbers; correct the list.")
    unit = str(header.get("wavelength units", "")).strip().lower()
    implied = 1.0 if wavelengths.max() >= _SMALLEST_NM else 1000.0
    return wavelengths * _NM_PER_UNIT.get(unit.removesuffix("s"), implied)


def _find_data_file(header_path: Path) -> Path:
    base = header_path.with_suffix("")
    for suffix in _DATA_SUFFIXES:
        for candidate in (base.with_name(base.name + s) for s in (suffix, suffix.upper())):
            if candidate.is_file():
                return candidate
    raise InputError(
        f"{header_path}: its data file {base.name}.raw (or .dat, .img, .bil, .bip, .bsq) is not beside it; "
        "copy it there."
    )
