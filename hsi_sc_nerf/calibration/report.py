"""What the calibration found, for people (pictures, sentences) and for machines (``calibration.json``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.calibration.lamp_drift import LampDrift, NotMeasurable
from hsi_sc_nerf.calibration.pictures import lamp_drift_picture, uncertainty_picture
from hsi_sc_nerf.calibration.pixel_counts import Tally
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.calibration.white_reference import WhiteReference
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.processing.report import column_white_picture, white_reference_picture

REPORT_NAME = "calibration.json"


def draw_calibration(
    folder: Path, session: Session, calibration: SessionCalibration, rgb_nm: Sequence[float]
) -> None:
    """Pictures of the white, the lamps' drift and the uncertainty, as far as there are any.

    Raises:
        InputError: the operating system refused to write.
    """
    wavelengths_nm = session.wavelengths_nm
    white = calibration.white
    if isinstance(white, WhiteReference):
        shown = session.white if calibration.source == "tarp" else session.frames[0]
        assert shown is not None
        white_reference_picture(folder / "white_reference.png", shown.cube, white, rgb_nm)
    elif white is not None:
        column_white_picture(folder / "white_reference.png", white, wavelengths_nm)
    if isinstance(calibration.drift, LampDrift):
        lamp_drift_picture(
            folder / "lamp_drift.png", calibration.drift, wavelengths_nm, corrected=calibration.drift_corrected
        )
    if calibration.uncertainty is not None:
        uncertainty_picture(folder / "uncertainty.png", calibration.uncertainty, wavelengths_nm[calibration.bands])


def describe_calibration(session: Session, calibration: SessionCalibration) -> list[str]:
    """What was found before any frame is calibrated, a sentence each."""
    white = calibration.white
    if white is None:
        sentences = ["White: none needed, the instrument's finished reflectance is taken."]
    elif calibration.source == "capture":
        sentences = ["White: the WHITEREF cube of each capture."]
    else:
        assert isinstance(white, WhiteReference)
        where = f"the tarp in {session.white.name}" if session.white and calibration.source == "tarp" else "a target"
        sentences = [f"White: {white.pixels} pixels of {where}."]
    if calibration.defects is not None:
        sentences.append(f"Detector: {calibration.defects.tally()}.")
    return [*sentences, _describe_drift(calibration)]


def _describe_drift(calibration: SessionCalibration) -> str:
    drift = calibration.drift
    if isinstance(drift, NotMeasurable):
        return f"Lamps: their drift was not measured, {drift.reason}."
    change = 100.0 * (drift.factor[:, calibration.bands] - 1.0)
    largest = change.flat[np.abs(change).argmax()]
    if calibration.drift_corrected:
        return f"Lamps: they drifted by up to {largest:+.2f} %; corrected."
    why = "as the settings say" if drift.significant else "within its uncertainty"
    if calibration.source != "tarp" and drift.significant:
        why = "because every frame has a white of its own"
    return f"Lamps: a drift of up to {largest:+.2f} % is not corrected, {why}."


def describe_tally(tally: Tally, values: int) -> str:
    """How much was clipped and flagged, of so many values; one sentence."""
    shares = {
        name: 100.0 * int(getattr(tally, name).sum()) / values
        for name in ("clipped_low", "clipped_high", "saturated", "dead", "no_data")
    }
    texts = {
        "clipped_low": "clipped at the lower bound",
        "clipped_high": "clipped at the upper bound",
        "saturated": "saturated",
        "dead": "of dead detector elements",
        "no_data": "without data",
    }
    told = [f"{share:.2g} % {texts[name]}" for name, share in shares.items() if share > 0.0]
    return f"Values: {', '.join(told) if told else 'none clipped or flagged'}."


def write_calibration(
    path: Path,
    session: Session,
    calibration: SessionCalibration,
    tally: Tally,
    typical_uncertainty: Float[np.ndarray, "kept"] | None,
) -> None:
    """Write ``calibration.json``: everything above as numbers; lists are by kept band where not said otherwise.

    Raises:
        InputError: the operating system refused to write.
    """
    wavelengths_nm, kept, white = session.wavelengths_nm, calibration.bands, calibration.white
    content: dict[str, Any] = {
        "white_source": calibration.source,
        "white": None if white is None else {"pixels": white.pixels, "counts": white.mean_spectrum()[kept].tolist()},
        "wavelengths_nm": wavelengths_nm[kept].tolist(),
        "bad_bands_nm": np.delete(wavelengths_nm, kept).tolist(),
        "saturation_counts": None if calibration.defects is None else calibration.defects.saturation_counts,
        "dead_elements": 0 if calibration.defects is None else int(calibration.defects.dead.sum()),
        "flat_field": calibration.frames[0].flat is not None,
        "noise": _noise(calibration),
        "lamp_drift": _drift(session, calibration),
        "clipped_low": tally.clipped_low.tolist(),
        "clipped_high": tally.clipped_high.tolist(),
        "saturated": tally.saturated.tolist(),
        "dead": tally.dead.tolist(),
        "no_data": tally.no_data.tolist(),
        "typical_uncertainty": None if typical_uncertainty is None else typical_uncertainty.tolist(),
    }
    if isinstance(white, WhiteReference):
        content["white"] |= {"roi": list(white.roi), "percentile": white.percentile}
    write_json(path, content)


def _noise(calibration: SessionCalibration) -> dict[str, Any] | None:
    noise = calibration.noise
    if noise is None:
        return None
    return {
        "read_noise_counts": noise.read_noise[calibration.bands].tolist(),
        "read_noise_measured": noise.read_noise_measured,
        "counts_per_electron": noise.counts_per_electron,
        "photon_noise_measured": noise.photon_noise_measured,
    }


def _drift(session: Session, calibration: SessionCalibration) -> dict[str, Any]:
    drift = calibration.drift
    if isinstance(drift, NotMeasurable):
        return {"measured": False, "corrected": False, "reason": drift.reason}
    factor, error = (part[:, calibration.bands] for part in (drift.factor, drift.standard_error))
    return {
        "measured": True,
        "corrected": calibration.drift_corrected,
        "significant": drift.significant,
        "p_value": drift.p_value,
        "static_share": drift.static_share,
        "factor": {frame.name: row.tolist() for frame, row in zip(session.frames, factor, strict=True)},
        "standard_error": {frame.name: row.tolist() for frame, row in zip(session.frames, error, strict=True)},
    }
