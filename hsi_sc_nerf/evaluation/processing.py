"""How well a processed session fits the truth that it was simulated from: poses, camera, reflectance, masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsi_sc_nerf.data.packed import REFLECTANCE_SCALE, PackedDataset
from hsi_sc_nerf.poses.geometry import rotation_angle_deg
from hsi_sc_nerf.simulate.truth import Truth

COVERED = 0.5
"""A pixel belongs to the object where the object covers more than this share of it."""


@dataclass(frozen=True)
class ProcessingScore:
    """Errors of a packed dataset over its frames.

    Attributes:
        rotation_deg: largest angle between an estimated and a true camera orientation.
        position_m: largest distance between an estimated and a true camera position.
        focal_length_percent: error of the focal length.
        reflectance_rmse: root mean squared error over all pixels, bands and frames; noise counts.
        mask_iou: smallest intersection over union of a mask with the pixels that the object really covers.
    """

    rotation_deg: float
    position_m: float
    focal_length_percent: float
    reflectance_rmse: float
    mask_iou: float


def score_processing(dataset: PackedDataset, truth: Truth) -> ProcessingScore:
    """Compare a packed dataset with the truth of its session, frame by frame, without any alignment."""
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    rotations, positions, squares, ious = [], [], [], []
    for frame in dataset.frames:
        pose = poses[frame.capture]
        rotations.append(rotation_angle_deg(frame.camera_to_world, pose))
        positions.append(float(np.linalg.norm(frame.camera_to_world[:3, 3] - pose[:3, 3])))
        measured = frame.cube() / np.float32(REFLECTANCE_SCALE)
        squares.append(float(np.mean((measured - truth.reflectance(frame.capture)) ** 2)))
        mask, covered = frame.mask(), truth.object_coverage(frame.capture) > COVERED
        ious.append(float((mask & covered).sum() / (mask | covered).sum()))
    return ProcessingScore(
        rotation_deg=max(rotations),
        position_m=max(positions),
        focal_length_percent=100 * abs(dataset.intrinsics.fl_x / truth.intrinsics.fl_x - 1),
        reflectance_rmse=float(np.sqrt(np.mean(squares))),
        mask_iou=min(ious),
    )
