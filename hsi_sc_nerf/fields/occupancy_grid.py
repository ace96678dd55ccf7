"""Where the scene may hold matter, and how dense it is there: an occupancy grid that begins as the visual hull.

Masks and poses bound the object before training (VaxNeRF, Kondo et al. 2021), and what turns with it lies under it.
Cells beyond are empty for good. In the others the field's density is followed while it is learned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hsi_sc_nerf.fields.ray_marching import cell_of, sample_occupied
from hsi_sc_nerf.geometry.visual_hull import visual_hull
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame

GRID_CELLS = 128
"""Cells along the longest side of the scene box."""
HULL_MARGIN_M = 0.003
"""Cells within this of the hull may hold matter: masks and poses are uncertain by a pixel or two."""
REFRESH_EVERY = 8
"""The field's density is asked for after so many steps, each time in this part of the cells."""
DECAY = 0.6
"""What is left of a cell's density when the field has less of it: one sample that misses a thin surface must not
remove it."""


class OccupancyGrid(nn.Module):
    """Densities of the cells of a grid over the scene box, -1 where there is no matter.

    Args:
        aabb: scene box, scene units.
        matter: cells that may hold matter; cells are cubes, counted from the box's lower corner.

    Example:
        >>> shape, cell = grid_over(aabb)
        >>> grid = OccupancyGrid(aabb, torch.ones(shape, dtype=torch.bool))
        >>> starts, ends = grid.sample(origins, directions, nears, fars, num_samples=16, jitter=torch.rand(1024))
    """

    density: Tensor
    lower: Tensor
    _candidates: Tensor

    def __init__(self, aabb: Float[Tensor, "2 3"], matter: Bool[Tensor, "x y z"]) -> None:
        super().__init__()
        self.cell = grid_over(aabb)[1]
        self.register_buffer("lower", aabb[0].clone())
        self.register_buffer("density", matter.float() - 1.0)
        self.register_buffer("_candidates", matter.flatten().nonzero()[:, 0], persistent=False)

    def sample(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        nears: Float[Tensor, "rays"],
        fars: Float[Tensor, "rays"],
        num_samples: int,
        jitter: Float[Tensor, "rays"],
    ) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples"]]:
        """Starts and ends of samples along rays; see `sample_occupied`."""
        return sample_occupied(
            origins, directions, nears, fars, self.density, self.lower, self.cell, num_samples, jitter
        )

    @torch.no_grad()
    def refresh(self, density_fn: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 1"]], step: int) -> None:
        """Ask for the field's density at a random point of some of the cells, others at each step."""
        if step % REFRESH_EVERY:
            return
        cells = self._candidates[step // REFRESH_EVERY % REFRESH_EVERY :: REFRESH_EVERY]
        _, y, z = self.density.shape
        corners = torch.stack([cells // (y * z), cells // z % y, cells % z], dim=-1)
        points = self.lower + (corners + torch.rand(corners.shape, device=cells.device)) * self.cell
        flat = self.density.view(-1)
        flat[cells] = torch.maximum(DECAY * flat[cells], density_fn(points)[:, 0].to(flat))

    @torch.no_grad()
    def note(self, points: Float[Tensor, "*n 3"], densities: Float[Tensor, "*n 1"]) -> None:
        """Raise the cells' densities to those at points inside them, which were computed for a step of training."""
        cells, inside = cell_of(points, self.density.shape, self.lower, self.cell)
        flat = self.density.view(-1)
        cells = cells.flatten()
        kept = inside.flatten() & (flat[cells] >= 0.0)
        flat.scatter_reduce_(0, cells, torch.where(kept, densities.flatten().to(flat), -1.0), "amax")


def grid_over(aabb: Float[Tensor, "2 3"]) -> tuple[tuple[int, int, int], float]:
    """Shape of the grid over a box, and the side of its cells in the box's unit."""
    sides = (aabb[1] - aabb[0]).tolist()
    cell = max(sides) / GRID_CELLS
    x, y, z = (int(np.ceil(side / cell - 1e-4)) for side in sides)
    return (x, y, z), cell


def matter_around_hull(
    dataset: PackedDataset,
    frames: Sequence[PackedFrame],
    shape: tuple[int, int, int],
    lower_m: Float[np.ndarray, "3"],
    cell_m: float,
) -> Bool[np.ndarray, "x y z"]:
    """Cells of a grid that may hold matter: the visual hull with a margin, and all that is lower than the object.

    A few frames may contradict the hull (`visual_hull`). If the masks leave none, all cells may hold matter.

    Args:
        dataset: camera, and the object's box.
        frames: whose masks are used.
        shape: cells along each axis.
        lower_m: corner of the grid, object frame.
        cell_m: side of a cell.
    """
    centres_m = lower_m + (np.indices(shape).reshape(3, -1).T + 0.5) * cell_m
    low_m, high_m = dataset.object_box_m
    low_m, high_m = low_m - HULL_MARGIN_M, high_m + HULL_MARGIN_M
    poses = np.stack([frame.camera_to_world for frame in frames])
    distance_m = np.linalg.norm(poses[:, :3, 3] - (low_m + high_m) / 2.0, axis=1).min()
    # By half a cell's diagonal more, so that parts thinner than a cell are kept.
    margin_px = dataset.intrinsics.fl_x * (HULL_MARGIN_M + 0.87 * cell_m) / distance_m
    masks = np.stack([dilate(frame.mask(), 2 * int(np.ceil(margin_px)) + 1) for frame in frames])
    in_box = centres_m[((centres_m > low_m) & (centres_m < high_m)).all(axis=1)]
    hull_m = visual_hull(in_box, masks, poses, dataset.intrinsics)
    if not len(hull_m) or not any(frame.mask().any() for frame in frames):
        return np.ones(shape, bool)
    matter = (centres_m[:, 2] < low_m[2] + 2.0 * HULL_MARGIN_M).reshape(shape)
    matter[tuple(np.floor((hull_m - lower_m) / cell_m).astype(int).T)] = True
    return matter
