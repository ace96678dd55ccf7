"""How fine the hash grid of the spectral field is: as fine as what the camera resolves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hsi_sc_nerf.packed.dataset import PackedDataset

CELLS_PER_PIXEL = 2.0
"""Cells along what one pixel covers at the object. Four resolve more, but gain nothing at equal time
(docs/dead_ends.md)."""
COARSEST_GRID = 16
"""Cells along the scene box in the first level, nerfacto's."""
LEVEL_GROWTH = 1.38
"""Factor from level to level, the smallest that Müller et al. 2022 use."""
LOG2_TABLE_RANGE = (14, 19)
"""Smallest and largest hash table of a level; 19 is nerfacto's."""


@dataclass(frozen=True)
class GridSize:
    """Size of a hash grid.

    Attributes:
        finest: cells along the scene box in the last level.
        levels: number of levels.
        log2_table: logarithm of the rows of a level's table.
    """

    finest: int
    levels: int
    log2_table: int


def grid_for_dataset(dataset: PackedDataset) -> GridSize:
    """The grid that resolves in the scene box what the camera does."""
    box = dataset.scene_box_m
    distance_m = np.linalg.norm(dataset.camera_to_worlds[:, :3, 3] - box.mean(axis=0), axis=1).mean()
    return grid_for_resolution(float((box[1] - box[0]).max()), float(distance_m) / dataset.intrinsics.fl_x)


def grid_for_resolution(box_side_m: float, pixel_footprint_m: float) -> GridSize:
    """Grid of a scene box for a camera.

    The finest level has `CELLS_PER_PIXEL` cells a pixel; the number of levels follows from `LEVEL_GROWTH`. A table
    has a row for every second cell that a plane through the box cuts, since density lies on surfaces.

    Args:
        box_side_m: longest side of the box.
        pixel_footprint_m: what one pixel covers at the object.

    Raises:
        ValueError: a length is not above 0.

    Example:
        >>> grid_for_resolution(box_side_m=0.2, pixel_footprint_m=0.001)
        GridSize(finest=400, levels=11, log2_table=17)
    """
    if not (box_side_m > 0.0 and pixel_footprint_m > 0.0):
        raise ValueError(f"a box of {box_side_m} m and a footprint of {pixel_footprint_m} m are not both above 0")
    finest = max(2 * COARSEST_GRID, math.ceil(CELLS_PER_PIXEL * box_side_m / pixel_footprint_m))
    levels = 1 + math.ceil(math.log(finest / COARSEST_GRID) / math.log(LEVEL_GROWTH))
    smallest, largest = LOG2_TABLE_RANGE
    return GridSize(finest, levels, min(max(math.ceil(math.log2(finest**2 / 2.0)), smallest), largest))
