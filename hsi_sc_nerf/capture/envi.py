"""ENVI cubes through SPy: opened, not loaded; written whole or not at all.

SPy maps the data files and writes headers; reading headers is ``envi_header.py``'s. A data file that is shorter or
longer than its header says is refused here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num, Shaped
from spectral.io import envi
from spectral.io.bilfile import BilFile
from spectral.io.bipfile import BipFile
from spectral.io.bsqfile import BsqFile

from hsi_sc_nerf.capture.envi_header import EnviHeader, read_header
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write

_SPY_FILES = {"bil": BilFile, "bip": BipFile, "bsq": BsqFile}
# Where lines, samples and bands of a cube go in a data file.
_AXES = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}
DATA_SUFFIXES = ("", ".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".hyspex")
"""Endings of ENVI data files; "" for ``NAME`` beside ``NAME.hdr`` (and ``NAME.raw`` beside ``NAME.raw.hdr``)."""


@dataclass(frozen=True, eq=False)
class Cube:
    """An ENVI cube on disk; nothing is read until it is asked for.

    Attributes:
        header_path: the header.
        data_path: the data file beside it.
        shape: (lines, samples, bands).
        wavelengths_nm: band centres.
        fwhm_nm: full width of each band at half its maximum; None where the header lists none.
        good_bands: which bands the header's bad-band list ``bbl`` keeps; all without such a list.
        interleave: how the data file is ordered, "bil", "bip" or "bsq".
        dtype: the stored numbers, with their byte order.
        reflectance_scale: the header's ``reflectance scale factor`` (1 where it has none).
        ignore_value: the header's ``data ignore value``, a stored number that stands for "no data".
        integration_time_ms: the header's ``tint``.
        header: all of the header's fields, as SPy parses them.
    """

    header_path: Path
    data_path: Path
    shape: tuple[int, int, int]
    wavelengths_nm: Float[np.ndarray, "bands"]
    fwhm_nm: Float[np.ndarray, "bands"] | None
    good_bands: Bool[np.ndarray, "bands"]
    interleave: str
    dtype: np.dtype
    reflectance_scale: float
    ignore_value: float | None
    integration_time_ms: float | None
    header: dict[str, Any]

    def memmap(self) -> Num[np.ndarray, "lines samples bands"]:
        """A read-only view of the data file; touching a pixel reads only its pages."""
        parameters = envi.gen_params(self.header)
        parameters.filename = str(self.data_path)
        return _SPY_FILES[self.interleave](parameters, self.header).open_memmap(interleave="bip")

    def read(self) -> Num[np.ndarray, "lines samples bands"]:
        """The stored numbers in memory, contiguous, in this machine's byte order."""
        return np.ascontiguousarray(self.memmap(), dtype=self.dtype.newbyteorder("="))


def open_cube(header_path: Path, wavelengths_nm: Float[np.ndarray, "bands"] | None = None) -> Cube:
    """Open the ENVI pair that ``header_path`` describes.

    The data file has the header's name with one of ENVI's usual endings or none. Any interleave, real data type,
    byte order (little endian where the header is silent) and header offset; wavelengths in nm or micrometres.

    Args:
        header_path: the header.
        wavelengths_nm: band centres of a cube whose header lists none.

    Raises:
        InputError: no header, no ENVI header, a field that is missing or unreadable (``read_header``), no
            wavelengths, no data file, or a data file that is shorter or longer than the header says.
    """
    return cube_of(read_header(Path(header_path)), wavelengths_nm)


def cube_of(header: EnviHeader, wavelengths_nm: Float[np.ndarray, "bands"] | None = None) -> Cube:
    """The cube of a header that has been read; ``wavelengths_nm`` is for a header that lists none.

    Raises:
        InputError: no wavelengths, no data file, or a data file that is shorter or longer than the header says.
    """
    if header.wavelengths_nm is not None:
        wavelengths_nm = header.wavelengths_nm
    if wavelengths_nm is None:
        raise InputError(
            f"{header.path}: gives no wavelengths; add a 'wavelength' list with one number a band, or name a CSV of "
            "the band centres as 'band_centres' in session.json."
        )
    if len(wavelengths_nm) != header.shape[2]:
        raise InputError(
            f"{header.path}: gives no wavelengths, and the list of {len(wavelengths_nm)} band centres does not fit "
            f"its {header.shape[2]} bands; add a 'wavelength' list with one number a band."
        )
    data_path = _find_data_file(header)
    actual = data_path.stat().st_size
    if actual != header.data_bytes:
        raise InputError(
            f"{data_path}: has {actual} bytes, {'fewer' if actual < header.data_bytes else 'more'} than the "
            f"{header.data_bytes} that its header {header.path} says; copy the capture again or correct the header."
        )
    return Cube(
        header_path=header.path,
        data_path=data_path,
        shape=header.shape,
        wavelengths_nm=wavelengths_nm,
        fwhm_nm=header.fwhm_nm,
        good_bands=header.good_bands,
        interleave=header.interleave,
        dtype=header.dtype,
        reflectance_scale=header.reflectance_scale,
        ignore_value=header.ignore_value,
        integration_time_ms=header.integration_time_ms,
        header=header.fields,
    )


def write_cube(
    header_path: Path,
    cube: Num[np.ndarray, "lines samples bands"],
    *,
    wavelengths_nm: Shaped[np.ndarray, "bands"] | None,
    interleave: str = "bil",
    data_suffix: str = ".raw",
    byte_order: str = "little",
    extra_header: dict[str, Any] | None = None,
) -> None:
    """Write an ENVI pair: ``header_path`` (ending in ``.hdr``) and the data file with ``data_suffix`` beside it.

    Both appear whole or not at all, the data file first. The numbers keep the data type of ``cube``. Where its bands
    are no wavelengths, as those of a map, ``wavelengths_nm`` is None.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).
        ValueError: one wavelength a band was not given.
    """
    header_path = Path(header_path)
    spectral: dict[str, Any] = {}
    if wavelengths_nm is not None:
        spectral = {"wavelength units": "nm", "wavelength": [float(w) for w in wavelengths_nm]}
        if len(wavelengths_nm) != cube.shape[2]:
            raise ValueError(f"{len(wavelengths_nm)} wavelengths for {cube.shape[2]} bands")
    stored = np.ascontiguousarray(cube.transpose(_AXES[interleave]))
    stored = stored.astype(stored.dtype.newbyteorder(">" if byte_order == "big" else "<"), copy=False)
    header = {
        **dict(zip(("lines", "samples", "bands"), cube.shape, strict=True)),
        "header offset": 0,
        "data type": envi.dtype_to_envi[cube.dtype.char],
        "interleave": interleave,
        "byte order": 1 if byte_order == "big" else 0,
        **spectral,
        **(extra_header or {}),
    }
    with atomic_write(header_path.with_suffix(data_suffix), header_path) as (temporary_data, temporary_header):
        # SPy's `save_image` would first copy all of it in memory.
        with temporary_data.open("wb") as file:
            file.write(stored.data)
        envi.write_envi_header(str(temporary_header), header)


def _find_data_file(header: EnviHeader) -> Path:
    """The data file beside a header; of several that could be, one that has the size that the header says."""
    base = header.path.with_suffix("")
    names = [base.name + ending for suffix in DATA_SUFFIXES for ending in dict.fromkeys((suffix, suffix.upper()))]
    candidates = [base.with_name(name) for name in names if base.with_name(name).is_file()]
    if not candidates:
        raise InputError(
            f"{header.path}: its data file {base.name}.raw (or .dat, .img, .bil, .bip, .bsq, .bin) is not beside it; "
            "copy it there."
        )
    return next((path for path in candidates if path.stat().st_size == header.data_bytes), candidates[0])
