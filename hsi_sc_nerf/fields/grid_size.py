"""How fine a hash grid has to be for what the camera resolves."""

from __future__ import annotations

import math
from dataclasses import dataclass

CELLS_PER_PIXEL = 2.0
"""Cells along what one pixel covers at the object. Four resolve more, but a step costs a fifth more time, in which
two come as far (docs/accuracy_and_time.md)."""
COARSEST_GRID = 16
"""Cells along the scene box in the first level, nerfacto's."""
LEVEL_GROWTH = 1.38
"""From level to level a grid becomes finer by this factor, the smallest that Müller et al. 2022 use."""
LOG2_TABLE_RANGE = (14, 19)
"""Smallest and largest hash table of a level; 19 is nerfacto's."""


@dataclass(frozen=True)
class GridSize:
    """Of the spectral field's hash grid.

    Attributes:
        finest: cells along the scene box in the last level.
        levels: number of levels.
        log2_table: logarithm of the rows of a level's table.
    """

    finest: int
    levels: int
    log2_table: int


def grid_for_resolution(box_side_m: float, pixel_footprint_m: float) -> GridSize:
    """Grid of a scene box for a camera.

    The finest level has `CELLS_PER_PIXEL` cells a pixel. Levels are as many as its growth needs. A table has a row
    for every second cell that a plane through the box would cut: surfaces fill a grid like planes, not like solids.

    Args:
        box_side_m: longest side of the box.
        pixel_footprint_m: what one pixel covers at the object.

    Raises:
        ValueError: a length is not above 0.
    """
    if not (box_side_m > 0.0 and pixel_footprint_m > 0.0):
        raise ValueError(f"a box of {box_side_m} m and a footprint of {pixel_footprint_m} m are not both above 0")
    finest = max(2 * COARSEST_GRID, math.ceil(CELLS_PER_PIXEL * box_side_m / pixel_footprint_m))
    levels = 1 + math.ceil(math.log(finest / COARSEST_GRID) / math.log(LEVEL_GROWTH))
    smallest, largest = LOG2_TABLE_RANGE
    return GridSize(finest, levels, min(max(math.ceil(math.log2(finest**2 / 2.0)), smallest), largest))
