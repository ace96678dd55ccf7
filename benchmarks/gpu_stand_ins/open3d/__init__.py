"""The parts of Open3D that this project uses, by embreex and SciPy; only benchmarks/gpu.py puts them on the path."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial import cKDTree

from . import core, t

__all__ = ["core", "geometry", "t", "utility"]


class _PointCloud:
    """A cloud that can say which of its points lie far from their neighbours."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = points

    def remove_statistical_outlier(self, nb_neighbors: int, std_ratio: float) -> tuple[_PointCloud, np.ndarray]:
        """The points whose mean distance to their neighbours is below the cloud's mean plus some deviations.

        As Open3D does it, each point is the first of its own neighbours.
        """
        mean = cKDTree(self.points).query(self.points, k=nb_neighbors, workers=-1)[0].mean(axis=1)
        inliers = np.flatnonzero(mean < mean.mean() + std_ratio * mean.std(ddof=1))
        return _PointCloud(self.points[inliers]), inliers


geometry = SimpleNamespace(PointCloud=_PointCloud)
utility = SimpleNamespace(Vector3dVector=np.asarray)
