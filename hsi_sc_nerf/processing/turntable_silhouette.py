"""What of an image the turntable covers: its disc and the container, which turn with the object."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL
from hsi_sc_nerf.packed.dataset import PackedDataset


def turntable_silhouette(
    dataset: PackedDataset, camera_to_world: Float[np.ndarray, "4 4"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of a camera that show the turntable's disc or the container (`turntable_cylinders`)."""
    silhouette = np.zeros((dataset.intrinsics.h, dataset.intrinsics.w), np.uint8)
    to_camera = np.linalg.inv(camera_to_world @ OPENCV_TO_OPENGL)
    matrix = dataset.intrinsics.matrix()
    for points in turntable_cylinders(dataset):
        in_camera = points @ to_camera[:3, :3].T + to_camera[:3, 3]
        pixels, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, dataset.distortion)
        # OpenCV draws in coordinates whose origin is the first pixel's centre.
        cv2.fillConvexPoly(silhouette, cv2.convexHull(np.rint(pixels[:, 0] - 0.5).astype(np.int32)), 1)
    return silhouette > 0


def turntable_cylinders(dataset: PackedDataset) -> list[Float[np.ndarray, "points 3"]]:
    """Points on the rims of upright cylinders that hold the disc and the container, object frame, metres.

    Where the container's size is not known, one cylinder holds everything below the object. Flat markers around the
    container stand off its wall at their corners, so its cylinder is the one around that prism.
    """
    reach = np.abs(dataset.scene_box_m[:, :2]).max()
    lowest, container = dataset.scene_box_m[0, 2], dataset.container
    if container is None:
        return [_rims(reach, lowest, dataset.object_box_m[0, 2])]
    prism_radius = container.diameter_m / 2.0 / np.cos(np.pi / paper.CONTAINER_MARKERS)
    return [_rims(reach, lowest, 0.0), _rims(prism_radius, 0.0, container.height_m)]


def _rims(radius_m: float, low_m: float, high_m: float, points: int = 64) -> Float[np.ndarray, "points 3"]:
    angle = 2.0 * np.pi * np.arange(points) / points
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.insert(circle, 2, height, axis=1) for height in (low_m, high_m)])
