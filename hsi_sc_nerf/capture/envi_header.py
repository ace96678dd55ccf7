"""ENVI headers: read in every variation that instruments write, and checked.

SPy's own reader refuses valid files (byte order marks, letters beyond ASCII, indented comments) and checks nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from spectral.io import envi

from hsi_sc_nerf.errors import InputError

_FIELD = re.compile(r"^([^=\n{}]+)=[ \t]*(\{[^}]*\}|[^\n{]*$)[^\n]*$", re.MULTILINE)
_REQUIRED = ("lines", "samples", "bands", "data type", "interleave")
_NM_PER_UNIT = {
    "nm": 1.0,
    "nanometer": 1.0,
    "um": 1000.0,
    "micrometer": 1000.0,
    "micron": 1000.0,
    "mm": 1e6,
    "millimeter": 1e6,
    "angstrom": 0.1,
}
# ENVI's units that are no lengths.
_NO_LENGTHS = ("wavenumber", "ghz", "mhz", "index")
SENSIBLE_NM = (100.0, 100_000.0)
"""No imaging spectrometer measures below 100 nm or beyond 100 µm. Smaller numbers without a unit are micrometres."""
# No instrument or library has more bands. Lists with one value a band are made before the data file's size is
# checked.
_MOST_BANDS = 100_000


@dataclass(frozen=True, eq=False)
class EnviHeader:
    """The content of an ENVI header.

    Attributes:
        header_path: the header file.
        shape: (lines, samples, bands).
        interleave: "bil", "bip" or "bsq".
        dtype: the stored numbers, with their byte order.
        offset: bytes before the first number.
        wavelengths_nm: band centres; None where the header lists none.
        fwhm_nm: full width of each band at half its maximum; None where the header lists none.
        good_bands: which bands the bad-band list ``bbl`` keeps; all without one.
        reflectance_scale: ``reflectance scale factor``, the stored number of reflectance 1 (1 by default).
        ignore_value: ``data ignore value``, the stored number that stands for "no data".
        integration_time_ms: Specim's ``tint``.
        fields: all fields by their names in lower case; values in braces are lists of texts, others texts.
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


def read_header(path: Path, library: bool = False) -> EnviHeader:
    """Read and check a header; the data file is not read.

    Args:
        library: whether it has to describe a spectral library, whose lines are spectra and whose samples are bands.

    Raises:
        InputError: there is no such file, or it is no ENVI header; a field is missing or unreadable; a list does not
            have one number a band. Or the pixels would be read wrongly (complex numbers, frame offsets, compression),
            or the header describes a library where an image is expected, or the converse.
    """
    fields = _mended_fields(path)
    lines, samples = _whole(path, fields, "lines"), _whole(path, fields, "samples")
    shape = (lines, samples, 1 if library else _whole(path, fields, "bands"))
    offset = _whole(path, fields, "header offset")
    if str(fields["data type"]) not in envi.envi_to_dtype:
        raise InputError(f"{path}: data type is {str(fields['data type'])!r}, which ENVI does not have; correct it.")
    dtype = np.dtype(envi.envi_to_dtype[str(fields["data type"])])
    _check_layout(path, fields, shape, dtype, offset, library)
    is_library = "library" in str(fields.get("file type", "")).lower()
    if is_library and not library:
        raise InputError(f"{path}: describes a spectral library, not an image; give the cube's header.")
    if library and not is_library:
        raise InputError(f"{path}: its file type is not a spectral library; give a library's header or correct it.")
    bands = shape[1] if library else shape[2]
    scale = _number(path, fields, "reflectance scale factor")
    if scale is not None and not scale > 0.0:
        raise InputError(f"{path}: reflectance scale factor {scale:g} is not positive; correct it.")
    tint = _number(path, fields, "tint")
    nm_per_unit, wavelengths_nm = _wavelengths(path, fields, bands)
    fwhm = _numbers(path, fields, "fwhm", bands)
    bad_band_list = _numbers(path, fields, "bbl", bands)
    return EnviHeader(
        header_path=path,
        shape=shape,
        interleave=fields["interleave"],
        dtype=dtype.newbyteorder(">" if fields["byte order"] == "1" else "<"),
        offset=offset,
        wavelengths_nm=wavelengths_nm,
        fwhm_nm=None if fwhm is None else fwhm * nm_per_unit,
        good_bands=np.ones(bands, bool) if bad_band_list is None else bad_band_list != 0.0,
        reflectance_scale=1.0 if scale is None else scale,
        ignore_value=_number(path, fields, "data ignore value"),
        integration_time_ms=tint if tint and tint > 0.0 else None,
        fields=fields,
    )


def _mended_fields(path: Path) -> dict[str, Any]:
    """The header's fields as in `EnviHeader.fields`; a missing ``byte order`` is filled in as little endian.

    Raises:
        InputError: there is no such file, it is no ENVI header, or a required field is missing.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such ENVI header; check the path.")
    with path.open("rb") as file:
        content = file.read(64)
        is_envi = content.removeprefix(b"\xef\xbb\xbf").lstrip()[:4].upper() == b"ENVI" and b"\0" not in content
        content += file.read() if is_envi else b""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    lines = text.lstrip().splitlines()[1:]
    text = "\n".join(line.rstrip() for line in lines if not line.lstrip().startswith(";"))
    if not is_envi or "{" in _FIELD.sub("", text):
        raise InputError(f"{path}: is not a readable ENVI header; export the file again.")
    fields: dict[str, Any] = {"byte order": "0"}
    for name, value in _FIELD.findall(text):
        key, value = name.strip().lower(), value.strip()
        if value.startswith("{") and key != "description":
            # Some writers set a comma after a list's last number.
            fields[key] = [item.strip() for item in value[1:-1].strip().removesuffix(",").split(",")]
        else:
            fields[key] = value.strip("{}").strip()
    missing = [key for key in _REQUIRED if not fields.get(key)]
    if missing:
        raise InputError(f"{path}: the header does not give {', '.join(missing)}; add it.")
    fields["interleave"] = str(fields["interleave"]).lower()
    return fields


def _check_layout(
    path: Path, fields: dict[str, Any], shape: tuple[int, int, int], dtype: np.dtype, offset: int, library: bool
) -> None:
    """Refuse headers whose pixels would be read wrongly."""
    if fields["interleave"] not in ("bil", "bip", "bsq"):
        raise InputError(f"{path}: interleave {fields['interleave']} is not bil, bip or bsq; correct it.")
    if min(shape) < 1 or offset < 0:
        raise InputError(
            f"{path}: {shape[0]} lines, {shape[1]} samples, {shape[2]} bands after {offset} bytes are not a spectral "
            "image; correct the header."
        )
    if max(shape[1:] if library else shape[2:]) > _MOST_BANDS:
        raise InputError(f"{path}: describes more than {_MOST_BANDS} bands; correct the header.")
    if dtype.kind == "c":
        raise InputError(f"{path}: holds complex numbers, which are not a spectral image; export real numbers.")
    if str(fields["byte order"]) not in ("0", "1"):
        raise InputError(f"{path}: byte order {fields['byte order']} is neither 0 (little) nor 1 (big); correct it.")
    for key in ("major frame offsets", "minor frame offsets", "file compression"):
        values = np.atleast_1d(fields.get(key, "0"))
        if any(str(value).strip() not in ("", "0") for value in values):
            raise InputError(f"{path}: has {key}, which are not supported; export the cube without them.")


def _whole(path: Path, fields: dict[str, Any], key: str) -> int:
    """A field's whole number; 0 where the field is missing or empty."""
    value = str(fields.get(key) or 0)
    try:
        return int(value)
    except ValueError as error:
        raise InputError(f"{path}: {key} is {value!r}, which is not a whole number; correct it.") from error


def _number(path: Path, fields: dict[str, Any], key: str) -> float | None:
    """A field's number; None where the field is missing or empty."""
    numbers = _numbers(path, {key: np.atleast_1d(fields.get(key, ""))[0]}, key, 1)
    return None if numbers is None else float(numbers[0])


def _numbers(path: Path, fields: dict[str, Any], key: str, count: int) -> Float[np.ndarray, "count"] | None:
    """A field's list of numbers, one a band; None where the field is missing or empty."""
    listed = fields.get(key, "")
    if listed in ("", [""]):
        return None
    values = [str(value) for value in np.atleast_1d(listed)]
    numbers = np.empty(len(values))
    for i, value in enumerate(values):
        try:
            numbers[i] = float(value)
        except ValueError as error:
            does = "lists" if count > 1 else "is"
            sentence = f"{path}: {key} {does} {value!r}, which is not a number; write the number alone."
            raise InputError(sentence) from error
    if len(numbers) != count:
        raise InputError(f"{path}: {key} lists {len(numbers)} numbers for {count} bands; correct the list.")
    if count > 1 and (not np.isfinite(numbers).all() or numbers.min() < 0.0):
        raise InputError(f"{path}: {key} holds numbers that are negative or not finite; correct the list.")
    return numbers


def _wavelengths(path: Path, fields: dict[str, Any], bands: int) -> tuple[float, Float[np.ndarray, "bands"] | None]:
    """The factor from the header's unit to nm, and the band centres, or None where it lists none."""
    unit = re.sub("[\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}]", "u", str(fields.get("wavelength units", "")).lower())
    unit = unit.strip().removesuffix("s").replace("metre", "meter")
    listed = _numbers(path, fields, "wavelength", bands)
    if listed is None or unit == "index":
        return _NM_PER_UNIT.get(unit, 1.0), None
    if unit in _NO_LENGTHS:
        raise InputError(f"{path}: gives its bands in {unit}, not as wavelengths; convert the list to nm.")
    implied = 1.0 if listed.max() >= SENSIBLE_NM[0] else 1000.0
    nm_per_unit = _NM_PER_UNIT.get(unit, implied)
    wavelengths_nm = listed * nm_per_unit
    if wavelengths_nm.min() < SENSIBLE_NM[0] or wavelengths_nm.max() > SENSIBLE_NM[1]:
        raise InputError(
            f"{path}: wavelengths from {wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm are not those of an "
            "imaging spectrometer; correct the list or its unit."
        )
    return nm_per_unit, wavelengths_nm
