"""Statistics of the measured spectra of a point over the frames that see it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from hsi_sc_nerf.packed.cube import PixelFlag, unpack
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.surface.depth_renders import DepthRenders

COLUMNS = ("views", "spectral_std", "saturated")
INVALID_FLAGS = PixelFlag.SATURATED | PixelFlag.NO_DATA
"""Flags that make a view count as saturated or without data. A dead detector element does not: it affects the same
column of every frame, whatever the point."""


class RunningStd:
    """Standard deviation of spectra that arrive one view at a time.

    Deviations from a spectrum near the mean are summed, so that single precision is enough.

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
        """Add one view's spectra of some points, each point once; invalid values are not counted."""
        deviations = (spectra - self._near_mean[points]) * valid
        self._sums[points] += deviations
        self._counts[points] += valid
        deviations *= deviations
        self._squares[points] += deviations

    def mean_std(self) -> Float[np.ndarray, "n"]:
        """Sample standard deviation over the views, averaged over the bands with two values, or NaN."""
        counts = self._counts
        variance = self._squares - self._sums * self._sums / np.maximum(counts, 1)
        std = np.sqrt(np.maximum(variance, 0.0) / np.maximum(counts - 1.0, 1.0).astype(np.float32))
        enough = counts > 1
        with np.errstate(invalid="ignore"):
            return ((std * enough).sum(axis=1) / enough.sum(axis=1)).astype(np.float32)


def view_statistics(
    points: Float[torch.Tensor, "n 3"],
    normals: Float[torch.Tensor, "n 3"],
    near_mean: Float[np.ndarray, "n selected"],
    bands: Int[np.ndarray, "selected"],
    renders: DepthRenders,
    reader: PixelReader,
    flags: UInt8[np.ndarray, "frames lines samples"] | None,
) -> dict[str, Float[np.ndarray, "n"]]:
    """The columns ``COLUMNS`` of points.

    - ``views``: number of frames that see the point.
    - ``spectral_std``: standard deviation of the reflectance measured in the point's pixels over these frames,
      averaged over the bands; NaN with fewer than two frames.
    - ``saturated``: fraction of these pixels that are saturated or hold no data; 0 without a frame.

    Args:
        points: positions, in the unit of the depth maps.
        normals: outward unit normals.
        near_mean: a spectrum near each point's mean.
        bands: indices of the bands in the cubes.
        renders: poses and depth maps of the frames.
        reader: reads the frames' packed cubes, in the order of the depth maps.
        flags: `PixelFlag`s of the frames' pixels, in the same order; None if the dataset has none.
    """
    std = RunningStd(near_mean)
    views = np.zeros(len(points), np.float32)
    invalid = np.zeros(len(points), np.float32)
    for frame, view in enumerate(renders.views(points, normals)):
        rows = view.visible.nonzero()[:, 0].cpu().numpy()
        samples, lines = view.pixels[view.visible].cpu().numpy().T
        views[rows] += 1
        if flags is not None:
            invalid[rows] += (flags[frame, lines, samples] & INVALID_FLAGS) != 0
        # Neighbouring points share pixels: each pixel is read once.
        pixels, pixel_of_row = np.unique(lines * renders.intrinsics.w + samples, return_inverse=True)
        indices = np.stack([np.full(len(pixels), frame), *np.divmod(pixels, renders.intrinsics.w)], axis=1)
        spectra, valid = unpack(reader.read(indices)[:, bands])
        std.add(rows, spectra[pixel_of_row], valid[pixel_of_row])
    return dict(zip(COLUMNS, (views, std.mean_std(), invalid / np.maximum(views, 1)), strict=True))
