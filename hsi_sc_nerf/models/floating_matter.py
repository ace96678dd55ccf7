"""Matter that hangs in the air, apart from all else, and without which the measured pixels are met as well.

Masks do not show a hollow, so training begins with the cap that the visual hull has over it. Most of the cap goes
while spectra are learned. What is left of it hangs over the hollow, and is opaque, so that nothing thins it: no ray
shows what was learned behind it. Nothing hangs in the air, so such pieces are left out unless the pixels object: a
thin part, such as the end of a stem, may touch the rest by what is not opaque enough to be seen.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.evaluation.spectral_metrics import squared_error_map
from hsi_sc_nerf.fields.occupancy_grid import HULL_MARGIN_M, grid_over
from hsi_sc_nerf.geometry.camera import pixels_of
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame

_NEIGHBOURS = np.ones((3, 3, 3), bool)
CLEAR_EVERY = 100
"""Steps of training between two searches."""
MIN_OPACITY = 0.1
"""Cells of this opacity hold a piece together, also by an edge or a corner: thin parts are hardly opaque."""
FEWEST_CELLS, LARGEST_PART = 8, 0.01
"""A piece that hangs in the air has so many cells at least, and fewer than this part of the largest piece. What is
smaller is a speck of the soft surface."""
MOST_PIECES = 4
"""Pieces that are tried in a search, the largest first."""
PIXELS = 512
"""Pixels that judge a piece."""
CLEARLY = 2.0
"""Pixels are clearly met worse if the mean rise of their squared errors exceeds so many of its standard errors."""


@torch.no_grad()
def clear_floating_matter(model: SpectralModel, manager: SpectralDataManager, step: int) -> int:
    """Clear floating pieces of a model's occupancy grid for good, but for those that the training pixels ask for.

    Args:
        model: with an occupancy grid.
        manager: of the training frames.
        step: of training; the pixels are drawn by it.

    Returns:
        Number of pieces that were cleared.
    """
    grid, cleared = model.occupancy, 0
    assert grid is not None
    for piece, cells in floating_pieces(grid.opacity.numpy(force=True), lowest_in_the_air(manager)):
        pixels = pixels_that_look_at(piece, manager, step)
        if len(pixels):
            before = grid.opacity.clone()
            _, rises = clear_and_compare(model, manager, torch.from_numpy(cells).to(before.device), pixels)
            if rises.mean() > CLEARLY * rises.std(correction=0) / len(rises) ** 0.5:
                grid.opacity.copy_(before)
            else:
                cleared += 1
    return cleared


def floating_pieces(
    opacity: Float[np.ndarray, "x y z"], lowest: int
) -> list[tuple[Bool[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]]:
    """The largest connected pieces of a grid that hang in the air, each without and with the cells around it.

    Args:
        opacity: of the cells; below 0 where there is no matter.
        lowest: pieces with a cell below this one along z may stand on the support.

    Example:
        >>> [(piece.sum(), cells.sum()) for piece, cells in floating_pieces(grid.opacity.numpy(), lowest=45)]
        [(28, 180)]
    """
    pieces, _ = ndimage.label(opacity > MIN_OPACITY, structure=_NEIGHBOURS)
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0  # what is too thin
    bounds = ndimage.find_objects(pieces)
    small = [number for number in np.argsort(-sizes) if FEWEST_CELLS <= sizes[number] < LARGEST_PART * sizes.max()]
    found = []
    for number in [number for number in small if bounds[number - 1][2].start >= lowest][:MOST_PIECES]:
        piece = pieces == number
        around = ndimage.binary_dilation(piece, structure=_NEIGHBOURS)
        found.append((piece, around & (piece | (pieces == 0)) & (opacity >= 0.0)))
    return found


def lowest_in_the_air(manager: SpectralDataManager) -> int:
    """The lowest layer of the occupancy grid that lies wholly over what the object stands on."""
    dataset: PackedDataset = manager.train_dataparser_outputs.metadata["dataset"]
    above_base_m = dataset.object_box_m[0, 2] + HULL_MARGIN_M - dataset.scene_box_m[0, 2]
    return int(np.ceil(above_base_m / grid_over(dataset.scene_box_m)[1]))


def pixels_that_look_at(
    cells: Bool[np.ndarray, "x y z"], manager: SpectralDataManager, step: int
) -> Int[np.ndarray, "at_most_pixels 3"]:
    """Random training pixels (frame, line, sample) that look at cells; lens distortion is neglected."""
    metadata = manager.train_dataparser_outputs.metadata
    dataset: PackedDataset = metadata["dataset"]
    frames: list[PackedFrame] = metadata["frames"]
    rng = np.random.default_rng(step)
    indices = rng.permutation(np.argwhere(cells))
    indices = np.resize(indices, (PIXELS, 3))  # again from the first where there are fewer
    _, cell_m = grid_over(dataset.scene_box_m)
    points_m = dataset.scene_box_m[0] + (indices + rng.random(indices.shape)) * cell_m
    of_point = rng.integers(len(frames), size=PIXELS)
    pixels = []
    for index in np.unique(of_point):
        inside, xy_px = pixels_of(points_m[of_point == index], frames[index].camera_to_world, dataset.intrinsics)
        pixels.append(np.insert(xy_px[inside, ::-1], 0, index, axis=1))
    return np.concatenate(pixels)


def clear_and_compare(
    model: SpectralModel,
    manager: SpectralDataManager,
    cells: Bool[torch.Tensor, "x y z"],
    pixels: Int[np.ndarray, "count 3"],
) -> tuple[Float[torch.Tensor, "count"], Float[torch.Tensor, "count"]]:
    """Clear cells of a model's occupancy grid.

    Returns:
        The squared errors of training pixels before, and by how much they rise.
    """
    grid = model.occupancy
    assert grid is not None
    errors = _squared_errors(model, manager, pixels)
    grid.clear(cells)
    return errors, _squared_errors(model, manager, pixels) - errors


def _squared_errors(
    model: SpectralModel, manager: SpectralDataManager, pixels: Int[np.ndarray, "count 3"]
) -> Float[torch.Tensor, "count"]:
    """Squared error of each training pixel's rendered reflectance, mean over its measured bands; 0 without any."""
    rays, batch = manager.training_pixels(pixels)
    training = model.training
    spectral = model.eval()(rays)["spectral"]
    model.train(training)
    valid = batch["valid"][None].to(spectral.device) if "valid" in batch else None
    # The pixels are an image of a single line.
    return squared_error_map(spectral[None], batch["spectral"][None].to(spectral), valid)[0].nan_to_num()
