"""Where a session's white is: tarp, WHITEREF cubes, a target in the frames, or none for finished reflectance."""

from __future__ import annotations

from typing import Literal

from hsi_sc_nerf.calibration.detector import Defects
from hsi_sc_nerf.calibration.white_reference import Roi, White, column_white, white_reference
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.errors import InputError

WhiteSource = Literal["tarp", "capture", "target", "product"]


def white_source(session: Session, source: Literal["auto"] | WhiteSource, roi: Roi | None) -> WhiteSource:
    """The given source of white, or the first of tarp, capture and product that the session has.

    Raises:
        InputError: the session does not have it, or it is a target and ``roi`` is None.
    """
    available: dict[WhiteSource, tuple[bool, str]] = {
        "tarp": (session.white is not None and session.has_counts, "has no capture of a white tarp"),
        "capture": (session.has_own_whites, "does not have a WHITEREF cube with every capture"),
        "product": (session.has_products, "does not have a REFLECTANCE cube of every frame"),
        "target": (session.has_counts, "does not have raw counts of every frame"),
    }
    if source == "auto":
        # open_session refuses sessions without any of the first three.
        return next(source for source, (is_available, _) in available.items() if is_available)
    is_available, missing = available[source]
    if not is_available:
        raise InputError(f"{session.path}: {missing}; choose another --calibration.white-source, or auto.")
    if source == "target" and roi is None:
        raise InputError(
            f"{session.path}: where the white target is in the frames is not known; give its place with "
            "--calibration.roi."
        )
    return source


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


def exposure_ratio(capture: Capture, other: Capture) -> float:
    """Ratio of two captures' integration times; 1 if one is unknown."""
    return _ratio(capture.integration_time_ms, other.integration_time_ms)


def white_exposure_ratio(session: Session, source: WhiteSource, capture: Capture) -> float:
    """Ratio of the white's integration time to the sample's; 1 if one is unknown."""
    if source == "tarp":
        assert session.white is not None
        return exposure_ratio(session.white, capture)
    return 1.0 if source == "target" else _ratio(capture.white_integration_time_ms, capture.integration_time_ms)


def _ratio(one_ms: float | None, other_ms: float | None) -> float:
    return 1.0 if one_ms is None or other_ms is None else one_ms / other_ms
