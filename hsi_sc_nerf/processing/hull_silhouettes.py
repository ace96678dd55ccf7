"""The visual hull of the masks on a coarse grid, and what each camera sees of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, closest_point_to_rays, project
from hsi_sc_nerf.geometry.visual_hull import MAX_MISSED_FRACTION, visual_hull
from hsi_sc_nerf.morphology import dilate

GRID_CELLS = 48
"""The visual hull is computed on this number of voxels along each axis."""
HULL_MISSED_FRACTION = 0.15
"""Frames that may contradict a point of the hull: a few frames of another object must not carve it."""


def trim_to_hull(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None = None,
) -> Bool[np.ndarray, "frames h w"]:
    """Masks without what most other frames contradict, such as noise on the container's lid.

    Masks may exceed the hull's silhouette by half a voxel's diameter. Arguments are those of `hull_silhouettes`.
    """
    silhouettes, size_px = _silhouettes(masks, camera_to_worlds, intrinsics, min_z_m)
    return masks & np.stack([dilate(silhouette, size_px) for silhouette in silhouettes])


def hull_silhouettes(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None = None,
) -> Bool[np.ndarray, "frames h w"]:
    """Pixels of each frame that see the visual hull, which is found by vote (`HULL_MISSED_FRACTION`).

    Args:
        masks: true on the object.
        camera_to_worlds: poses, OpenGL axes.
        intrinsics: of the one camera; lens distortion is neglected.
        min_z_m: height of the container's lid, below which the hull does not reach; None if unknown.
    """
    return _silhouettes(masks, camera_to_worlds, intrinsics, min_z_m)[0]


def _silhouettes(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None,
) -> tuple[Bool[np.ndarray, "frames h w"], int]:
    """`hull_silhouettes`, and the diameter of a voxel in px."""
    hull, _, size_px = hull_voxels(masks, camera_to_worlds, intrinsics, min_z_m, HULL_MISSED_FRACTION)
    silhouettes = np.zeros(masks.shape, bool)
    for silhouette, pose in zip(silhouettes, camera_to_worlds, strict=True):
        x, y = np.floor(project(hull, pose, intrinsics)[0]).astype(int).T
        inside = (x >= 0) & (x < intrinsics.w) & (y >= 0) & (y < intrinsics.h)
        silhouette[y[inside], x[inside]] = True
        # Dilation closes the gaps between voxels; erosion undoes it, and the dilation of the masks in `hull_voxels`.
        silhouette[:] = ~dilate(~dilate(silhouette, size_px), 2 * size_px - 1)
    return silhouettes, size_px


def hull_voxels(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None = None,
    max_missed_fraction: float = MAX_MISSED_FRACTION,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3"], int]:
    """Voxels of the masks' visual hull: their centres (n may be 0), their sides, and the diameter of one in px.

    The hull is computed on a grid twice: in the cube that the cameras see, then in the bounds found there. Masks are
    dilated by half a voxel's diagonal, so that parts thinner than a voxel are kept. Arguments are those of
    `object_box` and of `visual_hull`.
    """
    # The point that all frames look at.
    (centre,), _ = closest_point_to_rays(camera_to_worlds[:, :3, 3], camera_to_worlds[:, :3, 2])
    distance = np.linalg.norm(camera_to_worlds[:, :3, 3] - centre, axis=1).min()
    reach = distance * max(intrinsics.w / intrinsics.fl_x, intrinsics.h / intrinsics.fl_y) / 2.0
    low, high = centre - reach, centre + reach
    for _ in range(2):
        step = (high - low) / GRID_CELLS
        ticks = [low[k] + step[k] * (np.arange(GRID_CELLS) + 0.5) for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        if min_z_m is not None:
            points = points[points[:, 2] >= min_z_m - step[2] / 2.0]
        size_px = 2 * int(np.ceil(intrinsics.fl_x * np.linalg.norm(step) / 2.0 / distance)) + 1
        dilated = np.stack([dilate(mask, size_px) for mask in masks])
        hull = visual_hull(points, dilated, camera_to_worlds, intrinsics, max_missed_fraction)
        if len(hull) == 0:
            break
        low, high = hull.min(axis=0) - step / 2.0, hull.max(axis=0) + step / 2.0
    return hull, step, size_px
