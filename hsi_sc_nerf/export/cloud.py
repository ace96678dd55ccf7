"""Spectral point clouds: whole in memory, or in chunks on their way to a file; outliers and normals of points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

CHUNK_POINTS = 1 << 15
"""Points of a chunk: 27 MB at 204 bands."""
INCIDENCE = "incidence_deg"
"""Column: the angle between a point's normal and the ray that gave its spectrum."""
MAX_INCIDENCE_DEG = 70.0
"""At larger angles of incidence a pixel also covers what lies beside the surface (docs/how-to/traits.md)."""
OUTLIER_NEIGHBOURS = 20
"""Neighbours whose mean distance marks an outlier (released settings of the paper)."""


@dataclass(frozen=True)
class SpectralCloud:
    """Points with their spectra."""

    points: Float[np.ndarray, "n 3"]  # metres
    normals: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    spectra: Float[np.ndarray, "n bands"]  # reflectance
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra: dict[str, Float[np.ndarray, "n"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        columns = (self.points, self.normals, self.colours, self.spectra, *self.extra.values())
        lengths = {len(column) for column in columns}
        if len(lengths) != 1 or self.spectra.shape[1] != len(self.wavelengths_nm):
            raise ValueError(f"the columns of a cloud do not fit together: {[column.shape for column in columns]}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray | slice) -> SpectralCloud:
        """The points that a slice, an index or a boolean array selects."""
        own = {name: getattr(self, name)[rows] for name in ("points", "normals", "colours", "spectra")}
        return replace(self, **own, extra={name: column[rows] for name, column in self.extra.items()})


@dataclass(frozen=True)
class CloudStream:
    """A cloud in chunks, so that a writer does not hold all spectra at once.

    Attributes:
        count: points of all chunks together.
        wavelengths_nm: band centres.
        extra_names: the chunks' extra columns, in order.
        chunks: the chunks, which are iterated over once.
        run: name of the run that made the cloud, which files state.
    """

    count: int
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra_names: tuple[str, ...]
    chunks: Iterable[SpectralCloud]
    run: str = ""


def stream(cloud: SpectralCloud, chunk_points: int = CHUNK_POINTS) -> CloudStream:
    """A cloud in memory as a stream of views of it."""
    chunks = (cloud.select(slice(start, start + chunk_points)) for start in range(0, len(cloud), chunk_points))
    return CloudStream(len(cloud), cloud.wavelengths_nm, tuple(cloud.extra), chunks)


def statistical_inliers(points: Float[np.ndarray, "n 3"], std_ratio: float) -> Int[np.ndarray, "inliers"]:
    """Indices of the points whose mean distance to their neighbours is usual for the cloud.

    All points of a cloud with no more than ``OUTLIER_NEIGHBOURS`` points are inliers.

    Args:
        points: positions, any unit.
        std_ratio: standard deviations above the cloud's mean from which a point is an outlier, above 0.
    """
    if len(points) <= OUTLIER_NEIGHBOURS:
        return np.arange(len(points))
    distances = cKDTree(points).query(points, OUTLIER_NEIGHBOURS, workers=-1)[0].mean(axis=1)
    return np.flatnonzero(distances <= distances.mean() + std_ratio * distances.std(ddof=1))


def estimate_normals(
    points: Float[np.ndarray, "n 3"], orientation: Float[np.ndarray, "n 3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Unit normals from neighbouring points, on the side of the vectors in ``orientation``, by default on either."""
    from open3d.geometry import PointCloud  # heavy
    from open3d.utility import Vector3dVector

    cloud = PointCloud(Vector3dVector(np.asarray(points, np.float64)))
    cloud.estimate_normals()
    normals = np.asarray(cloud.normals)
    if orientation is None:
        return normals
    return np.where((normals * orientation).sum(axis=1, keepdims=True) < 0, -normals, normals)
