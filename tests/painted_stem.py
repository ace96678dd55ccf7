"""A stem that is painted into the masks of a ball, upright on its top."""

import capture_factory as factory
import numpy as np

from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.geometry.camera import image_of
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import PackedDataset

LENGTH_M, RADIUS_M = 0.04, 0.006


def paint_stem(dataset: PackedDataset) -> float:
    """Paint it into all masks; gives the height of its upper end, metres."""
    angles = np.linspace(0.0, 2.0 * np.pi, 40)
    bottom_m = factory.SPHERE_CENTRE_M + np.array([0.0, 0.0, 0.9 * factory.SPHERE_RADIUS_M])
    ring = RADIUS_M * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    points_m = np.concatenate([bottom_m + ring + [0.0, 0.0, up] for up in np.linspace(0.0, LENGTH_M, 50)])
    for frame in dataset.frames:
        stem = dilate(image_of(points_m, frame.camera_to_world, dataset.intrinsics), 3)
        write_png(frame.mask_path, (frame.mask() | stem).astype(np.uint8) * 255)
    return float(points_m[:, 2].max())
