"""Errors of camera poses against true ones, in place or after the best alignment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import Similarity, rotation_angle_deg


def pose_errors(
    found: Float[np.ndarray, "n 4 4"], true: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Errors of rotation (degrees) and position (millimetres) of each camera-to-world pose (metres)."""
    degrees = np.array([rotation_angle_deg(a, b) for a, b in zip(found, true, strict=True)])
    return degrees, 1e3 * np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=-1)


def align_poses(
    poses: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"], rigid: bool = False
) -> Similarity:
    """The similarity that brings poses closest to a reference: first their orientations, then their positions.

    Args:
        poses: camera-to-world, metres.
        reference: likewise.
        rigid: keep the scale.
    """
    left, _, right = np.linalg.svd(np.einsum("nij,nkj->ik", reference[:, :3, :3], poses[:, :3, :3]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    turned, target = poses[:, :3, 3] @ rotation.T, reference[:, :3, 3]
    centred = turned - turned.mean(axis=0)
    scale = 1.0 if rigid else float(np.sum(centred * target) / np.sum(centred**2))
    return Similarity(scale, rotation, target.mean(axis=0) - scale * turned.mean(axis=0))


def transformed_poses(similarity: Similarity, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world poses in the frame that the similarity leads to."""
    moved = poses.copy()
    moved[:, :3, :3] = similarity.rotation @ poses[:, :3, :3]
    moved[:, :3, 3] = similarity(poses[:, :3, 3])
    return moved
