"""ENVI cubes: opened without loading them, read line by line, written whole or not at all.

SPy writes the headers; ``envi_header.py`` reads them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, Shaped
from spectral.io import envi

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.envi_header import EnviHeader, read_header
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.spectra import covered, listed_twice, nearest_bands

# Order of a cube's axes (lines, samples, bands) in a data file.
_AXES = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}
DATA_SUFFIXES = ("", ".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".hyspex")
"""Endings of ENVI data files; "" for ``NAME`` beside ``NAME.hdr``."""


@dataclass(frozen=True, eq=False)
class Cube(EnviHeader):
    """An ENVI cube on disk: its header, its wavelengths and its data file. Opening it reads no pixels.

    Attributes:
        wavelengths_nm: band centres, from the header or given beside it.
        data_path: the data file.
    """

    wavelengths_nm: Float[np.ndarray, "bands"]
    data_path: Path

    def memmap(self) -> Num[np.ndarray, "lines samples bands"]:
        """A read-only view of the data file; only the pages of the pixels that are used are read."""
        axes = _AXES[self.interleave]
        stored = np.memmap(self.data_path, self.dtype, "r", self.offset, tuple(self.shape[axis] for axis in axes))
        return stored.transpose(np.argsort(axes))

    def read(self) -> Num[np.ndarray, "lines samples bands"]:
        """The stored numbers in memory, contiguous, in the machine's byte order."""
        return np.ascontiguousarray(self.memmap(), dtype=self.dtype.newbyteorder("="))


def open_cube(header: Path | EnviHeader, wavelengths_nm: Float[np.ndarray, "bands"] | None = None) -> Cube:
    """Open an ENVI pair.

    The data file has the header's name with one of ENVI's usual endings or none. Any interleave, real data type, byte
    order (little endian by default) and header offset is read; wavelengths may be in nm or micrometres.

    Args:
        header: path of the header, or the header itself if it was read before.
        wavelengths_nm: band centres, used if the header lists none, or one twice because it rounds them.

    Raises:
        InputError: the header cannot be used (`read_header`), there are no wavelengths, two bands have the same, or
            there is no data file, or it is shorter or longer than the header says.

    Example:
        >>> cube = open_cube(Path("captures/frame_01.hdr"))
        >>> cube.shape, cube.wavelengths_nm[[0, -1]]
        >>> spectrum = cube.memmap()[256, 256]  # reads this pixel only
    """
    if not isinstance(header, EnviHeader):
        header = read_header(Path(header))
    own = header.wavelengths_nm
    fits = wavelengths_nm is not None and len(wavelengths_nm) == header.shape[2]
    if own is not None and not (fits and listed_twice(own) is not None):
        wavelengths_nm = own
    if wavelengths_nm is None or len(wavelengths_nm) != header.shape[2]:
        unfit = "" if wavelengths_nm is None else f", and {len(wavelengths_nm)} band centres do not fit its bands"
        raise InputError(
            f"{header.header_path}: gives no wavelengths{unfit}; add a 'wavelength' list with one number a band, or "
            "name a CSV of the band centres as 'band_centres' in session.json."
        )
    twice_nm = listed_twice(wavelengths_nm)
    if twice_nm is not None:
        raise InputError(
            f"{header.header_path}: lists {twice_nm:g} nm twice; give each band its own centre, there or in a CSV "
            "that session.json names as 'band_centres'."
        )
    data_path = _find_data_file(header)
    actual = data_path.stat().st_size
    if actual != header.data_bytes:
        raise InputError(
            f"{data_path}: has {actual} bytes, {'fewer' if actual < header.data_bytes else 'more'} than the "
            f"{header.data_bytes} that its header {header.header_path} says; copy the capture again or correct the "
            "header."
        )
    return Cube(**{**vars(header), "wavelengths_nm": wavelengths_nm}, data_path=data_path)


def write_cube(
    header_path: Path,
    cube: Num[np.ndarray, "lines samples bands"],
    *,
    wavelengths_nm: Shaped[np.ndarray, "bands"] | None,
    interleave: str = "bil",
    data_suffix: str = ".raw",
    extra_header: dict[str, Any] | None = None,
) -> None:
    """Write an ENVI pair, little endian. Both files appear whole or not at all, the data file first.

    Where the bands show red, green and blue (`paper.PSEUDO_RGB_NM`), they are the header's ``default bands``, which
    viewers such as SPy's ``get_rgb`` take.

    Args:
        wavelengths_nm: band centres; None for bands that are no wavelengths (a map).
        data_suffix: ending of the data file, which is written beside the header.

    Raises:
        InputError: the operating system refused to write (full disk, no permission).
        ValueError: the number of wavelengths is not the number of bands.
    """
    header_path = Path(header_path)
    spectral: dict[str, Any] = {}
    if wavelengths_nm is not None:
        spectral = {"wavelength units": "nm", "wavelength": [float(w) for w in wavelengths_nm]}
        if len(wavelengths_nm) != cube.shape[2]:
            raise ValueError(f"{len(wavelengths_nm)} wavelengths for {cube.shape[2]} bands")
        if covered(wavelengths_nm, paper.PSEUDO_RGB_NM).all():
            # ENVI counts bands from 1.
            spectral["default bands"] = (nearest_bands(wavelengths_nm, paper.PSEUDO_RGB_NM) + 1).tolist()
    stored = np.ascontiguousarray(cube.transpose(_AXES[interleave]))
    stored = stored.astype(stored.dtype.newbyteorder("<"), copy=False)
    header = {
        **dict(zip(("lines", "samples", "bands"), cube.shape, strict=True)),
        "header offset": 0,
        "data type": envi.dtype_to_envi[cube.dtype.char],
        "interleave": interleave,
        "byte order": 0,
        **spectral,
        **(extra_header or {}),
    }
    with atomic_write(header_path.with_suffix(data_suffix), header_path) as (temporary_data, temporary_header):
        # SPy's `save_image` would first copy all of it in memory.
        with temporary_data.open("wb") as file:
            file.write(stored.data)
        envi.write_envi_header(str(temporary_header), header)


class CubeLines:
    """Context manager that reads a cube line by line, ``(samples, bands)``; each line overwrites the one before.

    This avoids touching new pages of a memory map, which is slow, most of all with several threads. The lines of a
    BSQ file are scattered over the file and come from a memory map.
    """

    def __init__(self, cube: Cube) -> None:
        self.shape = cube.shape
        self.dtype = cube.dtype
        self._cube = cube
        self._map = np.asarray(cube.memmap()) if cube.interleave == "bsq" else None
        _, samples, bands = cube.shape
        self._line = np.empty((bands, samples) if cube.interleave == "bil" else (samples, bands), cube.dtype)
        self._view = self._line.T if cube.interleave == "bil" else self._line
        self._file = -1

    def __enter__(self) -> CubeLines:
        try:
            self._file = os.open(self._cube.data_path, os.O_RDONLY)
        except OSError as error:
            raise InputError(f"{self._cube.data_path}: cannot be read ({error.strerror}); check the file.") from error
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self._file)

    def __getitem__(self, line: int) -> Num[np.ndarray, "samples bands"]:
        """One line.

        Raises:
            InputError: the file ends before it, or the operating system refused to read.
        """
        if self._map is not None:
            return self._map[line]
        try:
            size = os.preadv(self._file, [self._line.data], self._cube.offset + line * self._line.nbytes)
        except OSError as error:
            raise InputError(
                f"{self._cube.data_path}: cannot be read ({error.strerror}); copy the capture again."
            ) from error
        if size != self._line.nbytes:
            raise InputError(f"{self._cube.data_path}: ends in its line {line}; copy the capture again.")
        return self._view


def _find_data_file(header: EnviHeader) -> Path:
    """The data file beside a header; of several candidates, one of the size that the header says."""
    base = header.header_path.with_suffix("")
    names = [base.name + ending for suffix in DATA_SUFFIXES for ending in dict.fromkeys((suffix, suffix.upper()))]
    candidates = [base.with_name(name) for name in names if base.with_name(name).is_file()]
    if not candidates:
        raise InputError(
            f"{header.header_path}: its data file {base.name}.raw (or .dat, .img, .bil, .bip, .bsq, .bin) is not "
            "beside it; copy it there."
        )
    return next((path for path in candidates if path.stat().st_size == header.data_bytes), candidates[0])
