"""Where a session's white reference is, and its own reflectance.

The white is a tarp, the WHITEREF cubes, a target in the frames, or none for finished reflectance. A certificate gives
its reflectance.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.calibration.detector import Defects
from hsi_sc_nerf.calibration.white_reference import Roi, White, column_white, white_reference
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.envi_header import SENSIBLE_NM
from hsi_sc_nerf.capture.roles import copies_of_others
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.capture.session_info import SESSION_INFO_NAME
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.number_table import read_number_table

WhiteSource = Literal["tarp", "capture", "target", "product"]
LARGEST_FRACTION = 1.5
"""Reflectances are percent if any is larger than this, and fractions otherwise."""
_FORMAT = "two columns, wavelength_nm and reflectance"


def white_source(session: Session, source: Literal["auto"] | WhiteSource = "auto") -> WhiteSource:
    """The given source of white, or the first of tarp, capture and product that the session has.

    Raises:
        InputError: the session does not have it, or none of the three.
    """
    available: dict[WhiteSource, tuple[bool, str]] = {
        "tarp": (session.white is not None and session.has_counts, "has no capture of a white tarp"),
        "capture": (session.has_own_whites, "does not have a WHITEREF cube with every capture"),
        "product": (session.has_products, "does not have a REFLECTANCE cube of every frame"),
        "target": (session.has_counts, "does not have raw counts of every frame"),
    }
    if source == "auto":
        order: tuple[WhiteSource, ...] = ("tarp", "capture", "product")
        for first in order:
            if available[first][0]:
                return first
        raise InputError(_no_white(session))
    is_available, missing = available[source]
    if not is_available:
        raise InputError(f"{session.path}: {missing}; choose another --calibration.white-source, or auto.")
    return source


def _no_white(session: Session) -> str:
    """The sentence that refuses a session without a way to reflectance for every frame."""
    without = next((frame for frame in session.frames if not frame.has_counts), None)
    if session.white is not None and without is not None:
        return (
            f"{without.cube.header_path}: there are no raw counts of this frame, but of other frames there is "
            "nothing else; copy its raw cube too, or the REFLECTANCE cube of every frame."
        )
    return (
        f"{session.path}: has no capture called {session.info.white_reference}; add the white tarp under this name, "
        f"give its name as 'white_reference' in {SESSION_INFO_NAME}, add a WHITEREF_NAME or REFLECTANCE_NAME to each "
        "frame, or process with --calibration.white-source target if a white stands in every frame."
    )


def measure_whites(session: Session, source: WhiteSource, roi: Roi | None, defects: Defects) -> list[White]:
    """One white for all frames, or one for each.

    Raises:
        InputError: one of them cannot be used.
    """
    if source == "tarp":
        assert session.white is not None
        return [white_reference(session.white, roi, defects)]
    if source == "target":
        return [white_reference(capture, roi, defects) for capture in session.frames]
    samples = session.frames[0].cube.shape[1]
    return [
        column_white(capture.white, capture.white_dark, samples, defects)
        for capture in session.frames
        if capture.white is not None
    ]


def white_cubes(session: Session, source: WhiteSource) -> tuple[Cube, Cube | None]:
    """Counts and dark counts of the first white."""
    capture = session.white if source == "tarp" else session.frames[0]
    assert capture is not None
    white, dark = (capture.white, capture.white_dark) if source == "capture" else (capture.cube, capture.dark)
    assert white is not None
    return white, dark


def has_one_white(session: Session, source: WhiteSource) -> bool:
    """Whether all frames are divided by one white: a tarp, or copies of a white beside each capture."""
    if source != "capture":
        return source == "tarp"
    first, *others = (frame.white.data_path for frame in session.frames if frame.white is not None)
    return len(copies_of_others([first], {str(path): path for path in others})) == len(others)


def exposure_ratio(one_ms: float | None, other_ms: float | None) -> float:
    """Ratio of two integration times; 1 if one is unknown."""
    return 1.0 if one_ms is None or other_ms is None else one_ms / other_ms


def white_exposure_ratio(session: Session, source: WhiteSource, capture: Capture) -> float:
    """Ratio of the white's integration time to the sample's; 1 if one is unknown."""
    if source == "tarp":
        assert session.white is not None
        return exposure_ratio(session.white.integration_time_ms, capture.integration_time_ms)
    if source == "target":
        return 1.0
    return exposure_ratio(capture.white_integration_time_ms, capture.integration_time_ms)


def panel_reflectance(session: Session) -> Float[np.ndarray, "bands"]:
    """Reflectance of the session's white at its bands; 1 where ``session.json`` names no certificate.

    Raises:
        InputError: the certificate cannot be used (`read_panel`).
    """
    path = session.panel_reflectance_path
    return np.ones(len(session.wavelengths_nm)) if path is None else read_panel(path, session.wavelengths_nm)


def read_panel(path: Path, wavelengths_nm: Float[np.ndarray, "bands"]) -> Float[np.ndarray, "bands"]:
    """Reflectance of a panel at the band centres, by linear interpolation.

    Each line of the file has a wavelength in nm and a reflectance, in any order of wavelengths; reflectances are
    percent if any is above 1.5. Titles may tell the columns and micrometres (`NumberTable.by_title`). The panel may
    end one band short of the bands; its outermost value is used there.

    Raises:
        InputError: there is no such file, a line is not two numbers, a value is out of range, a wavelength is given
            twice, or the panel does not cover the bands.

    Example:
        >>> reflectance = read_panel(Path("panel.csv"), session.wavelengths_nm)  # (bands,), 0 to 1
    """
    path = Path(path)
    panel_nm, reflectance = _read(path)
    order = np.argsort(panel_nm)
    panel_nm, reflectance = panel_nm[order], reflectance[order]
    twice = np.flatnonzero(np.diff(panel_nm) == 0.0)
    if len(twice):
        raise InputError(f"{path}: gives {panel_nm[twice[0]]:g} nm twice; keep one of these lines.")
    bands_nm = np.sort(wavelengths_nm)
    first_nm, last_nm = bands_nm[:2].max(), bands_nm[-2:].min()
    if panel_nm[0] > first_nm or panel_nm[-1] < last_nm:
        raise InputError(
            f"{path}: gives the panel's reflectance from {panel_nm[0]:g} to {panel_nm[-1]:g} nm, but the bands lie "
            f"from {bands_nm[0]:g} to {bands_nm[-1]:g} nm; add the lines that are missing."
        )
    return np.interp(wavelengths_nm, panel_nm, reflectance)


def _read(path: Path) -> tuple[Float[np.ndarray, "lines"], Float[np.ndarray, "lines"]]:
    """Wavelengths (nm) and reflectances (fractions) in the order of the file."""
    try:
        table = read_number_table(path)
    except OSError as error:
        raise InputError(
            f"{path}: the panel's reflectance cannot be read ({error.strerror}); check the path."
        ) from error
    except ValueError as error:
        raise InputError(f"{path}: the panel's reflectance cannot be read ({error}); write {_FORMAT}.") from error
    if len(table.numbers) == 0:
        raise InputError(f"{path}: holds no reflectance; write {_FORMAT}.")
    whole = np.isfinite(table.numbers).all(axis=1) & (table.numbers.shape[1] == 2)
    if not whole.all():
        raise InputError(f"{path}: line {table.lines[int(whole.argmin())]} is not two numbers; write {_FORMAT}.")
    panel_nm, reflectance = table.numbers.T
    columns = table.by_title() if table.titles else {}
    if len(columns) == 2 and "wavelength_nm" in columns:
        panel_nm = columns.pop("wavelength_nm")
        (reflectance,) = columns.values()
    if panel_nm.min() < SENSIBLE_NM[0]:
        raise InputError(f"{path}: gives {panel_nm.min():g} as a wavelength; write wavelengths in nm.")
    fractions = reflectance / 100.0 if reflectance.max() > LARGEST_FRACTION else reflectance
    if not (fractions.min() > 0.0 and fractions.max() <= LARGEST_FRACTION):
        wrong = reflectance.argmin() if fractions.min() <= 0.0 else reflectance.argmax()
        raise InputError(
            f"{path}: gives a reflectance of {reflectance[wrong]:g} at {panel_nm[wrong]:g} nm, but that of a white "
            "is above 0 and at most about 1, or 100 percent; correct it."
        )
    return panel_nm, fractions
