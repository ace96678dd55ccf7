"""Densities from which the surface is found, as rendered: nothing where the occupancy grid knows no matter."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.fields.ray_marching import cell_of
from hsi_sc_nerf.models.spectral_model import SpectralModel

OPAQUE = 5.0
"""Optical depth behind which nothing is asked for: less than a hundredth of the light is left."""
_STEPS_AT_ONCE = 5


@torch.no_grad()
def rendered_density(model: SpectralModel, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 1"]:
    """Density at points as it is rendered: 0 where the occupancy grid knows no matter."""
    return model.field.density_fn(points) * _may_hold_matter(model, points)[..., None]


@torch.no_grad()
def densities_along(
    model: SpectralModel,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    edges: Float[Tensor, "rays steps_and_1"],
) -> Float[Tensor, "rays steps"]:
    """Density in the middle of each step; 0 where the occupancy grid knows no matter, which is never rendered.

    Without a GPU, it is 0 as well behind an optical depth of ``OPAQUE``.

    Args:
        model: trained model, in evaluation mode.
        origins: of the rays.
        directions: unit vectors.
        edges: distances that bound the steps, ascending.
    """
    middles = (edges[:, 1:] + edges[:, :-1]) / 2.0
    points = origins[:, None] + directions[:, None] * middles[..., None]
    known = _may_hold_matter(model, points)
    if origins.device.type != "cpu":
        return model.field.density_fn(points)[..., 0] * known
    densities, lengths = torch.zeros_like(middles), edges.diff(dim=-1)
    depth = torch.zeros_like(middles[:, 0])
    for first in range(0, middles.shape[1], _STEPS_AT_ONCE):
        some = slice(first, first + _STEPS_AT_ONCE)
        asked = known[:, some] & (depth < OPAQUE)[:, None]
        found = torch.zeros_like(densities[:, some])
        if asked.any():
            found[asked] = model.field.density_fn(points[:, some][asked][:, None])[:, 0, 0]
        densities[:, some] = found
        depth += (found * lengths[:, some]).sum(dim=-1)
    return densities


def _may_hold_matter(model: SpectralModel, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
    """Whether the occupancy grid knows matter at points; everywhere, where there is none."""
    grid = model.occupancy
    if grid is None:
        return torch.ones_like(points[..., 0], dtype=torch.bool)
    cells, inside = cell_of(points, grid.opacity.shape, grid.lower, grid.cell)
    return inside & (grid.opacity.flatten()[cells] >= 0.0)
