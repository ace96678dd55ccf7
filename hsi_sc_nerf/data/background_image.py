"""An image of the chamber behind the turntable, estimated from the frames.

The camera stands still, so the median over the frames of the pixels that show neither object nor turntable is the
chamber without noise. Pixels that no frame shows are inpainted.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16
from scipy import ndimage
from scipy.sparse.linalg import LaplacianNd, splu

from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.processing.chamber import median_of_smallest, turntable_silhouette
from hsi_sc_nerf.robust_scatter import SIGMA_OF_MAD

MAX_FRAMES = 12
"""Frames that are read, evenly spread over the session: enough for a median."""
MAX_CELLS = 128
"""Cells along the image's longer side; the chamber is smooth."""
MIN_FRACTION = 0.2
"""Fraction of the frames read that has to show the chamber at a cell; other cells are inpainted."""
MARGIN_FRACTION = 0.01
"""Object and turntable are dilated by this fraction of the image's shorter side, because their edges are blurred."""
SMOOTHING_CELLS = 5
"""Side of the Wiener filter's window."""
_MEDIAN_VARIANCE = np.pi / 2.0
"""Variance of the median of many normal values, as a multiple of their mean's."""
# Multiples of these fill a square evenly (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
# 2018).
_QUASIRANDOM_STEPS = np.array([0.7548776662466927, 0.5698402909980532])


def estimate_static_background(
    dataset: PackedDataset, frames: Sequence[PackedFrame]
) -> tuple[Float[np.ndarray, "lines samples bands"], int]:
    """The chamber behind the turntable, on a coarse grid over the camera's image.

    Each frame contributes another single pixel of a cell, so that memory and reading do not grow with the image.
    Pixels count outside of the object's mask and of the turntable's silhouette, and of their values those that are
    measurements. Bands that are measured nowhere take ``dataset.background_reflectance``.

    Returns:
        Reflectance of the cells, and their side in pixels of the camera's image, from its upper left corner.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> image, cell_px = estimate_static_background(dataset, dataset.frames)
        >>> image.shape
        (128, 128, 204)
    """
    count = min(len(frames), MAX_FRAMES)
    chosen = [frames[int((i + 0.5) * len(frames) / count)] for i in range(count)]
    height, width = dataset.intrinsics.h, dataset.intrinsics.w
    cell_px = background_cell_px(dataset)
    margin_px = 2 * max(1, round(MARGIN_FRACTION * min(width, height))) + 1
    pixels = [cell_pixels(height, width, cell_px, k) for k in range(count)]
    free = np.empty((count, len(pixels[0][0]), len(pixels[0][1])), bool)
    for k, (frame, (y, x)) in enumerate(zip(chosen, pixels, strict=True)):
        turning = frame.mask() | turntable_silhouette(dataset, frame.camera_to_world)
        free[k] = ~dilate(turning, margin_px)[np.ix_(y, x)]

    min_frames = max(1, int(np.ceil(MIN_FRACTION * count)))
    with closing(PixelReader(frame.cube() for frame in chosen)) as reader:
        image = np.empty((*free.shape[1:], reader.shape[2]), np.float32)
        variance = np.empty_like(image)
        for line in range(len(image)):
            indices = [np.stack(np.broadcast_arrays(k, y[line], x), axis=-1) for k, (y, x) in enumerate(pixels)]
            counts = reader.read(np.concatenate(indices)).reshape(count, len(image[0]), -1)
            image[line], variance[line] = median_over_frames(counts, free[:, line], min_frames)
    return inpaint(wiener_filter(image, variance, SMOOTHING_CELLS), dataset.background_reflectance), cell_px


def background_cell_px(dataset: PackedDataset) -> int:
    """Side of the cells of the camera's image that the chamber's picture has, pixels."""
    return -(-max(dataset.intrinsics.w, dataset.intrinsics.h) // MAX_CELLS)


def cell_pixels(
    lines: int, samples: int, cell_px: int, index: int
) -> tuple[Int[np.ndarray, "cells_down"], Int[np.ndarray, "cells_across"]]:
    """Lines and samples of the pixel that represents each cell in frame ``index``; indices fill the cells evenly.

    Cells that reach beyond the image's far borders are represented by their last pixel inside it.
    """
    offset = (cell_px * ((0.5 + _QUASIRANDOM_STEPS * index) % 1.0)).astype(int)
    down, across = np.arange(0, lines, cell_px) + offset[0], np.arange(0, samples, cell_px) + offset[1]
    return np.minimum(down, lines - 1), np.minimum(across, samples - 1)


def median_over_frames(
    counts: UInt16[np.ndarray, "frames *cells bands"], free: Bool[np.ndarray, "frames *cells"], min_frames: int
) -> tuple[Float[np.ndarray, "*cells bands"], Float[np.ndarray, "*cells bands"]]:
    """Median reflectance over the frames and its variance due to noise; nan where too few frames show the chamber.

    Args:
        counts: packed reflectance; ``FLAGGED`` values are left out.
        free: where a frame shows the chamber.
        min_frames: number of values that a median needs.

    Returns:
        Medians, and their variances by the median absolute deviation over the frames (0 for a single frame).
    """
    values = np.where(free[..., None] & (counts != FLAGGED), counts, np.inf).astype(np.float32)
    number = np.isfinite(values).sum(axis=0)
    number[number < min_frames] = 0
    median = median_of_smallest(values, number)
    with np.errstate(invalid="ignore"):
        # Infinite where not measured, nan where there is no median: both are sorted to the end.
        deviation = np.abs(values - median)
    sigma = SIGMA_OF_MAD * median_of_smallest(deviation, number) / REFLECTANCE_SCALE
    return median / REFLECTANCE_SCALE, _MEDIAN_VARIANCE * sigma**2 / np.maximum(number, 1)


def wiener_filter(
    image: Float[np.ndarray, "lines samples bands"], variance: Float[np.ndarray, "lines samples bands"], window: int
) -> Float[np.ndarray, "lines samples bands"]:
    """Local Wiener filter of each band: values are averaged where they differ no more than by their noise.

    J.-S. Lee, "Digital image enhancement and noise filtering by use of local statistics", IEEE TPAMI 2, 1980. Values
    that are not measured (nan) are left out and stay nan.
    """
    measured = np.isfinite(image)
    number = _window_sum(measured.astype(np.float32), window)

    def local_mean(values: Float[np.ndarray, "lines samples bands"]) -> Float[np.ndarray, "lines samples bands"]:
        return _window_sum(np.where(measured, values, 0.0), window) / np.maximum(number, 1.0)

    mean = local_mean(image)
    # Deviations from the mean of each band keep single precision from cancelling.
    offset = np.where(measured, image, 0.0).sum(axis=(0, 1)) / np.maximum(measured.sum(axis=(0, 1)), 1)
    local_variance = local_mean((image - offset) ** 2) - (mean - offset) ** 2
    signal = np.maximum(1.0 - local_mean(variance) / np.maximum(local_variance, np.finfo(np.float32).tiny), 0.0)
    return np.where(measured, mean + signal * (image - mean), np.nan).astype(np.float32)


def inpaint(
    image: Float[np.ndarray, "lines samples bands"], spectrum: Float[np.ndarray, "bands"]
) -> Float[np.ndarray, "lines samples bands"]:
    """Replace values that are not measured (nan) by the solution of Laplace's equation, each band alone.

    Every inpainted value is the mean of its neighbours. A band that is measured nowhere takes its value of
    ``spectrum``.
    """
    filled = np.array(image, dtype=np.float32)
    flat = filled.reshape(-1, filled.shape[-1])
    missing = np.isnan(flat)
    nowhere = missing.all(axis=0)
    flat[:, nowhere] = spectrum[nowhere]
    # Bands that miss the same cells, nearly always all of them, share their system of equations.
    bands_by_pattern: dict[bytes, list[int]] = {}
    for band in np.flatnonzero(missing.any(axis=0) & ~nowhere):
        bands_by_pattern.setdefault(missing[:, band].tobytes(), []).append(int(band))
    # The neighbours' sum minus their number, for the cells line by line.
    laplacian = LaplacianNd(image.shape[:2], boundary_conditions="neumann", dtype=float).tosparse().tocsr()
    for bands in map(np.array, bands_by_pattern.values()):
        unknown = missing[:, bands[0]]
        rows = laplacian[unknown]
        right_side = -(rows[:, ~unknown] @ flat[np.ix_(~unknown, bands)].astype(float))
        flat[np.ix_(unknown, bands)] = splu(rows[:, unknown].tocsc()).solve(right_side)
    return filled


def _window_sum(values: Float[np.ndarray, "lines samples bands"], window: int) -> Float[np.ndarray, "..."]:
    means = ndimage.uniform_filter(values, (window, window, 1), mode="constant")
    return means * np.float32(window**2)
