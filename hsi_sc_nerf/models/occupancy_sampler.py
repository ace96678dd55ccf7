"""nerfstudio's sampler by an occupancy grid, in the place of proposal networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import Sampler
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.fields.occupancy_grid import (
    OccupancyGrid,
    bounds_from_masks,
    grid_over,
    pixels_of_cells,
)
from hsi_sc_nerf.fields.ray_marching import sample_occupied
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame


class OccupancySampler(Sampler):
    """Samples where the grid holds matter; it has the call of nerfstudio's `ProposalNetworkSampler`.

    Args:
        grid: over the scene box.
        num_samples: samples a ray.
        every_ray: sample rays that meet no matter as well, as where something is done for each ray.

    Attributes:
        samples_in_training: samples a ray while it trains, if fewer do for the stage.
        rays: of the last call, the indices of the rays that were sampled: those that meet matter. None for all.
    """

    samples_in_training: int | None
    rays: Int[Tensor, "sampled"] | None

    def __init__(self, grid: OccupancyGrid, num_samples: int, every_ray: bool = False) -> None:
        super().__init__(num_samples)
        self.grid, self.every_ray = grid, every_ray
        self.samples_in_training = self.rays = None

    def generate_ray_samples(  # type: ignore[override]
        self, ray_bundle: RayBundle, density_fns: Sequence[object] = ()
    ) -> tuple[RaySamples, list, list]:
        """Samples of the rays that meet matter, and nothing for the proposals that there are not.

        Samples are not jittered: what a soft outline renders would scatter with them (docs/notes/dead_ends.md). On a
        GPU all rays are sampled, so that shapes do not depend on the data.
        """
        assert ray_bundle.nears is not None
        assert ray_bundle.fars is not None
        assert self.num_samples is not None
        count = self.num_samples
        if self.training and self.samples_in_training is not None:
            count = min(count, self.samples_in_training)
        device = ray_bundle.origins.device
        with torch.no_grad():
            nears, fars = ray_bundle.nears[:, 0], ray_bundle.fars[:, 0]
            rays, grid = (ray_bundle.origins, ray_bundle.directions, nears, fars), self.grid
            starts, ends = sample_occupied(*rays, grid.opacity, grid.lower, grid.cell, count)
        self.rays = None
        if device.type == "cpu" and not self.every_ray:
            met = (ends[:, -1] > nears).nonzero()[:, 0]
            # One ray with samples of no length keeps the shapes of what follows where none meets matter.
            self.rays = met if len(met) else met.new_zeros(1)
            ray_bundle, starts, ends = ray_bundle[self.rays], starts[self.rays], ends[self.rays]
        return ray_bundle.get_ray_samples(bin_starts=starts[..., None], bin_ends=ends[..., None]), [], []

    def of_all_rays(self, outputs: dict[str, Any], rays: RayBundle) -> dict[str, Any]:
        """Outputs of all rays from those of the sampled ones; what meets nothing is as far away as rays reach."""
        if self.rays is None:
            return outputs
        fills: dict[str, Any] = {"depth": rays.fars, "expected_depth": rays.fars}
        return outputs | {
            name: fills.get(name, value.new_zeros(len(rays), *value.shape[1:])).index_copy(0, self.rays, value)
            for name, value in outputs.items()
            if isinstance(value, Tensor)
        }


def build_occupancy(
    dataset: PackedDataset, frames: Sequence[PackedFrame], aabb: Float[Tensor, "2 3"], from_checkpoint: bool = False
) -> OccupancyGrid:
    """The occupancy grid of a dataset.

    Args:
        dataset: camera, container, and the boxes of the scene and of the object.
        frames: whose masks bound the object.
        aabb: the scene box in scene units.
        from_checkpoint: a checkpoint replaces the opacities; the masks are not looked at, and all may hold matter.

    Raises:
        InputError: the scene is not the dataset's box.
    """
    low_m, high_m = dataset.scene_box_m
    sides, sides_m = np.ptp(aabb.numpy(force=True), axis=0), high_m - low_m
    if not np.allclose(sides / sides.max(), sides_m / sides_m.max(), atol=1e-3):
        raise InputError(
            "the data parser's --scene cameras is no box of what turns, which the occupancy grid needs; take "
            "--pipeline.model.num-proposal-iterations 2 and --pipeline.model.disable-scene-contraction False with it."
        )
    shape, _ = grid_over(aabb)
    if from_checkpoint:
        return OccupancyGrid(aabb, torch.ones(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.bool))
    matter, solid = bounds_from_masks(dataset, frames, shape, low_m, grid_over(dataset.scene_box_m)[1])
    return OccupancyGrid(aabb, torch.from_numpy(matter), torch.from_numpy(solid))


def pixels_with_matter(
    grid: OccupancyGrid, dataset: PackedDataset, frames: Sequence[PackedFrame]
) -> Bool[np.ndarray, "frames h w"]:
    """The pixels of the frames that look at cells that may hold matter: background rays elsewhere meet nothing."""
    matter = (grid.opacity >= 0.0).numpy(force=True)
    poses = np.stack([frame.camera_to_world for frame in frames])
    _, cell_m = grid_over(dataset.scene_box_m)
    return pixels_of_cells(matter, dataset.scene_box_m[0], cell_m, poses, dataset.intrinsics)
