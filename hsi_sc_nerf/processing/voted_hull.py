"""The visual hull of the masks on a coarse grid, found by vote, and what each camera sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, closest_point_to_rays, project
from hsi_sc_nerf.geometry.visual_hull import visual_hull
from hsi_sc_nerf.morphology import dilate

GRID_CELLS = 48
"""The visual hull is computed on this number of voxels along each axis."""
HULL_MISSED_FRACTION = 0.15
"""Frames that may contradict a point of the hull: a few frames of another object must not carve it."""


@dataclass(frozen=True, eq=False)
class VotedHull:
    """The visual hull that most masks agree on.

    Attributes:
        core: centres of the voxels that hardly any mask contradicts (`visual_hull.MAX_MISSED_FRACTION`), object
            frame, metres; n may be 0.
        sides_m: of a voxel.
        voxel_px: diameter of a voxel in the images, odd.
        silhouettes: pixels of each frame that see the hull.
    """

    core: Float[np.ndarray, "n 3"]
    sides_m: Float[np.ndarray, "3"]
    voxel_px: int
    silhouettes: Bool[np.ndarray, "frames h w"]

    def trim(self, masks: Bool[np.ndarray, "frames h w"]) -> Bool[np.ndarray, "frames h w"]:
        """Masks without what most other frames contradict, such as noise on the container's lid.

        Masks may exceed the hull's silhouette by half a voxel's diameter.
        """
        return masks & np.stack([dilate(silhouette, self.voxel_px) for silhouette in self.silhouettes])


def voted_hull(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None = None,
) -> VotedHull:
    """The visual hull of the masks, which `HULL_MISSED_FRACTION` of the frames may contradict.

    The hull is computed on a grid twice: in the cube that the cameras see, then in the bounds found there. Masks are
    dilated by half a voxel's diagonal, so that parts thinner than a voxel are kept.

    Args:
        masks: true on the object.
        camera_to_worlds: poses, OpenGL axes.
        intrinsics: of the one camera; lens distortion is neglected.
        min_z_m: height of the container's lid, below which the hull does not reach; None if unknown.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> masks = np.stack([frame.mask() for frame in dataset.frames])
        >>> hull = voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics)
    """
    # The point that all frames look at.
    (centre,), _ = closest_point_to_rays(camera_to_worlds[:, :3, 3], camera_to_worlds[:, :3, 2])
    distance = np.linalg.norm(camera_to_worlds[:, :3, 3] - centre, axis=1).min()
    reach = distance * max(intrinsics.w / intrinsics.fl_x, intrinsics.h / intrinsics.fl_y) / 2.0
    low, high = centre - reach, centre + reach
    for _ in range(2):
        sides = (high - low) / GRID_CELLS
        ticks = [low[k] + sides[k] * (np.arange(GRID_CELLS) + 0.5) for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        if min_z_m is not None:
            points = points[points[:, 2] >= min_z_m - sides[2] / 2.0]
        voxel_px = 2 * int(np.ceil(intrinsics.fl_x * np.linalg.norm(sides) / 2.0 / distance)) + 1
        dilated = np.stack([dilate(mask, voxel_px) for mask in masks])
        voxels = visual_hull(points, dilated, camera_to_worlds, intrinsics, HULL_MISSED_FRACTION)
        if len(voxels) == 0:
            break
        low, high = voxels.min(axis=0) - sides / 2.0, voxels.max(axis=0) + sides / 2.0
    core = visual_hull(voxels, dilated, camera_to_worlds, intrinsics)
    silhouettes = np.stack([_silhouette(voxels, pose, intrinsics, voxel_px) for pose in camera_to_worlds])
    return VotedHull(core, sides, voxel_px, silhouettes)


def _silhouette(
    voxels: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics, voxel_px: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels that see the hull of masks that were dilated by a voxel's diameter."""
    seen = np.zeros((intrinsics.h, intrinsics.w), bool)
    x, y = np.floor(project(voxels, pose, intrinsics)[0]).astype(int).T
    inside = (x >= 0) & (x < intrinsics.w) & (y >= 0) & (y < intrinsics.h)
    seen[y[inside], x[inside]] = True
    # Dilation closes the gaps between voxels; erosion undoes it, and the dilation of the masks.
    return ~dilate(~dilate(seen, voxel_px), 2 * voxel_px - 1)
