"""Clean point clouds with Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

OUTLIER_NEIGHBOURS = 20
"""Neighbours whose mean distance marks an outlier (released settings of the paper)."""


def open3d_cloud(points: Float[np.ndarray, "n 3"]) -> Any:
    """Open3D's own cloud of these points."""
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))


def statistical_inliers(points: Float[np.ndarray, "n 3"], std_ratio: float) -> Int[np.ndarray, "inliers"]:
    """Indices of the points whose mean distance to their neighbours is usual for the cloud.

    Without ``OUTLIER_NEIGHBOURS`` neighbours each, nothing is usual: all points stay.

    Args:
        points: positions, any unit.
        std_ratio: standard deviations above the cloud's mean from which a point is an outlier, above 0.
    """
    if len(points) <= OUTLIER_NEIGHBOURS:
        return np.arange(len(points))
    _, inliers = open3d_cloud(points).remove_statistical_outlier(nb_neighbors=OUTLIER_NEIGHBOURS, std_ratio=std_ratio)
    return np.asarray(inliers, dtype=np.int64)


def estimate_normals(points: Float[np.ndarray, "n 3"], facing: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Normals from neighbouring points, turned to the side of the vectors in ``facing`` (zeros: to either side)."""
    cloud = open3d_cloud(points)
    cloud.estimate_normals()
    normals = np.asarray(cloud.normals)
    return np.where((normals * facing).sum(axis=1, keepdims=True) < 0, -normals, normals)
