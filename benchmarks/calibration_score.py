"""Errors of a calibration against the truth of its simulated session."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.processing.frames import FramePaths
from hsi_sc_nerf.simulate.truth import Truth

MIDDLE_REFLECTANCE = (0.1, 0.9)
"""Range of reflectance, free of clipping, in which errors are compared with the uncertainty."""


@dataclass(frozen=True)
class CalibrationScore:
    """Errors over all frames and kept bands.

    Attributes:
        reflectance_rms: root mean squared error of valid values, noise included.
        noise_rms: root mean square of the uncertainty that the calibration states for them.
        error_over_uncertainty: root mean square of the ratio of error and uncertainty.
        drift_rms: relative root mean squared error of the lamp drift; NaN if the drift was not measured.
        flagged_fraction: fraction of invalid values, in [0, 1].
    """

    reflectance_rms: float
    noise_rms: float
    error_over_uncertainty: float
    drift_rms: float
    flagged_fraction: float


def score_calibration(
    session: Session, calibration: SessionCalibration, packed_dir: Path, truth: Truth
) -> CalibrationScore:
    """Compare packed frames with the true reflectance under even and constant light."""
    assert calibration.uncertainty is not None
    bands, bounds = calibration.bands, calibration.frames[0].bounds
    squares, variances, scores, flagged, values = 0.0, 0.0, [], 0, 0
    for capture in session.frames:
        packed, valid = unpack(open_cube(FramePaths.of(packed_dir, capture.name).cube).memmap())
        measured, valid = (np.rot90(image, -session.quarter_turns) for image in (packed, valid))
        expected = replace(truth.light(capture.name), illumination=()).radiance()[..., bands]
        deviation = calibration.uncertainty.standard_deviation(expected)
        error = measured - np.clip(expected, *bounds)
        squares += float((error[valid].astype(np.float64) ** 2).sum())
        variances += float((deviation[valid] ** 2).sum())
        inside = valid & (expected > MIDDLE_REFLECTANCE[0]) & (expected < MIDDLE_REFLECTANCE[1])
        scores.append(float(np.mean((error[inside] / deviation[inside]) ** 2)))
        flagged += int((~valid).sum())
        values += valid.size
    drift_rms = float("nan")
    if isinstance(calibration.drift, LampDriftEstimate):
        light = np.stack([lamp_output(truth, capture.name) for capture in session.frames])
        drift_rms = float(np.sqrt(np.mean((calibration.drift.factor / (light / light[0]) - 1.0) ** 2)))
    return CalibrationScore(
        reflectance_rms=float(np.sqrt(squares / (values - flagged))),
        noise_rms=float(np.sqrt(variances / (values - flagged))),
        error_over_uncertainty=float(np.sqrt(np.mean(scores))),
        drift_rms=drift_rms,
        flagged_fraction=flagged / values,
    )


def lamp_output(truth: Truth, capture: str) -> Float[np.ndarray, "bands"]:
    """True illumination in the image centre, which differs between frames by the lamp drift only."""
    product = np.ones(len(truth.wavelengths_nm))
    for factor in truth.light(capture).illumination:
        # A factor may be one number for all bands.
        product = product * factor[factor.shape[0] // 2, factor.shape[1] // 2]
    return product
