"""Spectral point clouds: whole in memory, or in chunks on their way to a file; outliers and normals of points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

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

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray | slice) -> SpectralCloud:
        """The points that a slice, an index or a boolean array selects."""
        extra = {name: column[rows] for name, column in self.extra.items()}
        return SpectralCloud(
            self.points[rows],
            self.normals[rows],
            self.colours[rows],
            self.spectra[rows],
            self.wavelengths_nm,
            extra,
        )

    def check(self) -> None:
        """Raise ValueError if the arrays' shapes do not fit together."""
        count = len(self.points)
        expected = {
            "points": (self.points, (count, 3)),
            "normals": (self.normals, (count, 3)),
            "colours": (self.colours, (count, 3)),
            "spectra": (self.spectra, (count, len(self.wavelengths_nm))),
            **{name: (column, (count,)) for name, column in self.extra.items()},
        }
        for name, (array, shape) in expected.items():
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, not {shape}")


@dataclass(frozen=True)
class CloudStream:
    """A cloud in chunks, so that a writer does not hold all spectra at once.

    Attributes:
        count: points of all chunks together.
        wavelengths_nm: band centres.
        extra_names: the chunks' extra columns, in order.
        chunks: the chunks, which are iterated over once.
    """

    count: int
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra_names: tuple[str, ...]
    chunks: Iterable[SpectralCloud]

    def placed(self) -> Iterator[tuple[slice, SpectralCloud]]:
        """The chunks, each with the rows that it fills.

        Raises:
            ValueError: a chunk does not fit the description, or the chunks do not add up to ``count``.
        """
        start = 0
        for chunk in self.chunks:
            chunk.check()
            if tuple(chunk.extra) != self.extra_names or chunk.spectra.shape[1] != len(self.wavelengths_nm):
                raise ValueError("a chunk of the cloud has other columns than the cloud")
            yield slice(start, start + len(chunk)), chunk
            start += len(chunk)
        if start != self.count:
            raise ValueError(f"the chunks of the cloud hold {start} points, not {self.count}")


def stream(cloud: SpectralCloud, chunk_points: int = CHUNK_POINTS) -> CloudStream:
    """A cloud in memory as a stream of views of it.

    Raises:
        ValueError: the arrays' shapes do not fit together.
    """
    cloud.check()
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
    _, inliers = _open3d_cloud(points).remove_statistical_outlier(OUTLIER_NEIGHBOURS, std_ratio)
    return np.asarray(inliers, dtype=np.int64)


def estimate_normals(
    points: Float[np.ndarray, "n 3"], orientation: Float[np.ndarray, "n 3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Unit normals from neighbouring points, on the side of the vectors in ``orientation``, by default on either."""
    cloud = _open3d_cloud(points)
    cloud.estimate_normals()
    normals = np.asarray(cloud.normals)
    if orientation is None:
        return normals
    return np.where((normals * orientation).sum(axis=1, keepdims=True) < 0, -normals, normals)


def _open3d_cloud(points: Float[np.ndarray, "n 3"]) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
