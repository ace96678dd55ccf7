"""How much the measured spectra of a point differ between the frames that see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from hsi_sc_nerf.packed.cube import PixelFlag, unpack
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.surface.visibility import DepthMaps

COLUMNS = ("views", "spectral_std", "saturated")
SPOILING_FLAGS = PixelFlag.SATURATED | PixelFlag.NO_DATA
"""What makes a view of a point count as saturated or invalid. A dead element of the detector does not: it says
nothing of the point, and spoils the same column of every frame."""


class RunningSpread:
    """Standard deviation of spectra that arrive one view at a time.

    Deviations from a spectrum near the mean are summed, so that single precision loses nothing.

    Args:
        near_mean: a spectrum near each point's mean.
    """

    def __init__(self, near_mean: Float[np.ndarray, "n bands"]) -> None:
        self._near_mean = near_mean
        self._sums = np.zeros(near_mean.shape, np.float32)
        self._squares = np.zeros(near_mean.shape, np.float32)
        self._counts = np.zeros(near_mean.shape, np.uint16)

    def add(
        self,
        points: Int[np.ndarray, "m"],
        spectra: Float[np.ndarray, "m bands"],
        valid: Bool[np.ndarray, "m bands"],
    ) -> None:
        """One view's spectra of some points, each point once; values that are not valid do not count."""
        deviations = (spectra - self._near_mean[points]) * valid
        self._sums[points] += deviations
        self._counts[points] += valid
        deviations *= deviations
        self._squares[points] += deviations

    def mean_std(self) -> Float[np.ndarray, "n"]:
        """Sample standard deviation over the views, mean over the bands that have two; NaN without such a band."""
        counts = self._counts
        spread = self._squares - self._sums * self._sums / np.maximum(counts, 1)
        spread = np.sqrt(np.maximum(spread, 0.0) / np.maximum(counts - 1.0, 1.0).astype(np.float32))
        enough = counts > 1
        with np.errstate(invalid="ignore"):
            return ((spread * enough).sum(axis=1) / enough.sum(axis=1)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class MeasuredFrames:
    """What the frames measured, in the order of the depth maps.

    Attributes:
        reader: of their packed cubes.
        flags: `PixelFlag`s of their pixels; None where the dataset has none.
    """

    reader: PixelReader
    flags: UInt8[np.ndarray, "frames lines samples"] | None


def spread_over_views(
    points: Float[torch.Tensor, "n 3"],
    normals: Float[torch.Tensor, "n 3"],
    near_mean: Float[np.ndarray, "n bands"],
    bands: Int[np.ndarray, "bands"],
    maps: DepthMaps,
    measured: MeasuredFrames,
) -> dict[str, Float[np.ndarray, "n"]]:
    """The columns ``COLUMNS`` of points with outward unit normals, in the unit of the depth maps.

    ``views`` counts the frames that see a point; ``spectral_std`` is the standard deviation of the reflectance
    measured in the pixels that it falls into, over those frames, mean over the bands (NaN with fewer than two);
    ``saturated`` is the share of those pixels that are saturated or hold no data (0 with no view).

    Args:
        points: their positions.
        normals: unit vectors out of the surface.
        near_mean: a spectrum near each point's mean, of the chosen bands.
        bands: the chosen bands of the cubes.
        maps: poses and depth maps of the frames.
        measured: what they measured.
    """
    spread = RunningSpread(near_mean)
    views = np.zeros(len(points), np.float32)
    spoiled = np.zeros(len(points), np.float32)
    for frame, view in enumerate(maps.seen(points, normals)):
        rows = view.visible.nonzero()[:, 0].cpu().numpy()
        samples, lines = view.pixels[view.visible].cpu().numpy().T
        views[rows] += 1
        if measured.flags is not None:
            spoiled[rows] += (measured.flags[frame, lines, samples] & SPOILING_FLAGS) != 0
        # Neighbouring points share pixels: each pixel is read once.
        pixels, which = np.unique(lines * maps.intrinsics.w + samples, return_inverse=True)
        place = np.stack([np.full(len(pixels), frame), *np.divmod(pixels, maps.intrinsics.w)], axis=1)
        spectra, valid = unpack(measured.reader.read(place)[:, bands])
        spread.add(rows, spectra[which], valid[which])
    columns = (views, spread.mean_std(), spoiled / np.maximum(views, 1))
    return dict(zip(COLUMNS, columns, strict=True))
