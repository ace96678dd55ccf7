"""Statistics over the frames that see a point: their number, the spread of their spectra, the saturated fraction."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from hsi_sc_nerf.compiled import compiled
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, PixelFlag
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.surface.depth_renders import DepthRenders

STATISTICS = ("views", "spectral_std", "saturated")
"""Columns of `view_statistics`."""
INVALID_FLAGS = PixelFlag.SATURATED | PixelFlag.NO_DATA
"""Flags that make a view count as saturated or without data. A dead detector element does not: it affects the same
column of every frame, whatever the point."""


def view_statistics(
    points: Float[torch.Tensor, "n 3"],
    normals: Float[torch.Tensor, "n 3"],
    near_mean: Float[np.ndarray, "n selected"],
    bands: Int[np.ndarray, "selected"],
    renders: DepthRenders,
    reader: PixelReader,
    flags: UInt8[np.ndarray, "frames lines samples"] | None,
) -> dict[str, Float[np.ndarray, "n"]]:
    """The columns `STATISTICS` of points.

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
    views, invalid, std = np.zeros((3, len(points)), np.float32)
    sums, squares = np.zeros((2, *near_mean.shape), np.float32)
    counts = np.zeros(near_mean.shape, np.uint16)
    near_mean = np.ascontiguousarray(near_mean, np.float32)
    for frame, view in enumerate(renders.views(points, normals)):
        rows = view.visible.nonzero()[:, 0].cpu().numpy()
        samples, lines = view.pixels[view.visible].cpu().numpy().T
        views[rows] += 1
        if flags is not None:
            invalid[rows] += (flags[frame, lines, samples] & INVALID_FLAGS) != 0
        # Neighbouring points share pixels: each pixel is read once.
        pixels, pixel_of_row = np.unique(lines * renders.intrinsics.w + samples, return_inverse=True)
        indices = np.stack([np.full(len(pixels), frame), *np.divmod(pixels, renders.intrinsics.w)], axis=1)
        spectra = reader.read(indices)[:, bands]
        _add(spectra, pixel_of_row, rows, near_mean, sums, squares, counts)
    _mean_deviation(sums, squares, counts, std)
    return dict(zip(STATISTICS, (views, std, invalid / np.maximum(views, 1)), strict=True))


@compiled
def _add(packed, pixel_of_row, rows, near_mean, sums, squares, counts):
    """Add measured spectra, each to its point.

    Deviations from a spectrum near the mean are summed, so that single precision is enough.
    """
    scale = np.float32(REFLECTANCE_SCALE)
    for i in range(len(rows)):
        row, pixel = rows[i], pixel_of_row[i]
        for band in range(packed.shape[1]):
            number = packed[pixel, band]
            measured = number != FLAGGED
            deviation = np.float32(number) / scale - near_mean[row, band] if measured else np.float32(0.0)
            sums[row, band] += deviation
            squares[row, band] += deviation * deviation
            counts[row, band] += measured


@compiled
def _mean_deviation(sums, squares, counts, std):
    """Standard deviation over the views, mean over the bands with two views at least; NaN without such a band."""
    for row in range(len(std)):
        total, known = np.float32(0.0), 0
        for band in range(sums.shape[1]):
            count = np.float32(counts[row, band])
            if count > 1:
                variance = (squares[row, band] - sums[row, band] ** 2 / count) / (count - np.float32(1.0))
                total += np.sqrt(max(variance, np.float32(0.0)))
                known += 1
        std[row] = total / known if known else np.nan
