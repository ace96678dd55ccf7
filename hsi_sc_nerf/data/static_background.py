"""A picture of the chamber behind the turntable, from the frames themselves.

The camera stands still, and so does what it sees beside the object and the turntable: the median over the frames of
the pixels that show neither is the chamber without its noise. What neither frame shows is filled in.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from hsi_sc_nerf import paper
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, PinholeIntrinsics
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.packed.pixels import PixelReader

_MEDIAN_VARIANCE = np.pi / 2.0
"""Variance of the median of many normal values, as a multiple of their mean's."""
_SPREAD_OF_MAD = 1.4826
"""Standard deviation of a normal distribution, as a multiple of its median absolute deviation."""
# The golden ratio's cousin for two dimensions: multiples of its powers fill a square evenly (M. Roberts, "The
# unreasonable effectiveness of quasirandom sequences", 2018).
_EVEN_STEPS = np.array([0.7548776662466927, 0.5698402909980532])


MARGIN_FRACTION = 0.01
"""Object and turntable are dilated by this fraction of the image's shorter side, because their edges are blurred."""
SMOOTHING_CELLS = 5
"""Side of the Wiener filter's window."""


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """The chamber as the camera sees it.

    Attributes:
        image: reflectance.
        coverage: share of the frames looked at that show the chamber there; 0 where it was filled in.
        cell_px: side of a cell in pixels of the camera's image; cells count from the image's upper left corner.
    """

    image: Float[np.ndarray, "lines samples bands"]
    coverage: Float[np.ndarray, "lines samples"]
    cell_px: int


def estimate_static_background(
    dataset: PackedDataset,
    frames: Sequence[PackedFrame],
    *,
    max_frames: int = 12,
    max_cells: int = 128,
    min_fraction: float = 0.2,
) -> StaticBackground:
    """The chamber behind the turntable, on a coarse grid over the camera's image.

    Of each cell every frame gives another single pixel, so that memory and reading do not grow with the image, and
    the median over the frames is one over the cell as well. Pixels count where they lie outside the object's mask and
    the outline of the turntable (`turning_outline`), and the values among them that are measurements. Places that too
    few frames show are filled in by `fill_in`, and a band that is measured nowhere by ``dataset``'s background
    spectrum.

    Args:
        dataset: camera, boxes and container.
        frames: the frames that may be looked at (training frames).
        max_frames: number of frames that are read, evenly spread over the session.
        max_cells: cells of the picture along its longer side.
        min_fraction: fraction of the frames that have to show the chamber at a cell; other cells are filled in.
    """
    chosen = [frames[i] for i in evenly_spread(len(frames), max_frames)]
    lens = dataset.intrinsics
    cell_px = -(-max(lens.w, lens.h) // max_cells)
    margin_px = 2 * max(1, round(MARGIN_FRACTION * min(lens.w, lens.h))) + 1
    places = [pixel_of_cells(lens.h, lens.w, cell_px, k) for k in range(len(chosen))]
    solids = turning_solids(dataset)
    free = np.empty((len(chosen), len(places[0][0]), len(places[0][1])), bool)
    for k, (frame, (y, x)) in enumerate(zip(chosen, places, strict=True)):
        turning = frame.mask() | turning_outline(solids, frame.camera_to_world, lens, dataset.distortion)
        free[k] = ~dilate(turning, margin_px)[np.ix_(y, x)]

    least = max(1, int(np.ceil(min_fraction * len(chosen))))
    with closing(PixelReader(frame.cube() for frame in chosen)) as reader:
        image = np.empty((*free.shape[1:], reader.shape[2]), np.float32)
        variance = np.empty_like(image)
        for line in range(len(image)):
            indices = [np.stack(np.broadcast_arrays(k, y[line], x), axis=-1) for k, (y, x) in enumerate(places)]
            counts = reader.read(np.concatenate(indices)).reshape(len(chosen), len(image[0]), -1)
            image[line], variance[line] = median_over_frames(counts, free[:, line], least)
    image = quieten(image, variance, SMOOTHING_CELLS)
    coverage = free.mean(axis=0)
    return StaticBackground(
        image=fill_in(image, dataset.background_reflectance),
        coverage=np.where(free.sum(axis=0) >= least, coverage, 0.0).astype(np.float32),
        cell_px=cell_px,
    )


def evenly_spread(number: int, most: int) -> Int[np.ndarray, "chosen"]:
    """At most so many of ``number`` places, evenly spread, the outer ones half a step from the ends."""
    chosen = min(number, most)
    return ((np.arange(chosen) + 0.5) * number / chosen).astype(int)


def pixel_of_cells(
    lines: int, samples: int, cell_px: int, turn: int
) -> tuple[Int[np.ndarray, "cells_down"], Int[np.ndarray, "cells_across"]]:
    """Lines and samples of the pixel that each cell gives on its ``turn``; turns fill the cells evenly.

    Cells that reach beyond the image's far borders give their last pixel inside it.
    """
    offset = (cell_px * ((0.5 + _EVEN_STEPS * turn) % 1.0)).astype(int)
    down, across = np.arange(0, lines, cell_px) + offset[0], np.arange(0, samples, cell_px) + offset[1]
    return np.minimum(down, lines - 1), np.minimum(across, samples - 1)


def turning_solids(dataset: PackedDataset) -> list[Float[np.ndarray, "points 3"]]:
    """Rims of the upright cylinders about the axis that the turntable fills, metres, object frame.

    These are the disc and the container; where the container's size is not known, all that lies under the object.
    Flat markers round the container stand off its wall at their corners, as a prism does that encloses it.
    """
    reach = np.abs(dataset.scene_box_m[:, :2]).max()
    lowest, container = dataset.scene_box_m[0, 2], dataset.container
    if container is None:
        return [_rims(reach, lowest, dataset.object_box_m[0, 2])]
    prism = container.diameter_m / 2.0 / np.cos(np.pi / paper.CONTAINER_MARKERS)
    return [_rims(reach, lowest, 0.0), _rims(prism, 0.0, container.height_m)]


def turning_outline(
    solids: Sequence[Float[np.ndarray, "points 3"]],
    camera_to_world: Float[np.ndarray, "4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
) -> Bool[np.ndarray, "h w"]:
    """Pixels that show convex solids, given by points whose hulls they are (metres, all before the camera)."""
    outline = np.zeros((intrinsics.h, intrinsics.w), np.uint8)
    to_camera = np.linalg.inv(camera_to_world @ OPENCV_TO_OPENGL)
    for points in solids:
        in_camera = points @ to_camera[:3, :3].T + to_camera[:3, 3]
        pixels, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), intrinsics.matrix(), distortion)
        # OpenCV draws in coordinates whose origin is the first pixel's centre.
        cv2.fillConvexPoly(outline, cv2.convexHull(np.rint(pixels[:, 0] - 0.5).astype(np.int32)), 1)
    return outline > 0


def median_over_frames(
    counts: UInt16[np.ndarray, "frames *cells bands"], free: Bool[np.ndarray, "frames *cells"], least: int
) -> tuple[Float[np.ndarray, "*cells bands"], Float[np.ndarray, "*cells bands"]]:
    """Median reflectance of packed numbers over the frames, and the variance that noise gives it; nan without either.

    Args:
        counts: packed reflectance; ``FLAGGED`` counts nowhere.
        free: where it shows the chamber.
        least: a median needs so many frames.

    Returns:
        Medians, and their variances by the median absolute deviation over the frames (0 for a single frame).
    """
    values = np.where(free[..., None] & (counts != FLAGGED), counts, np.inf).astype(np.float32)
    number = np.isfinite(values).sum(axis=0)
    number[number < least] = 0
    median = _median(values, number)
    with np.errstate(invalid="ignore"):
        # Of an unmeasured value the distance is infinite, and of no median not a number: both sort to the end.
        distance = np.abs(values - median)
    spread = _SPREAD_OF_MAD * _median(distance, number) / REFLECTANCE_SCALE
    return median / REFLECTANCE_SCALE, _MEDIAN_VARIANCE * spread**2 / np.maximum(number, 1)


def quieten(
    image: Float[np.ndarray, "lines samples bands"], variance: Float[np.ndarray, "lines samples bands"], window: int
) -> Float[np.ndarray, "lines samples bands"]:
    """Average neighbours that differ no more than noise would have them: a local Wiener filter, each band alone.

    J.-S. Lee, "Digital image enhancement and noise filtering by use of local statistics", IEEE TPAMI 2, 1980. Where
    the picture varies more than its noise it stays sharp; without noise it stays as it is. What is not measured (nan)
    counts nowhere and stays so.

    Args:
        image: a picture.
        variance: of its values' noise.
        window: side of the neighbourhood, cells, odd.
    """
    measured = np.isfinite(image)
    number = _window_sum(measured.astype(np.float32), window)

    def local_mean(values: Float[np.ndarray, "lines samples bands"]) -> Float[np.ndarray, "lines samples bands"]:
        return _window_sum(np.where(measured, values, 0.0), window) / np.maximum(number, 1.0)

    mean = local_mean(image)
    # About the mean of each band, which keeps single precision from cancelling.
    offset = np.where(measured, image, 0.0).sum(axis=(0, 1)) / np.maximum(measured.sum(axis=(0, 1)), 1)
    varies = local_mean((image - offset) ** 2) - (mean - offset) ** 2
    kept = np.maximum(1.0 - local_mean(variance) / np.maximum(varies, np.finfo(np.float32).tiny), 0.0)
    return np.where(measured, mean + kept * (image - mean), np.nan).astype(np.float32)


def fill_in(
    image: Float[np.ndarray, "lines samples bands"], spectrum: Float[np.ndarray, "bands"]
) -> Float[np.ndarray, "lines samples bands"]:
    """Fill what is not measured (nan) by the smoothest sheet spanned over it: Laplace's equation, each band alone.

    Every filled cell is the mean of its neighbours (of those there are at the image's border). A band that is
    measured nowhere gets its value of ``spectrum``.
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
    laplacian = _grid_laplacian(*image.shape[:2])
    for bands in map(np.array, bands_by_pattern.values()):
        unknown = missing[:, bands[0]]
        rows = laplacian[unknown]
        pull = rows[:, ~unknown] @ flat[np.ix_(~unknown, bands)].astype(float)
        flat[np.ix_(unknown, bands)] = splu(rows[:, unknown].tocsc()).solve(-pull)
    return filled


def _rims(radius_m: float, low_m: float, high_m: float, points: int = 64) -> Float[np.ndarray, "points 3"]:
    angle = 2.0 * np.pi * np.arange(points) / points
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.insert(circle, 2, height, axis=1) for height in (low_m, high_m)])


def _median(
    values: Float[np.ndarray, "frames *shape"], number: Int[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Median of the ``number`` smallest values; nan of none."""
    ordered = np.sort(values, axis=0)
    middle = [np.take_along_axis(ordered, np.maximum(number - odd, 0)[None] // 2, axis=0)[0] for odd in (0, 1)]
    # The upper middle of an even number, twice that of an odd one.
    return np.where(number > 0, 0.5 * (middle[0] + middle[1]), np.nan)


def _window_sum(values: Float[np.ndarray, "lines samples bands"], window: int) -> Float[np.ndarray, "..."]:
    means = ndimage.uniform_filter(values, (window, window, 1), mode="constant")
    return means * np.float32(window**2)


def _grid_laplacian(lines: int, samples: int) -> sparse.csr_array:
    """Number of neighbours minus the neighbours' sum, for the cells of a grid, line by line."""

    def chain(length: int) -> sparse.dia_array:
        degree = np.full(length, 2.0)
        degree[[0, -1]] -= 1.0
        return sparse.diags_array([degree, *[np.full(length - 1, -1.0)] * 2], offsets=[0, 1, -1])

    return sparse.csr_array(
        sparse.kron(chain(lines), sparse.eye_array(samples)) + sparse.kron(sparse.eye_array(lines), chain(samples))
    )
