"""How well a processed session fits the truth that it was simulated from: poses, camera, reflectance, masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsi_sc_nerf import paper
from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.simulate.truth import Truth
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

COVERED = 0.5
"""A pixel belongs to the object where the object covers more than this share of it."""


@dataclass(frozen=True)
class ProcessingScore:
    """Errors of a packed dataset over its frames.

    Attributes:
        rotation_deg: largest angle between an estimated and a true camera orientation.
        position_m: largest distance between an estimated and a true camera position.
        focal_length_percent: error of the focal length.
        reflectance_rmse: root mean squared error over all values that are measurements; noise counts. NaN where
            nothing is.
        flagged_share: share of the values that are no measurements, in [0, 1].
        mask_iou: smallest intersection over union of a mask with the pixels that the object really covers.
    """

    rotation_deg: float
    position_m: float
    focal_length_percent: float
    reflectance_rmse: float
    flagged_share: float
    mask_iou: float


def score_processing(
    dataset: PackedDataset, truth: Truth, bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS
) -> ProcessingScore:
    """Compare a packed dataset with the truth of its session, frame by frame, without any alignment.

    Args:
        dataset: the processed session.
        truth: what it was simulated from, in the dataset's bands at least.
        bounds: what the calibration clipped reflectance to; the truth is clipped likewise.
    """
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    bands = nearest_bands(truth.wavelengths_nm, dataset.wavelengths_nm)
    rotations, positions, ious = [], [], []
    squares, measurements, values = 0.0, 0, 0
    for frame in dataset.frames:
        pose = poses[frame.capture]
        rotations.append(rotation_angle_deg(frame.camera_to_world, pose))
        positions.append(float(np.linalg.norm(frame.camera_to_world[:3, 3] - pose[:3, 3])))
        measured, valid = unpack(frame.cube())
        errors = np.clip(truth.reflectance(frame.capture)[..., bands], *bounds) - measured
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
        flagged_share=1.0 - measurements / values,
        mask_iou=min(ious),
    )
