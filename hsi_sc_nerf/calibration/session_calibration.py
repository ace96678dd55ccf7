"""A session's calibration: its white, its detector's defects and noise, its lamps' drift; and each frame's part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf.calibration.config import CalibrationConfig, WhiteSource
from hsi_sc_nerf.calibration.dark import dark_columns
from hsi_sc_nerf.calibration.defects import Defects, Readings, find_defects
from hsi_sc_nerf.calibration.flat_field import flat_field
from hsi_sc_nerf.calibration.lamp_drift import (
    LampDrift,
    NotMeasurable,
    correction,
    measure_lamp_drift,
    survey_count,
    survey_lines,
)
from hsi_sc_nerf.calibration.no_data import filled, no_data
from hsi_sc_nerf.calibration.noise import NoiseModel, measure_noise
from hsi_sc_nerf.calibration.panel import read_panel
from hsi_sc_nerf.calibration.reflectance import FrameCalibration
from hsi_sc_nerf.calibration.white_reference import White, WhiteReference, tarp_roi
from hsi_sc_nerf.calibration.white_source import (
    exposure_over,
    white_cubes,
    white_over_sample_time,
    white_source,
    whites_of_frames,
)
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import LARGEST_REFLECTANCE
from hsi_sc_nerf.packed.uncertainty import ReflectanceUncertainty, reflectance_uncertainty

FRAMES_TO_TELL_DEFECTS, LINES_TO_TELL_DEFECTS = 6, 4
"""In so many frames, evenly spread, and lines of each, defects of the detector and saturation are looked for."""


@dataclass(frozen=True, eq=False)
class SessionCalibration:
    """How each frame of a session becomes reflectance, and what was found on the way.

    Attributes:
        source: where the white is, or "product" where the instrument's finished reflectance is taken as it is.
        cubes: the cube that each frame is read from.
        frames: how its numbers become reflectance.
        bands: which of the files' bands are kept.
        white: of the session, or of its first frame where each has its own; None for finished reflectance.
        defects: of the detector; None for finished reflectance.
        noise: of a reading; None for finished reflectance.
        drift: of the lamps, or why it is not known.
        drift_corrected: whether it is divided out.
        uncertainty: of reflectance in the kept bands; None for finished reflectance.
    """

    source: WhiteSource
    cubes: tuple[Cube, ...]
    frames: tuple[FrameCalibration, ...]
    bands: Int[np.ndarray, "kept"]
    white: White | None
    defects: Defects | None
    noise: NoiseModel | None
    drift: LampDrift | NotMeasurable
    drift_corrected: bool
    uncertainty: ReflectanceUncertainty | None


def calibrate_session(session: Session, config: CalibrationConfig) -> SessionCalibration:
    """Calibrate a session; of the frames only a few lines are read.

    Raises:
        InputError: bounds that cannot be kept, a source of white that the session does not have, or a white or a
            panel that cannot be used.
    """
    low, high = config.bounds
    if not 0.0 <= low < high <= LARGEST_REFLECTANCE:
        raise InputError(
            f"--calibration.bounds {low:g} {high:g}: reflectance is kept from 0 to {LARGEST_REFLECTANCE:.4g}; give "
            "two ascending numbers within that."
        )
    source = white_source(session, config)
    return _finished(session, config) if source == "product" else _from_counts(session, source, config)


def _finished(session: Session, config: CalibrationConfig) -> SessionCalibration:
    """Finished reflectance is only scaled."""
    cubes = tuple(frame.product for frame in session.frames if frame.product is not None)
    bands = _kept(session, ~np.logical_and.reduce([cube.good_bands for cube in cubes]))
    return SessionCalibration(
        source="product",
        cubes=cubes,
        frames=tuple(
            FrameCalibration(
                dark=np.zeros((1, cube.shape[2])),
                gain=np.full((1, cube.shape[2]), 1.0 / cube.reflectance_scale),
                bands=bands,
                bounds=config.bounds,
                ignore_value=cube.ignore_value,
                quarter_turns=session.quarter_turns,
            )
            for cube in cubes
        ),
        bands=bands,
        white=None,
        defects=None,
        noise=None,
        drift=NotMeasurable("finished reflectance does not tell how noisy the readings were"),
        drift_corrected=False,
        uncertainty=None,
    )


def _from_counts(session: Session, source: WhiteSource, config: CalibrationConfig) -> SessionCalibration:
    captures = session.frames
    first = captures[0].cube
    lines, samples, bands = first.shape
    darks = _dark_spectra(captures)
    defects = _defects(session, source, config)
    whites = whites_of_frames(session, source, config, defects)
    panel = np.ones(bands)
    panel_path = config.panel or session.panel_reflectance_path
    if panel_path is not None:
        panel = read_panel(panel_path, first.wavelengths_nm)
    noise = _noise(session, source, whites[0], defects)

    survey = survey_lines(lines, survey_count(lines, config.lamp_drift))
    saturated = defects.saturation_counts
    exposures = np.array([exposure_over(capture, captures[0]) for capture in captures])

    def read_lines(frame: int) -> Num[np.ndarray, "survey samples bands"]:
        cube = captures[frame].cube
        counts = np.asarray(cube.memmap()[survey])
        missing = no_data(counts, cube.ignore_value)
        if missing is not None:
            counts = np.where(missing, np.float32(np.nan), counts)
        return counts if exposures[frame] == 1.0 else counts / exposures[frame]

    drift = measure_lamp_drift(
        read_lines,
        len(captures),
        [dark / exposure for dark, exposure in zip(darks, exposures, strict=True)],
        noise,
        first.wavelengths_nm,
        config.lamp_drift,
        saturation_counts=None if saturated is None else saturated / exposures.max(),
        dead=defects.dead,
    )
    # A white in every frame follows the lamps by itself.
    drifted = correction(drift, config.lamp_drift) if source == "tarp" else None

    bad_bands = defects.bad_bands | np.logical_or.reduce([white.bad_bands for white in whites])
    kept = _kept(session, bad_bands)
    flat = None
    if config.flat_field and source == "tarp":
        tarp, found = session.white, whites[0]
        assert tarp is not None
        assert isinstance(found, WhiteReference)
        flat = flat_field(tarp, found, (lines, samples), config, defects)
    frames = []
    for number, capture in enumerate(captures):
        white = whites[number % len(whites)]
        gain = panel * white_over_sample_time(session, source, capture) / white.spectrum
        if drifted is not None:
            gain = gain / drifted[number]
        # Where a column's own white says nothing, nothing can be calibrated.
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
        drift_corrected=drifted is not None,
        uncertainty=_uncertainty(session, source, whites[0], noise, panel, kept),
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
    """Of each capture; a dark cube that serves several is read once."""
    read: dict[Cube | None, Float[np.ndarray, "columns bands"]] = {}
    for capture in captures:
        if capture.dark not in read:
            read[capture.dark] = _dark_spectrum(capture.dark, capture.cube)
    return [read[capture.dark] for capture in captures]


def _dark_spectrum(dark: Cube | None, cube: Cube) -> Float[np.ndarray, "columns bands"]:
    return dark_columns(None if dark is None else dark.memmap(), *cube.shape[1:])


def _defects(session: Session, source: WhiteSource, config: CalibrationConfig) -> Defects:
    """From the lines that cross the white, and a few of some frames."""
    captures = session.frames
    lines, samples, _ = captures[0].cube.shape
    chosen = np.unique(np.linspace(0, len(captures) - 1, FRAMES_TO_TELL_DEFECTS).round().astype(int))
    rows = np.unique(np.linspace(0, lines - 1, LINES_TO_TELL_DEFECTS + 2).round().astype(int)[1:-1])
    of_frames = [_readings(captures[i].cube, captures[i].dark, rows) for i in chosen]
    good_bands = np.logical_and.reduce([capture.cube.good_bands for capture in captures])
    cube, dark = white_cubes(session, source)
    roi = None if source == "capture" else config.roi
    if source == "tarp" and roi is None:
        assert session.white is not None
        # Once the dead elements are known, it is found again without them (`white_reference`).
        roi = tarp_roi(session.white, config)
    inside = slice(None) if roi is None else slice(max(0, roi[1]), roi[3])
    white = _readings(cube, dark, np.arange(cube.shape[0])[inside])
    if white.counts.shape[1] != samples:
        white, of_frames = of_frames[0], of_frames[1:]
    return find_defects(white, of_frames, good_bands=good_bands, min_light=config.min_light)


def _readings(cube: Cube, dark: Cube | None, rows: Int[np.ndarray, "rows"]) -> Readings:
    counts = filled(np.asarray(cube.memmap()[rows]), cube.ignore_value)
    return Readings(counts, None if dark is None else dark.memmap())


def _noise(session: Session, source: WhiteSource, white: White, defects: Defects) -> NoiseModel:
    cube, dark = white_cubes(session, source)
    region = np.ones(cube.shape[:2], bool)
    if isinstance(white, WhiteReference):
        x0, y0, x1, y1 = white.roi
        region[:] = False
        region[y0:y1, x0:x1] = white.mask
    counts = cube.memmap()
    for number in np.flatnonzero(region.any(axis=1)):
        missing = no_data(counts[number], cube.ignore_value)
        if missing is not None:
            region[number] &= ~missing.any(axis=-1)
    same_detector = cube.shape[1:] == defects.dead.shape
    return measure_noise(
        counts,
        region,
        None if dark is None else dark.memmap(),
        saturation_counts=defects.saturation_counts,
        dead=defects.dead if same_detector else None,
    )


def _uncertainty(
    session: Session,
    source: WhiteSource,
    white: White,
    noise: NoiseModel,
    panel: Float[np.ndarray, "bands"],
    kept: Int[np.ndarray, "kept"],
) -> ReflectanceUncertainty:
    capture, dark = session.frames[0], white_cubes(session, source)[1]
    spectrum = white.mean_spectrum()
    # A bad band takes no part in its neighbours' average; any finite number serves in its place.
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
        integration_ratio=white_over_sample_time(session, source, capture),
    )
    return ReflectanceUncertainty(everywhere.constant[kept], everywhere.linear[kept], everywhere.quadratic[kept])
