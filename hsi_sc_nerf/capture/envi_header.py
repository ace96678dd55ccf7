"""ENVI headers: parsed by SPy, mended where SPy refuses valid files, and checked where SPy checks nothing."""

from __future__ import annotations

import codecs
import math
import re
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from spectral.io import envi
from spectral.io.spyfile import InvalidFileError

from hsi_sc_nerf.errors import InputError

INTERLEAVES = ("bil", "bip", "bsq")
_INDENTED_COMMENT = re.compile(rb"^[ \t]+;", re.MULTILINE)
_REQUIRED = ("lines", "samples", "bands", "data type", "interleave")
_NM_PER_UNIT = {
    "nm": 1.0,
    "nanometer": 1.0,
    "nanometre": 1.0,
    "um": 1000.0,
    "\N{MICRO SIGN}m": 1000.0,
    "\N{GREEK SMALL LETTER MU}m": 1000.0,
    "micrometer": 1000.0,
    "micrometre": 1000.0,
    "micron": 1000.0,
    "mm": 1e6,
    "millimeter": 1e6,
    "millimetre": 1e6,
    "angstrom": 0.1,
}
# ENVI's units that are no lengths.
_NO_LENGTHS = ("wavenumber", "ghz", "mhz", "index")
# No imaging spectrometer measures below 100 nm or beyond 100 µm. Smaller numbers without a unit are micrometres.
_SENSIBLE_NM = (100.0, 100_000.0)


@dataclass(frozen=True, eq=False)
class EnviHeader:
    """What a header says about its cube.

    Attributes:
        header_path: the header file.
        shape: (lines, samples, bands).
        interleave: "bil", "bip" or "bsq".
        dtype: the stored numbers, with their byte order.
        offset: bytes before the first number.
        wavelengths_nm: band centres; None where the header lists none.
        fwhm_nm: full width of each band at half its maximum; None where the header lists none.
        good_bands: which bands the bad-band list ``bbl`` keeps; all without such a list.
        reflectance_scale: ``reflectance scale factor``, the stored number of reflectance 1 (1 by default).
        ignore_value: ``data ignore value``, the stored number that stands for "no data".
        integration_time_ms: Specim's ``tint``.
        fields: all fields as SPy parses them, after mending.
    """

    header_path: Path
    shape: tuple[int, int, int]
    interleave: str
    dtype: np.dtype
    offset: int
    wavelengths_nm: Float[np.ndarray, "bands"] | None
    fwhm_nm: Float[np.ndarray, "bands"] | None
    good_bands: Bool[np.ndarray, "bands"]
    reflectance_scale: float
    ignore_value: float | None
    integration_time_ms: float | None
    fields: dict[str, Any]

    @property
    def data_bytes(self) -> int:
        """Size of the data file."""
        return self.offset + math.prod(self.shape) * self.dtype.itemsize


def read_header(path: Path) -> EnviHeader:
    """Parse, mend and check a header; the data file is not read.

    Mended are a missing ``byte order`` (little endian) or ``header offset``, upper-case interleaves, "envi" in lower
    case, byte order marks, Latin-1 letters, indented comments, and a comma after a list's last number.

    Raises:
        InputError: there is no such file, it is no ENVI header, a field is missing or unreadable, a list does not
            have one number a band, or the pixels would be read wrongly (complex numbers, frame offsets, compression,
            a spectral library).
    """
    fields = mended_fields(path)
    try:
        shape = (int(fields["lines"]), int(fields["samples"]), int(fields["bands"]))
        parameters = envi.gen_params(fields)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: a field of this header cannot be read ({error}); correct it.") from error
    dtype = np.dtype(parameters.dtype)
    check_layout(path, fields, shape, dtype, parameters.offset)
    scale = number_in(path, fields, "reflectance scale factor")
    if scale is not None and not scale > 0.0:
        raise InputError(f"{path}: reflectance scale factor {scale:g} is not positive; correct it.")
    tint = number_in(path, fields, "tint")
    nm_per_unit, wavelengths_nm = wavelengths_of(path, fields, shape[2])
    fwhm = _numbers(path, fields, "fwhm", shape[2])
    bad_band_list = _numbers(path, fields, "bbl", shape[2])
    return EnviHeader(
        header_path=path,
        shape=shape,
        interleave=fields["interleave"],
        dtype=dtype,
        offset=parameters.offset,
        wavelengths_nm=wavelengths_nm,
        fwhm_nm=None if fwhm is None else fwhm * nm_per_unit,
        good_bands=np.ones(shape[2], bool) if bad_band_list is None else bad_band_list != 0.0,
        reflectance_scale=1.0 if scale is None else scale,
        ignore_value=number_in(path, fields, "data ignore value"),
        integration_time_ms=tint if tint and tint > 0.0 else None,
        fields=fields,
    )


def mended_fields(path: Path) -> dict[str, Any]:
    """SPy's dictionary of the header, with ENVI's defaults filled in."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such ENVI header; check the path.")
    try:
        fields = _parse(path)
    except (InvalidFileError, OSError) as error:
        raise InputError(f"{path}: is no readable ENVI header; export the file again.") from error
    fields.setdefault("byte order", "0")
    missing = [key for key in _REQUIRED if not fields.get(key)]
    if missing:
        raise InputError(f"{path}: the header does not give {', '.join(missing)}; add it.")
    fields["interleave"] = str(fields["interleave"]).lower()
    # Some writers set a comma after a list's last number.
    return {
        key: value[:-1] if isinstance(value, list) and value[-1] == "" else value for key, value in fields.items()
    }


def _parse(path: Path) -> dict[str, Any]:
    """SPy's dictionary of the header. A header that SPy cannot parse is corrected in a temporary copy."""
    with open(path, "rb") as file:
        start = file.read(64).removeprefix(codecs.BOM_UTF8).lstrip()
        if not start.upper().startswith(b"ENVI") or b"\0" in start:
            raise InvalidFileError(f"{path} does not begin with ENVI")
        file.seek(0)
        content = file.read()
    if content.isascii() and content.startswith(b"ENVI") and not _INDENTED_COMMENT.search(content):
        return _parse_with_spy(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    fields = [line for line in text.lstrip().splitlines()[1:] if not line.lstrip().startswith(";")]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "mended.hdr"
        copy.write_text("\n".join(["ENVI", *fields, ""]), errors="replace")  # in the encoding that SPy reads with
        return _parse_with_spy(copy)


def _parse_with_spy(path: Path) -> dict[str, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # field names are case-insensitive; SPy warns that it lowers them
        return envi.read_envi_header(str(path))


def check_layout(
    path: Path, fields: dict[str, Any], shape: tuple[int, int, int], dtype: np.dtype, offset: int
) -> None:
    """Refuse headers whose pixels would be read wrongly."""
    if fields["interleave"] not in INTERLEAVES:
        raise InputError(f"{path}: interleave {fields['interleave']} is none of bil, bip, bsq; correct it.")
    if min(shape) < 1 or offset < 0:
        raise InputError(
            f"{path}: {shape[0]} lines, {shape[1]} samples, {shape[2]} bands after {offset} bytes are no spectral "
            "image; correct the header."
        )
    if dtype.kind == "c":
        raise InputError(f"{path}: holds complex numbers, which are no spectral image; export real numbers.")
    if str(fields["byte order"]) not in ("0", "1"):
        raise InputError(f"{path}: byte order {fields['byte order']} is neither 0 (little) nor 1 (big); correct it.")
    if "library" in str(fields.get("file type", "")).lower():
        raise InputError(f"{path}: describes a spectral library, not an image; give the cube's header.")
    for key in ("major frame offsets", "minor frame offsets", "file compression"):
        values = np.atleast_1d(fields.get(key, "0"))
        if any(str(value).strip() not in ("", "0") for value in values):
            raise InputError(f"{path}: has {key}, which are not supported; export the cube without them.")


def number_in(path: Path, fields: dict[str, Any], key: str) -> float | None:
    """A field's number; None where the field is missing or empty."""
    value = fields.get(key, "")
    if not value:
        return None
    try:
        return float(value[0] if isinstance(value, list) else value)
    except ValueError as error:
        raise InputError(f"{path}: {key} is no number ({error}); correct it.") from error


def _numbers(path: Path, fields: dict[str, Any], key: str, bands: int) -> Float[np.ndarray, "bands"] | None:
    """A field's list of one number a band; None where the field is missing or empty."""
    listed = fields.get(key, "")
    if not listed:
        return None
    try:
        numbers = np.array([float(value) for value in np.atleast_1d(listed)])
    except ValueError as error:
        raise InputError(f"{path}: {key} holds what is not a number ({error}); correct the list.") from error
    if len(numbers) != bands:
        raise InputError(f"{path}: {key} lists {len(numbers)} numbers for {bands} bands; correct the list.")
    if not np.isfinite(numbers).all() or numbers.min() < 0.0:
        raise InputError(f"{path}: {key} holds numbers that are negative or not finite; correct the list.")
    return numbers


def wavelengths_of(path: Path, fields: dict[str, Any], bands: int) -> tuple[float, Float[np.ndarray, "bands"] | None]:
    """The factor from the header's unit to nm, and the band centres, or None where it lists none."""
    unit = str(fields.get("wavelength units", "")).strip().lower().removesuffix("s")
    listed = _numbers(path, fields, "wavelength", bands)
    if listed is None or unit == "index":
        return _NM_PER_UNIT.get(unit, 1.0), None
    if unit in _NO_LENGTHS:
        raise InputError(f"{path}: gives its bands in {unit}, not as wavelengths; convert the list to nm.")
    implied = 1.0 if listed.max() >= _SENSIBLE_NM[0] else 1000.0
    nm_per_unit = _NM_PER_UNIT.get(unit, implied)
    wavelengths_nm = listed * nm_per_unit
    if wavelengths_nm.min() < _SENSIBLE_NM[0] or wavelengths_nm.max() > _SENSIBLE_NM[1]:
        raise InputError(
            f"{path}: wavelengths from {wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm are none of an "
            "imaging spectrometer; correct the list or its unit."
        )
    return nm_per_unit, wavelengths_nm
