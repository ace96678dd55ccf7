"""Spectral point clouds as they travel between parts: whole in memory, or in pieces on their way to a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

# Points in a piece: 27 MB at 204 bands.
CHUNK_POINTS = 1 << 15
INCIDENCE = "incidence_deg"
"""Column: the angle between a point's normal and the ray that its spectrum is of."""
MAX_INCIDENCE_DEG = 70.0
"""Cameras that look at a face more obliquely than this see it smeared over their pixels, together with what lies
beside it (docs/traits.md)."""


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

    def check(self) -> None:
        """Raise ValueError where the arrays' shapes do not fit together."""
        count = len(self.points)
        expected = {"points": (self.points, 3), "normals": (self.normals, 3), "colours": (self.colours, 3)}
        expected["spectra"] = (self.spectra, len(self.wavelengths_nm))
        for name, (array, width) in expected.items():
            if array.shape != (count, width):
                raise ValueError(f"{name} has shape {array.shape}, not {(count, width)}")
        for name, column in self.extra.items():
            if column.shape != (count,):
                raise ValueError(f"{name} has shape {column.shape}, not {(count,)}")


@dataclass(frozen=True)
class CloudStream:
    """A cloud in pieces, so that writing it does not hold all spectra at once.

    Attributes:
        count: points of all pieces together.
        wavelengths_nm: band centres.
        extra_names: the pieces' extra columns, in order.
        chunks: the pieces; they can be asked for once.
    """

    count: int
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra_names: tuple[str, ...]
    chunks: Iterable[SpectralCloud]

    def placed(self) -> Iterator[tuple[slice, SpectralCloud]]:
        """The pieces, each with the rows that it fills.

        Raises:
            ValueError: a piece does not fit the description, or the pieces do not add up to ``count``.
        """
        start = 0
        for chunk in self.chunks:
            chunk.check()
            if tuple(chunk.extra) != self.extra_names or chunk.spectra.shape[1] != len(self.wavelengths_nm):
                raise ValueError("a piece of the cloud has other columns than the cloud")
            yield slice(start, start + len(chunk)), chunk
            start += len(chunk)
        if start != self.count:
            raise ValueError(f"the pieces of the cloud hold {start} points, not {self.count}")


def stream(cloud: SpectralCloud, chunk_points: int = CHUNK_POINTS) -> CloudStream:
    """A cloud that is in memory, in pieces that are views of it.

    Raises:
        ValueError: the arrays' shapes do not fit together.
    """
    cloud.check()

    def chunks() -> Iterator[SpectralCloud]:
        for start in range(0, len(cloud), chunk_points):
            rows = slice(start, start + chunk_points)
            yield SpectralCloud(
                cloud.points[rows],
                cloud.normals[rows],
                cloud.colours[rows],
                cloud.spectra[rows],
                cloud.wavelengths_nm,
                {name: column[rows] for name, column in cloud.extra.items()},
            )

    return CloudStream(len(cloud), cloud.wavelengths_nm, tuple(cloud.extra), chunks())
