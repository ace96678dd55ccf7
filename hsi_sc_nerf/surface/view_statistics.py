"""Statistics of the measured spectra of a point over the frames that see it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from hsi_sc_nerf.packed.cube import PixelFlag, unpack
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.surface.depth_renders import DepthRenders

COLUMNS = ("views", "spectral_std", "saturated")
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
    views, invalid = np.zeros((2, len(points)), np.float32)
    # Deviations from a spectrum near the mean are summed, so that single precision is enough.
    sums, squares = np.zeros((2, *near_mean.shape), np.float32)
    counts = np.zeros(near_mean.shape, np.uint16)
    for frame, view in enumerate(renders.views(points, normals)):
        rows = view.visible.nonzero()[:, 0].cpu().numpy()
        samples, lines = view.pixels[view.visible].cpu().numpy().T
        views[rows] += 1
        if flags is not None:
            invalid[rows] += (flags[frame, lines, samples] & INVALID_FLAGS) != 0
        # Neighbouring points share pixels: each pixel is read once.
        pixels, pixel_of_row = np.unique(lines * renders.intrinsics.w + samples, return_inverse=True)
        indices = np.stack([np.full(len(pixels), frame), *np.divmod(pixels, renders.intrinsics.w)], axis=1)
        spectra, valid = (values[pixel_of_row] for values in unpack(reader.read(indices)[:, bands]))
        deviations = (spectra - near_mean[rows]) * valid
        sums[rows] += deviations
        squares[rows] += deviations**2
        counts[rows] += valid
    enough = counts > 1
    variance = (squares - sums**2 / np.maximum(counts, 1)) / np.maximum(counts - 1.0, 1.0).astype(np.float32)
    with np.errstate(invalid="ignore"):
        std = (np.sqrt(np.maximum(variance, 0.0)) * enough).sum(axis=1) / enough.sum(axis=1)
    columns = (views, std.astype(np.float32), invalid / np.maximum(views, 1))
    return dict(zip(COLUMNS, columns, strict=True))
