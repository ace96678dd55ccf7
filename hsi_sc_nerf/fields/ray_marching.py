"""Samples along rays, only where a grid says that there may be matter.

Instant-NGP (Müller et al. 2022, section "Occupancy grids") steps over empty cells. Here the cells' densities are used
as well: they give each stretch of a ray the weight with which it will be seen, and samples are drawn by these weights
as mip-NeRF 360 (Barron et al. 2022) does with its proposal networks, but without a network.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

EXPLORED = 0.25
"""Weight of samples that are spread over all cells with matter, beside at most 1 for what the ray sees. With 0.1, a
surface that the grid does not have yet is found too late."""
MAX_OPACITY = 0.95
"""Most that a cell hides of what lies behind it: where it is not as opaque as the grid says, that has to be seen."""


def sample_occupied(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    nears: Float[Tensor, "rays"],
    fars: Float[Tensor, "rays"],
    opacity: Float[Tensor, "x y z"],
    lower: Float[Tensor, "3"],
    cell: float,
    num_samples: int,
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples"]]:
    """Starts and ends of the samples along each ray, as distances from its origin.

    Samples are in order and do not overlap; between them lies what holds no matter. The first and the last half of a
    sample's weight have none: what is first is empty, what is last is hidden, and long samples there would blur the
    surface (docs/notes/dead_ends.md). A ray that meets no cell with
    matter has samples of length 0. Gradients are not carried.

    Args:
        opacity: opacity of the cells along a side, in [0, 1]; below 0 where there is no matter.
    """
    if origins.device.type == "cpu":
        from hsi_sc_nerf.fields import ray_marching_cpu  # compiles; a GPU does without it

        rays = [tensor.numpy(force=True) for tensor in (origins, directions, nears, fars)]
        grid = opacity.numpy(force=True), lower.numpy(force=True), cell
        starts, ends = ray_marching_cpu.sample_occupied(rays, grid, num_samples, EXPLORED, MAX_OPACITY)
        return torch.from_numpy(starts), torch.from_numpy(ends)
    with torch.no_grad():
        return sample_with_tensors(origins, directions, nears, fars, opacity, lower, cell, num_samples)


def sample_with_tensors(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    nears: Float[Tensor, "rays"],
    fars: Float[Tensor, "rays"],
    opacity: Float[Tensor, "x y z"],
    lower: Float[Tensor, "3"],
    cell: float,
    num_samples: int,
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples"]]:
    """`sample_occupied` as tensor operations of fixed shapes, for a GPU."""
    steps = march_steps(opacity.shape)
    index = torch.arange(steps, device=origins.device)
    middles = nears[:, None] + (index + 0.5) * cell
    points = origins[:, None] + directions[:, None] * middles[..., None]
    cells, inside = cell_of(points, opacity.shape, lower, cell)
    along = opacity.view(-1)[cells]
    matter = inside & (along >= 0.0) & (middles < fars[:, None])
    through = 1.0 - torch.where(matter, along, 0.0).clamp_max(MAX_OPACITY)
    transmittance = torch.cumprod(through, dim=1)
    before = torch.nn.functional.pad(transmittance[:, :-1], (1, 0), value=1.0)
    weights = torch.where(matter, before - transmittance, 0.0)
    # A surface may have moved by a cell since the grid was brought up to date.
    widened = torch.nn.functional.max_pool1d(weights[:, None], 3, stride=1, padding=1)[:, 0]
    count = matter.sum(dim=1, keepdim=True).clamp_min(1)
    weights = torch.where(matter, widened + EXPLORED / count, 0.0)

    # Stretches of cells with matter, of which no sample leaves the one that its middle is in.
    outside = torch.where(matter, -1, index)
    first = torch.cummax(outside, dim=1).values + 1
    last = steps - torch.cummax(torch.where(matter, -1, steps - 1 - index).flip(1), dim=1).values.flip(1) - 1

    cumulated = torch.cumsum(weights, dim=1)
    total = cumulated[:, -1:]
    sample = torch.arange(num_samples, device=origins.device).expand(len(origins), -1)

    def at(quantile: Tensor) -> tuple[Tensor, Tensor]:
        level = (quantile + 0.5) / (num_samples + 1) * total
        steps_there = torch.searchsorted(cumulated, level, right=True).clamp_max(steps - 1)
        weight = weights.gather(1, steps_there)
        passed = cumulated.gather(1, steps_there) - weight
        fraction = ((level - passed) / weight.clamp_min(1e-20)).clamp(0.0, 1.0)
        return nears[:, None] + (steps_there + fraction) * cell, steps_there

    middle = at(sample + 0.5)[1]
    starts = torch.maximum(at(sample)[0], nears[:, None] + first.gather(1, middle) * cell)
    ends = torch.minimum(at(sample + 1.0)[0], nears[:, None] + last.gather(1, middle) * cell)
    met = total > 0.0
    return torch.where(met, starts, nears[:, None]), torch.where(met, ends, nears[:, None])


def march_steps(shape: Sequence[int]) -> int:
    """Steps of one cell that cross a grid of this shape along its diagonal."""
    return int(sum(side**2 for side in shape) ** 0.5) + 2


def cell_of(
    points: Float[Tensor, "*n 3"], shape: Sequence[int], lower: Float[Tensor, "3"], cell: float
) -> tuple[Int[Tensor, "*n"], Bool[Tensor, "*n"]]:
    """Number of the cell that holds each point, and whether it lies in the grid; beside it, that of a cell nearby."""
    indices = torch.floor((points - lower) / cell).long()
    inside = torch.ones_like(indices[..., 0], dtype=torch.bool)
    flat = torch.zeros_like(indices[..., 0])
    for axis, side in enumerate(shape):
        along = indices[..., axis]
        inside = inside & (along >= 0) & (along < side)
        flat = flat * side + along.clamp(0, side - 1)
    return flat, inside
