"""Errors of a processed session against the truth that it was simulated from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsi_sc_nerf import paper
from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.simulate.truth import COVERED, Truth
from hsi_sc_nerf.spectra import nearest_bands


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
