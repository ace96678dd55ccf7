"""Errors of a processed session against the truth that it was simulated from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.processing.frames import FramePaths
from hsi_sc_nerf.simulate.truth import COVERED, Truth
from hsi_sc_nerf.spectra import nearest_bands

MIDDLE_REFLECTANCE = (0.1, 0.9)
"""Range of reflectance, free of clipping, in which errors are compared with the uncertainty."""


@dataclass(frozen=True)
class ProcessingScore:
    """Errors of a packed dataset over its frames.

    Attributes:
        rotation_deg: largest angle between an estimated and a true camera orientation.
        position_m: largest distance between an estimated and a true camera position.
        focal_length_percent: error of the focal length.
        reflectance_rmse: root mean squared error over all valid values, noise included; NaN without valid values.
        flagged_fraction: fraction of invalid values, in [0, 1].
        mask_iou: smallest intersection over union of a mask with the true object pixels.
    """

    rotation_deg: float
    position_m: float
    focal_length_percent: float
    reflectance_rmse: float
    flagged_fraction: float
    mask_iou: float


def score_processing(dataset: PackedDataset, truth: Truth) -> ProcessingScore:
    """Compare a packed dataset with the truth of its session, frame by frame and without alignment.

    Args:
        dataset: processed session.
        truth: truth of the session, in all bands of the dataset; it is clipped as reflectance is by default.

    Example:
        >>> score = score_processing(open_packed("data"), load_truth("pear-session"))
        >>> score.rotation_deg < 0.5
        True
    """
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    bands = nearest_bands(truth.wavelengths_nm, dataset.wavelengths_nm)
    rotations, positions, ious = [], [], []
    squares, measurements, values = 0.0, 0, 0
    for frame in dataset.frames:
        pose = poses[frame.capture]
        rotations.append(float(rotation_angle_deg(frame.camera_to_world, pose)))
        positions.append(float(np.linalg.norm(frame.camera_to_world[:3, 3] - pose[:3, 3])))
        measured, valid = unpack(frame.cube())
        errors = np.clip(truth.reflectance(frame.capture)[..., bands], *paper.REFLECTANCE_BOUNDS) - measured
        squares += float(np.sum(errors**2, where=valid, dtype=float))
        measurements += int(valid.sum())
        values += valid.size
        mask, covered = frame.mask(), truth.object_coverage(frame.capture) > COVERED
        ious.append(float((mask & covered).sum() / (mask | covered).sum()))
    return ProcessingScore(
        rotation_deg=max(rotations),
        position_m=max(positions),
        focal_length_percent=100 * abs(dataset.intrinsics.fl_x / truth.intrinsics.fl_x - 1),
        reflectance_rmse=float(np.sqrt(squares / measurements)) if measurements else np.nan,
        flagged_fraction=1.0 - measurements / values,
        mask_iou=min(ious),
    )


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
    """Compare packed frames with the true reflectance under even and constant light.

    Raises:
        ValueError: the calibration has no uncertainty (the session holds reflectance).
    """
    if calibration.uncertainty is None:
        raise ValueError("score_calibration: finished reflectance has no uncertainty to compare errors with")
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
