"""Where a session's white is, and how it was exposed."""

from __future__ import annotations

from hsi_sc_nerf.calibration.config import CalibrationConfig, WhiteSource
from hsi_sc_nerf.calibration.defects import Defects
from hsi_sc_nerf.calibration.white_reference import White, column_white, target_white, white_reference
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.errors import InputError


def white_source(session: Session, config: CalibrationConfig) -> WhiteSource:
    """The source of white that the settings ask for, or the first that the session has.

    Raises:
        InputError: the session does not have it.
    """
    present: dict[WhiteSource, bool] = {
        "tarp": session.white is not None and session.has_counts,
        "capture": session.has_own_whites,
        "target": session.has_counts,
        "product": session.has_products,
    }
    if config.white_source == "auto":
        # A target in the frames needs to be pointed at.
        in_order: tuple[WhiteSource, ...] = ("tarp", "capture", "product")
        return next(source for source in in_order if present[source])
    if not present[config.white_source]:
        lacks = {
            "tarp": "has no capture of a white tarp",
            "capture": "does not have a WHITEREF cube with every capture",
            "target": "does not have raw counts of every frame",
            "product": "does not have a REFLECTANCE cube of every frame",
        }[config.white_source]
        raise InputError(f"{session.path}: {lacks}; choose another --calibration.white-source, or auto.")
    return config.white_source


def whites_of_frames(
    session: Session, source: WhiteSource, config: CalibrationConfig, defects: Defects
) -> list[White]:
    """One white for all frames, or one each.

    Raises:
        InputError: one of them cannot be used.
    """
    if source == "tarp":
        assert session.white is not None
        return [white_reference(session.white, config, defects)]
    if source == "target":
        return [target_white(capture, config, defects) for capture in session.frames]
    samples = session.frames[0].cube.shape[1]
    return [
        column_white(capture.white, capture.white_dark, samples, config, defects)
        for capture in session.frames
        if capture.white is not None
    ]


def white_cubes(session: Session, source: WhiteSource) -> tuple[Cube, Cube | None]:
    """The first white and its dark."""
    shown = session.white if source == "tarp" else session.frames[0]
    assert shown is not None
    white, dark = (shown.white, shown.white_dark) if source == "capture" else (shown.cube, shown.dark)
    assert white is not None
    return white, dark


def exposure_over(capture: Capture, other: Capture) -> float:
    """Ratio of integration times; 1 where one of them is not told."""
    if capture.integration_time_ms is None or other.integration_time_ms is None:
        return 1.0
    return capture.integration_time_ms / other.integration_time_ms


def white_over_sample_time(session: Session, source: WhiteSource, capture: Capture) -> float:
    """Ratio of the white's integration time to the sample's; 1 where one of them is not told."""
    if source == "tarp":
        assert session.white is not None
        return exposure_over(session.white, capture)
    if source == "target" or capture.white_integration_time_ms is None or capture.integration_time_ms is None:
        return 1.0
    return capture.white_integration_time_ms / capture.integration_time_ms
