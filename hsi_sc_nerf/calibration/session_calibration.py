"""Calibration of a session: its white, the detector's defects and noise, the lamps' drift, and each frame's gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.detector import (
    Defects,
    Readings,
    dark_columns,
    dark_counts,
    fill_no_data,
    find_defects,
    light_above,
    no_data,
    pooled_darks,
    spread_rows,
)
from hsi_sc_nerf.calibration.flat_field import flat_field
from hsi_sc_nerf.calibration.lamp_drift import (
    CorrectDrift,
    LampDriftEstimate,
    NotMeasurable,
    correction,
    measure_lamp_drift,
    survey_lines,
)
from hsi_sc_nerf.calibration.noise import NoiseModel, measure_noise, reflectance_uncertainty
from hsi_sc_nerf.calibration.reflectance import FrameCalibration
from hsi_sc_nerf.calibration.white_reference import White, WhiteReference, require_inside, tarp_roi
from hsi_sc_nerf.calibration.white_source import (
    WhiteSource,
    exposure_ratio,
    has_one_white,
    measure_whites,
    panel_reflectance,
    white_cubes,
    white_exposure_ratio,
    white_source,
)
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import LARGEST_REFLECTANCE, ReflectanceUncertainty
from hsi_sc_nerf.settings_file import between

DEFECT_FRAMES, DEFECT_LINES, DEFECT_WHITE_LINES = 6, 4, 128
HIGHLIGHT_BANDS = 12
"""Frames, lines of each, and largest number of lines of the white that are searched for defects and saturation."""


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the white-reference calibration."""

    white_source: Literal["auto"] | WhiteSource = "auto"
    """Where the white is: in a capture of its own (tarp), in the WHITEREF cube of each capture (capture), or in every
    frame at --calibration.roi (target). Product takes the instrument's own REFLECTANCE cubes and needs no white. Auto
    takes the first of tarp, capture and product that the session has."""
    roi: tuple[int, int, int, int] | None = between(0, 10**6, default=None)
    """Region of the white in the stored file: x0 y0 x1 y1 in pixels, x counts samples, y counts lines, x1 and y1
    excluded. The pictures of `inspect` may be turned against it by image_rotation_deg. By default, a tarp is found by
    its brightness; a white target needs this."""
    bounds: tuple[float, float] = between(-100.0, 100.0, default=paper.REFLECTANCE_BOUNDS)
    """Reflectance is clipped to this range."""
    flat_field: bool = False
    """Divide by the falloff of the light over the image, as the tarp shows it."""
    lamp_drift: CorrectDrift = "auto"
    """Divide by the lamps' drift over the session if it is significant (auto), whenever it can be measured (always),
    or never. It is measured and reported in any case."""


@dataclass(frozen=True, eq=False)
class SessionCalibration:
    """How each frame of a session becomes reflectance, and what was measured for it.

    Attributes:
        source: where the white is.
        cubes: the cube that each frame is read from.
        frames: the calibration of each frame.
        bands: the bands of the files that are kept.
        drift: drift of the lamps, or why it is unknown.
        white: white of the session, or of the first frame if each has its own; None for "product".
        defects: defects of the detector; None for "product".
        noise: noise of a reading; None for "product".
        drift_corrected: whether the frames are divided by it.
        one_white: whether all frames are divided by one white, so that the lamps' drift is in their reflectance.
        uncertainty: of reflectance in the kept bands, of the frames that were exposed shortest; None for "product",
            and where the noise is unknown.
    """

    source: WhiteSource
    cubes: tuple[Cube, ...]
    frames: tuple[FrameCalibration, ...]
    bands: Int[np.ndarray, "kept"]
    drift: LampDriftEstimate | NotMeasurable
    white: White | None = None
    defects: Defects | None = None
    noise: NoiseModel | None = None
    drift_corrected: bool = False
    one_white: bool = False
    uncertainty: ReflectanceUncertainty | None = None


def calibrate_session(session: Session, config: CalibrationConfig) -> SessionCalibration:
    """Calibrate a session. Only a few lines of each frame are read.

    Raises:
        InputError: the bounds are out of range, the session does not have the white that the settings name, or the
            white or the panel cannot be used.

    Example:
        >>> session = open_session(Path("captures"))
        >>> calibration = calibrate_session(session, CalibrationConfig())
        >>> packed = pack_counts(calibration.cubes[0].memmap(), calibration.frames[0], pictures)
    """
    low, high = config.bounds
    if not 0.0 <= low < high <= LARGEST_REFLECTANCE:
        raise InputError(
            f"--calibration.bounds {low:g} {high:g}: reflectance is kept from 0 to {LARGEST_REFLECTANCE:.4g}; give "
            "two ascending numbers within that."
        )
    source = white_source(session, config.white_source)
    if source == "target" and config.roi is None:
        raise InputError(
            f"{session.path}: where the white target is in the frames is not known; give its place with "
            "--calibration.roi."
        )
    if config.flat_field and source != "tarp":
        raise InputError(
            f"{session.path}: has no tarp that shows the light's falloff; leave out --calibration.flat-field."
        )
    return _from_products(session, config) if source == "product" else _from_counts(session, source, config)


def _from_products(session: Session, config: CalibrationConfig) -> SessionCalibration:
    """The instrument's own reflectance is only scaled."""
    cubes = tuple(frame.product for frame in session.frames if frame.product is not None)
    bands = _kept(session, ~np.logical_and.reduce([cube.good_bands for cube in cubes]))
    frames = tuple(
        FrameCalibration(
            dark=np.zeros((1, cube.shape[2])),
            gain=np.full((1, cube.shape[2]), 1.0 / cube.reflectance_scale),
            bands=bands,
            bounds=config.bounds,
            ignore_value=cube.ignore_value,
            quarter_turns=session.quarter_turns,
        )
        for cube in cubes
    )
    return SessionCalibration(
        "product", cubes, frames, bands, NotMeasurable("the noise of finished reflectance is unknown")
    )


def _from_counts(session: Session, source: WhiteSource, config: CalibrationConfig) -> SessionCalibration:
    captures = session.frames
    lines, samples, _ = captures[0].cube.shape
    darks = _dark_spectra(captures)
    defects = _defects(session, source, config)
    whites = measure_whites(session, source, config.roi, defects)
    panel = panel_reflectance(session)
    noise = _noise(session, source, whites[0], defects)
    drift = _drift(session, darks, noise, defects)
    one_white = has_one_white(session, source)
    drift_factor = correction(drift, config.lamp_drift) if one_white else None

    bad_bands = defects.bad_bands | np.logical_or.reduce([white.bad_bands for white in whites])
    kept = _kept(session, bad_bands)
    flat = None
    if config.flat_field:
        tarp, found = session.white, whites[0]
        assert tarp is not None
        assert isinstance(found, WhiteReference)
        flat = flat_field(tarp, found, (lines, samples), defects)
    frames = []
    for number, capture in enumerate(captures):
        white = whites[number % len(whites)]
        gain = panel * white_exposure_ratio(session, source, capture) / white.spectrum
        if drift_factor is not None:
            gain = gain / drift_factor[number]
        # A sample without a white of its own cannot be calibrated.
        dead = (defects.dead | np.isnan(white.spectrum)) & ~bad_bands
        frames.append(
            FrameCalibration(
                dark=darks[number],
                gain=gain,
                bands=kept,
                bounds=config.bounds,
                flat=flat,
                saturation_counts=defects.saturation_counts,
                dead=dead if dead.any() else None,
                ignore_value=capture.cube.ignore_value,
                quarter_turns=session.quarter_turns,
            )
        )
    return SessionCalibration(
        source=source,
        cubes=tuple(capture.cube for capture in captures),
        frames=tuple(frames),
        bands=kept,
        white=whites[0],
        defects=defects,
        noise=noise,
        drift=drift,
        drift_corrected=drift_factor is not None,
        one_white=one_white,
        uncertainty=_uncertainty(session, source, whites[0], noise, panel, kept),
    )


def _drift(
    session: Session, darks: Sequence[Float[np.ndarray, "columns bands"]], noise: NoiseModel, defects: Defects
) -> LampDriftEstimate | NotMeasurable:
    """The lamps' drift, from counts at the first frame's integration time."""
    captures = session.frames
    lines = {0 if capture.dark is None else capture.dark.shape[0] for capture in captures}
    if len(lines) == 1 and 0 not in lines:
        darks = pooled_darks(darks, lines.pop(), noise.read_noise)
    survey = survey_lines(*captures[0].cube.shape[:2])
    exposures = [exposure_ratio(c.integration_time_ms, captures[0].integration_time_ms) for c in captures]

    def read_lines(frame: int) -> Num[np.ndarray, "survey samples bands"]:
        cube = captures[frame].cube
        counts = np.asarray(cube.memmap()[survey])
        missing = no_data(counts, cube.ignore_value)
        if missing is not None:
            counts = np.where(missing, np.float32(np.nan), counts)
        return counts if exposures[frame] == 1.0 else counts / exposures[frame]

    return measure_lamp_drift(
        read_lines,
        len(captures),
        [dark / exposure for dark, exposure in zip(darks, exposures, strict=True)],
        noise,
        session.wavelengths_nm,
        saturation_counts=None if defects.saturation_counts is None else defects.saturation_counts / max(exposures),
        dead=defects.dead | defects.bad_bands,
    )


def _kept(session: Session, bad_bands: Bool[np.ndarray, "bands"]) -> Int[np.ndarray, "kept"]:
    kept = np.flatnonzero(~bad_bands)
    if 2 * len(kept) < len(bad_bands):
        raise InputError(
            f"{session.path}: {np.count_nonzero(bad_bands)} of the {len(bad_bands)} bands are marked as bad, unlit "
            "or without a living detector element; check the headers' bad-band lists and the white."
        )
    return kept


def _dark_spectra(captures: Sequence[Capture]) -> list[Float[np.ndarray, "columns bands"]]:
    """Dark counts of each capture; a dark cube of several captures is read once."""
    detector = captures[0].cube.shape[1:]
    read = {dark: dark_columns(dark_counts(dark), *detector) for dark in {capture.dark for capture in captures}}
    return [read[capture.dark] for capture in captures]


def _defects(session: Session, source: WhiteSource, config: CalibrationConfig) -> Defects:
    """Defects found on the lines that cross the white and on some lines of some frames."""
    captures = session.frames
    lines, samples, _ = captures[0].cube.shape
    numbers = np.unique(np.linspace(0, len(captures) - 1, DEFECT_FRAMES).round().astype(int))
    rows = spread_rows(lines, DEFECT_LINES)
    of_frames = [
        _readings(capture.cube, capture.dark, np.union1d(rows, _brightest_lines(capture.cube)))
        for capture in (captures[number] for number in numbers)
    ]
    good_bands = np.logical_and.reduce([capture.cube.good_bands for capture in captures])
    cube, dark = white_cubes(session, source)
    roi = None if source == "capture" else config.roi
    if source == "tarp" and roi is None:
        assert session.white is not None
        # `white_reference` finds the tarp again, without the dead elements.
        roi = tarp_roi(session.white)
    if roi is not None:
        require_inside(roi, cube)
    inside = np.arange(cube.shape[0])[slice(None) if roi is None else slice(roi[1], roi[3])]
    white = _readings(cube, dark, inside[:: -(-len(inside) // DEFECT_WHITE_LINES)])
    if white.counts.shape[1] != samples:
        white, of_frames = of_frames[0], of_frames[1:]
    return find_defects(white, of_frames, good_bands=good_bands)


def _brightest_lines(cube: Cube) -> Int[np.ndarray, "rows"]:
    """The lines of the brightest readings in some bands: highlights are small. Hot elements are hot in all lines."""
    bands = np.unique(np.linspace(0, cube.shape[2] - 1, HIGHLIGHT_BANDS).round().astype(int))
    of_bands = np.stack([np.asarray(cube.memmap()[:, :, band], np.float32) for band in bands])
    counts = light_above(of_bands, None, cube.ignore_value)
    brighter = counts - np.median(counts, axis=1, keepdims=True)
    return np.unique(brighter.max(axis=2).argmax(axis=1))


def _readings(cube: Cube, dark: Cube | None, rows: Int[np.ndarray, "rows"]) -> Readings:
    return Readings(fill_no_data(np.asarray(cube.memmap()[rows]), cube.ignore_value), dark_counts(dark))


def _noise(session: Session, source: WhiteSource, white: White, defects: Defects) -> NoiseModel:
    cube, dark = white_cubes(session, source)
    region = white.region(cube.shape[:2]) if isinstance(white, WhiteReference) else np.ones(cube.shape[:2], bool)
    counts, same_detector = cube.memmap(), cube.shape[1:] == defects.dead.shape
    unused = np.broadcast_to(defects.dead if same_detector else False, cube.shape[1:]) | defects.bad_bands
    for number in np.flatnonzero(region.any(axis=1)):
        missing = no_data(counts[number], cube.ignore_value)
        if missing is not None:
            region[number] &= ~(missing & ~unused).any(axis=-1)
    return measure_noise(
        counts,
        region,
        dark_counts(dark),
        saturation_counts=defects.saturation_counts,
        dead=unused,
    )


def _uncertainty(
    session: Session,
    source: WhiteSource,
    white: White,
    noise: NoiseModel,
    panel: Float[np.ndarray, "bands"],
    kept: Int[np.ndarray, "kept"],
) -> ReflectanceUncertainty | None:
    if not (noise.read_noise_measured and noise.photon_noise_measured):
        return None
    capture, dark = session.frames[0], white_cubes(session, source)[1]
    spectrum = white.mean_spectrum()
    # Bad bands take no part in their neighbours' average, so any finite number will do.
    spectrum = np.interp(np.arange(len(spectrum)), kept, spectrum[kept])
    columns = np.ptp(white.roi[::2]) if isinstance(white, WhiteReference) else 1
    everywhere = reflectance_uncertainty(
        noise,
        spectrum,
        white_pixels=white.pixels,
        smoothing_bands=np.maximum(white.window_bands, 1),
        frame_dark_readings=0 if capture.dark is None else capture.dark.shape[0],
        white_dark_readings=0 if dark is None else dark.shape[0] * int(columns),
        panel_reflectance=panel,
        integration_ratio=max(white_exposure_ratio(session, source, frame) for frame in session.frames),
    )
    return ReflectanceUncertainty(everywhere.constant[kept], everywhere.linear[kept], everywhere.quadratic[kept])
