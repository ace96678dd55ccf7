"""Where the scene may hold matter, and how dense it is there: an occupancy grid that begins as the visual hull.

Masks and poses bound the object before training (VaxNeRF, Kondo et al. 2021), and what turns with it lies under it.
Cells beyond are empty for good. In the others the field's density is followed while it is learned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_erosion, binary_fill_holes
from torch import Tensor, nn

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, project
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.processing.visual_hull import MAX_MISSED_FRACTION, visual_hull

GRID_CELLS = 128
"""Cells along the longest side of the scene box."""
HULL_MARGIN_M = 0.003
"""Cells within this of the hull may hold matter: masks and poses are uncertain by a pixel or two."""
MISSED_FRACTION = 0.2
"""Frames whose masks may miss a point that may hold matter. A stem of one pixel is missed in a tenth of the masks; a
looser bound costs samples, a tighter one the stem."""
REFRESH_EVERY, REFRESH_PARTS = 8, 4
"""After so many steps, the field's density is evaluated in one of so many parts of the cells."""
FULL_REFRESHES = 4
"""A new field is evaluated so often in each cell, by when the average has forgotten what it began with."""
LEARNED = 0.5
"""Weight of a new opacity of a cell, in a moving average: a cell is as opaque as its points are on average, so that
one dense point does not hide what lies behind the cell."""


class OccupancyGrid(nn.Module):
    """Opacities of the cells of a grid over the scene box, -1 where there is no matter.

    Args:
        aabb: scene box, scene units.
        matter: cells that may hold matter; cells are cubes, counted from the box's lower corner.

    Example:
        >>> shape, cell = grid_over(aabb)
        >>> grid = OccupancyGrid(aabb, matter, solid)
        >>> grid.refresh_all(field.density_fn)
    """

    opacity: Tensor
    lower: Tensor
    _candidates: Tensor
    _solid: Tensor

    def __init__(
        self, aabb: Float[Tensor, "2 3"], matter: Bool[Tensor, "x y z"], solid: Bool[Tensor, "x y z"]
    ) -> None:
        super().__init__()
        self.cell = grid_over(aabb)[1]
        self.register_buffer("lower", aabb[0].clone())
        self.register_buffer("opacity", matter.float() - 1.0)
        self.register_buffer("_candidates", matter.flatten().nonzero()[:, 0], persistent=False)
        self.register_buffer("_solid", solid.flatten()[self._candidates], persistent=False)

    def random_points(self, count: int) -> tuple[Float[Tensor, "count 3"], Bool[Tensor, "count"]]:
        """Points in cells that may hold matter, and whether they are in solid ones."""
        chosen = torch.randint(len(self._candidates), (count,), device=self._candidates.device)
        return self._points_in(self._candidates[chosen]), self._solid[chosen]

    def _points_in(self, cells: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """A random point in each cell."""
        _, y, z = self.opacity.shape
        corners = torch.stack([cells // (y * z), cells // z % y, cells % z], dim=-1)
        return self.lower + (corners + torch.rand(corners.shape, device=cells.device)) * self.cell

    def clear(self, cells: Bool[Tensor, "x y z"]) -> None:
        """Leave no matter in these cells, for good."""
        self.opacity[cells] = -1.0

    @torch.no_grad()
    def refresh(
        self,
        density_fn: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 1"]],
        step: int,
        rise_length: Float[Tensor, ""] | float = 0.0,
    ) -> None:
        """Ask for the field's density at a random point of some of the cells, others at each step.

        Args:
            density_fn: density at points.
            step: of training.
            rise_length: as in `opaque_density`; a ray has met the whole density of a cell after its rise.
        """
        if step % REFRESH_EVERY == 0:
            self._refresh_part(density_fn, step // REFRESH_EVERY % REFRESH_PARTS, self.cell + rise_length)

    @torch.no_grad()
    def refresh_all(self, density_fn: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 1"]]) -> None:
        """Take over the field's density in all cells."""
        for _ in range(FULL_REFRESHES):
            for part in range(REFRESH_PARTS):
                self._refresh_part(density_fn, part, self.cell)

    def _refresh_part(
        self,
        density_fn: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 1"]],
        part: int,
        length: Float[Tensor, ""] | float,
    ) -> None:
        cells = self._candidates[part::REFRESH_PARTS]
        density = density_fn(self._points_in(cells))[:, 0].to(self.opacity)
        flat = self.opacity.view(-1)
        known = flat[cells]  # -1 where `clear` left no matter
        flat[cells] = torch.where(known < 0.0, known, known + LEARNED * (1.0 - torch.exp(-length * density) - known))


def grid_over(aabb: Float[Tensor, "2 3"] | Float[np.ndarray, "2 3"]) -> tuple[tuple[int, int, int], float]:
    """Shape of the grid over a box, and the side of its cells in the box's unit."""
    sides = (aabb[1] - aabb[0]).tolist()
    cell = max(sides) / GRID_CELLS
    x, y, z = (int(np.ceil(side / cell - 1e-4)) for side in sides)
    return (x, y, z), cell


def bounds_from_masks(
    dataset: PackedDataset,
    frames: Sequence[PackedFrame],
    shape: tuple[int, int, int],
    lower_m: Float[np.ndarray, "3"],
    cell_m: float,
) -> tuple[Bool[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
    """Cells of a grid that may hold matter, and those of them that are taken to be solid until training knows better.

    The former are the visual hull with a margin, and all that is lower than the object. The latter are the hull, the
    container, and the disc under it. A fifth of the frames may contradict the former hull, few the latter. If the
    masks leave none, all cells may hold matter, and none is solid.
    """
    centres_m = lower_m + (np.indices(shape).reshape(3, -1).T + 0.5) * cell_m
    low_m, high_m = dataset.object_box_m
    low_m, high_m = low_m - HULL_MARGIN_M, high_m + HULL_MARGIN_M
    in_box = ((centres_m > low_m) & (centres_m < high_m)).all(axis=1)
    poses = np.stack([frame.camera_to_world for frame in frames])
    distance_m = np.linalg.norm(poses[:, :3, 3] - (low_m + high_m) / 2.0, axis=1).min()
    masks = np.stack([frame.mask() for frame in frames])
    # By half a cell's diagonal more, so that parts thinner than a cell are kept.
    margin_px = dataset.intrinsics.fl_x * (HULL_MARGIN_M + 0.87 * cell_m) / distance_m
    widened = np.stack([dilate(mask, 2 * int(np.ceil(margin_px)) + 1) for mask in masks])

    def hull(silhouettes: Bool[np.ndarray, "frames h w"], missed_fraction: float) -> Bool[np.ndarray, "x y z"]:
        cells = np.zeros(shape, bool)
        points_m = visual_hull(centres_m[in_box], silhouettes, poses, dataset.intrinsics, missed_fraction)
        cells[tuple(np.floor((points_m - lower_m) / cell_m).astype(int).T)] = True
        return cells

    matter = hull(widened, MISSED_FRACTION)
    if not masks.any() or not matter.any():
        return np.ones(shape, bool), np.zeros(shape, bool)
    solid = hull(masks, MAX_MISSED_FRACTION)
    from_axis_m, z_m = np.hypot(centres_m[:, 0], centres_m[:, 1]), centres_m[:, 2]
    below = z_m < low_m[2] + 2.0 * HULL_MARGIN_M
    if dataset.container is not None:
        radius_m, height_m = dataset.container.diameter_m / 2.0, dataset.container.height_m
        below &= (from_axis_m < radius_m + HULL_MARGIN_M) & (z_m < height_m + 0.5 * cell_m) | (z_m < HULL_MARGIN_M)
        solid |= ((from_axis_m < radius_m) & (z_m < height_m) | (z_m < 0.0)).reshape(shape)
    matter |= below.reshape(shape)
    return matter, solid & matter


def pixels_of_cells(
    cells: Bool[np.ndarray, "x y z"],
    lower_m: Float[np.ndarray, "3"],
    cell_m: float,
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
) -> Bool[np.ndarray, "frames h w"]:
    """Pixels of each frame that look at some of the cells, and a few beside them; lens distortion is neglected."""
    surface = cells & ~binary_erosion(cells)
    centres_m = lower_m + (np.argwhere(surface) + 0.5) * cell_m
    seen = np.zeros((len(camera_to_worlds), intrinsics.h, intrinsics.w), bool)
    for pixels, pose in zip(seen, camera_to_worlds, strict=True):
        centres_px, depth_m = project(centres_m, pose, intrinsics)
        x, y = np.floor(centres_px).astype(int).T
        inside = (depth_m > 0.0) & (x >= 0) & (x < intrinsics.w) & (y >= 0) & (y < intrinsics.h)
        pixels[y[inside], x[inside]] = True
        cell_px = intrinsics.fl_x * 1.8 * cell_m / depth_m.min()
        pixels[:] = binary_fill_holes(dilate(pixels, 2 * int(np.ceil(cell_px)) + 3))
    return seen
