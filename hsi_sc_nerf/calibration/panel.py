"""The reflectance of a white that is not a perfect one, from its certificate as a CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError

LARGEST_FRACTION = 1.5
"""Reflectances are fractions if none is larger than this, and percent otherwise."""
SHORTEST_NM = 100.0
"""No imaging spectrometer measures below: smaller numbers are no nanometres."""
_WANTED = "two columns, wavelength_nm and reflectance"


def read_panel(path: Path, wavelengths_nm: Float[np.ndarray, "bands"]) -> Float[np.ndarray, "bands"]:
    """Reflectance of a panel at the band centres, linear between the lines of its CSV file.

    The file has a line a wavelength, in any order: the wavelength in nm and the reflectance, as a fraction or, if any
    is above 1.5, in percent; between them a comma, a semicolon or a tab (with the latter two, decimals may have a
    comma). A first line of names, empty lines and lines that begin with # are skipped.

    The panel may end one band short of the bands; there its outermost value holds.

    Raises:
        InputError: no such file, a line that is not two numbers, values out of range, a wavelength twice, or a panel
            that does not cover the bands.
    """
    path = Path(path)
    panel_nm, reflectance = _read(path)
    order = np.argsort(panel_nm)
    panel_nm, reflectance = panel_nm[order], reflectance[order]
    twice = np.flatnonzero(np.diff(panel_nm) == 0.0)
    if len(twice):
        raise InputError(f"{path}: gives {panel_nm[twice[0]]:g} nm twice; keep one of these lines.")
    bands_nm = np.sort(wavelengths_nm)
    below, above = (bands_nm[1] - bands_nm[0], bands_nm[-1] - bands_nm[-2]) if len(bands_nm) > 1 else (0.0, 0.0)
    if panel_nm[0] > bands_nm[0] + below or panel_nm[-1] < bands_nm[-1] - above:
        raise InputError(
            f"{path}: gives the panel's reflectance from {panel_nm[0]:g} to {panel_nm[-1]:g} nm, but the bands lie "
            f"from {bands_nm[0]:g} to {bands_nm[-1]:g} nm; add the lines that are missing."
        )
    return np.interp(wavelengths_nm, panel_nm, reflectance)


def _read(path: Path) -> tuple[Float[np.ndarray, "lines"], Float[np.ndarray, "lines"]]:
    """Wavelengths (nm) and reflectances (fractions) as the file lists them."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise InputError(f"{path}: the panel's reflectance cannot be read ({reason}); check the path.") from error
    rows = []
    may_be_names = True
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = _numbers(line)
        if values is None and not may_be_names:
            raise InputError(f"{path}: line {number} ({line.strip()!r}) is not two numbers; write {_WANTED}.")
        may_be_names = False
        if values is not None:
            rows.append(values)
    if not rows:
        raise InputError(f"{path}: holds no reflectance; write {_WANTED}.")
    panel_nm, reflectance = np.array(rows).T
    if not panel_nm.min() >= SHORTEST_NM:
        raise InputError(f"{path}: gives {panel_nm.min():g} as a wavelength; write wavelengths in nm.")
    if not reflectance.min() > 0.0:
        raise InputError(
            f"{path}: gives a reflectance of {reflectance.min():g} at {panel_nm[reflectance.argmin()]:g} nm, but a "
            "white reflects something in every band; correct it."
        )
    if reflectance.max() > LARGEST_FRACTION:
        reflectance = reflectance / 100.0
    if reflectance.max() > LARGEST_FRACTION:
        raise InputError(
            f"{path}: gives a reflectance of {100.0 * reflectance.max():g} at {panel_nm[reflectance.argmax()]:g} nm, "
            "which is neither a fraction nor percent; correct it."
        )
    return panel_nm, reflectance


def _numbers(line: str) -> tuple[float, float] | None:
    """The two finite numbers of a line, or None."""
    separator = next((mark for mark in ";\t" if mark in line), ",")
    parts = line.strip().split(separator)
    if separator != ",":
        parts = [part.replace(",", ".") for part in parts]
    try:
        wavelength, reflectance = (float(part) for part in parts)
    except ValueError:
        return None
    return (wavelength, reflectance) if np.isfinite([wavelength, reflectance]).all() else None
