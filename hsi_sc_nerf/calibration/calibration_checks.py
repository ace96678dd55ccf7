"""Can the calibration be believed? The lamps' drift, clipped and saturated values, and the noise, as findings."""

from __future__ import annotations

import numpy as np

from hsi_sc_nerf.calibration.lamp_drift import NotMeasurable
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding, Level

FRAMES, LINES = 12, 16
"""Frames, and lines of each, on which clipped values are counted."""
MAX_ERROR = 0.003
"""Largest standard error of a known drift."""
LARGE_DRIFT, IMPLAUSIBLE_DRIFT = 0.3, 0.6
"""Changes of the light that lamps rarely make, and that no warm-up makes."""
CLIPPED_AMBER, CLIPPED_RED = 0.01, 0.2
"""Fractions of values at the upper bound. A white that clips fewer is judged by `check_white`."""
SATURATED_AMBER, SATURATED_RED = 0.01, 0.5
"""Fractions of saturated values in a band. They are flagged and used nowhere, so few do no harm."""
LOW_SNR, USELESS_SNR = 30.0, 5.0
"""Signal-to-noise ratios of one pixel of the white, median over the bands; a SPECIM IQ has more than 100."""
MAX_SCATTER = 0.02
"""Scatter of the still wall from frame to frame that noise and rounding do not explain."""


def check_calibration(session: Session, calibration: SessionCalibration) -> list[Finding]:
    """Check a calibrated session on a few lines of some frames.

    Returns:
        The findings ``drift``, ``clipped`` and ``noise``.

    Example:
        >>> session = open_session(Path("captures"))
        >>> refuse_red(check_calibration(session, calibrate_session(session, CalibrationConfig())))
    """
    return [check(session, calibration) for check in (_check_drift, _check_clipped, _check_noise)]


def _check_drift(session: Session, calibration: SessionCalibration) -> Finding:
    drift = calibration.drift
    if calibration.source != "tarp":
        return Finding("drift", "green", "Lamps: every frame has a white of its own, which follows them.")
    if isinstance(drift, NotMeasurable):
        sentence = f"the lamps' drift was not measured, because {drift.reason}; show more of the still chamber."
        return Finding("drift", "amber", f"{session.path}: {sentence}", {"measured": False})
    change = float(np.abs(drift.factor[:, calibration.bands] - 1.0).max())
    error = float(drift.standard_error[:, calibration.bands].max())
    pixels = int(drift.static.sum())
    values = {"measured": True, "largest_change": change, "standard_error": error, "static_pixels": pixels}
    told = f"the lamps' light changes by up to {100.0 * change:.1f} %"
    if change > LARGE_DRIFT:
        level: Level = "red" if change > IMPLAUSIBLE_DRIFT else "amber"
        return Finding("drift", level, f"{session.path}: {told}; check lamps and exposure times.", values)
    if error > MAX_ERROR:
        sentence = f"{told}, but only to {100.0 * error:.1f} %, from {pixels} pixels; show more of the still chamber."
        return Finding("drift", "amber", f"{session.path}: {sentence}", values)
    return Finding("drift", "green", f"Lamps: {told}, known to {100.0 * error:.2f} %.", values)


def _check_clipped(session: Session, calibration: SessionCalibration) -> Finding:
    numbers = np.unique(np.linspace(0, len(calibration.cubes) - 1, FRAMES).round().astype(int))
    clipped, saturated = [], []
    for number in numbers:
        cube, frame = calibration.cubes[number], calibration.frames[number]
        rows = np.unique(np.linspace(0, cube.shape[0] - 1, LINES + 2).round().astype(int)[1:-1])
        counts = np.asarray(cube.memmap()[rows])[..., frame.bands]
        dark, gain = (np.broadcast_to(part, cube.shape[1:])[:, frame.bands] for part in (frame.dark, frame.gain))
        reflectance = (counts - dark) * gain
        if frame.flat is not None:
            reflectance = reflectance / frame.flat[rows][..., None]
        live = np.ones(counts.shape, bool) if frame.dead is None else ~frame.dead[None, :, frame.bands]
        if frame.ignore_value is not None:
            live = live & (counts != frame.ignore_value)
        at_top = live & (counts >= (np.inf if frame.saturation_counts is None else frame.saturation_counts))
        clipped.append((live & ~at_top & (reflectance > frame.bounds[1])).mean())
        saturated.append(at_top.mean(axis=(0, 1)))
    by_band = np.mean(saturated, axis=0)
    worst = int(by_band.argmax())
    worst_nm = float(session.wavelengths_nm[calibration.bands[worst]])
    values = {"clipped": float(np.mean(clipped)), "saturated": float(by_band[worst]), "saturated_nm": worst_nm}
    of_a_band = f"at most {100.0 * values['saturated']:.2g} % of a band ({worst_nm:.0f} nm) are"
    told = (
        f"{100.0 * values['clipped']:.2g} % of the values are clipped at the upper bound, and "
        f"{of_a_band if values['saturated'] else 'none is'} saturated"
    )
    if values["clipped"] > CLIPPED_RED or values["saturated"] > SATURATED_RED:
        return Finding("clipped", "red", f"{session.path}: {told}; check the white and the integration time.", values)
    if values["clipped"] > CLIPPED_AMBER or values["saturated"] > SATURATED_AMBER:
        return Finding("clipped", "amber", f"{session.path}: {told}; a shorter integration time avoids it.", values)
    return Finding("clipped", "green", f"Values: {told}.", values)


def _check_noise(session: Session, calibration: SessionCalibration) -> Finding:
    noise, white, drift = calibration.noise, calibration.white, calibration.drift
    if noise is None or white is None:
        return Finding("noise", "green", "The noise of the instrument's finished reflectance is not known.")
    bands = calibration.bands
    spectrum = white.mean_spectrum()[bands]
    snr = float(np.median(spectrum / np.sqrt(noise.read_noise[bands] ** 2 + noise.counts_per_electron * spectrum)))
    scatter = 0.0 if isinstance(drift, NotMeasurable) else drift.scatter
    values = {"signal_to_noise_of_white": snr, "scatter_of_wall": scatter}
    told = f"one pixel of the white has a signal-to-noise ratio of {snr:.0f}"
    if snr < LOW_SNR:
        level: Level = "red" if snr < USELESS_SNR else "amber"
        return Finding("noise", level, f"{session.path}: {told}; use more light or a longer exposure.", values)
    if scatter > MAX_SCATTER:
        sentence = f"the still wall scatters by {100.0 * scatter:.1f} % from frame to frame; check lamps and shadows."
        return Finding("noise", "amber", f"{session.path}: {sentence}", values)
    if not (noise.read_noise_measured and noise.photon_noise_measured):
        what = "read noise" if noise.photon_noise_measured else "photon noise"
        sentence = f"the {what} was not measured; add dark cubes of several lines and a white that fills the image."
        return Finding("noise", "amber", f"{session.path}: {sentence}", values)
    return Finding("noise", "green", f"Noise: {told}.", values)
