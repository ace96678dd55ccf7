"""Which part of a known surface the cameras of a session can see: what a reconstruction from them can be asked for.

An object that stands on its base hides a twelfth of its surface from every view. No reconstruction from the views
knows it, and a scanner that provides a reference from above does not either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.poses.geometry import PinholeIntrinsics, project

_CLEARANCE_M = 3e-4
"""Rays start this far in front of a point, so that its own surface does not hide it."""


def views_of_points(
    points_m: Float[np.ndarray, "n 3"],
    vertices_m: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    camera_to_worlds: Sequence[Float[np.ndarray, "4 4"]] | Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
) -> Int[np.ndarray, "n"]:
    """How many cameras have each point of a surface in their picture with nothing of the surface before it.

    Args:
        points_m: points on the surface.
        vertices_m: of the mesh.
        triangles: of the mesh.
        camera_to_worlds: OpenGL axes, in the mesh's frame, metres.
        intrinsics: of the cameras; distortion is neglected.
    """
    import open3d  # heavy

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        open3d.core.Tensor(np.asarray(vertices_m, np.float32)), open3d.core.Tensor(np.asarray(triangles, np.uint32))
    )
    views = np.zeros(len(points_m), int)
    for pose in camera_to_worlds:
        pixels, depth = project(points_m, pose, intrinsics)
        inside = (depth > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < (intrinsics.w, intrinsics.h)).all(axis=1)
        way = pose[:3, 3] - points_m
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        starts = points_m + way / distance * _CLEARANCE_M
        rays = open3d.core.Tensor(np.concatenate([starts, way], axis=1).astype(np.float32))
        views += inside & ~scene.test_occlusions(rays, 0.0, 1.0).numpy()
    return views
