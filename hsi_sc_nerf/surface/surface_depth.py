"""Rays through a trained model: the depth of the surface that they meet, and the object's spectrum along them.

Lengths are in scene units. Depths are distances from a ray's origin.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn import functional

from hsi_sc_nerf.fields.ray_marching import cell_of
from hsi_sc_nerf.fields.surface_opacity import opaque_density
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.numerics import safe_ratio

MIN_OPACITY = 0.5
"""Rays that collect less opacity than this hit no surface (released settings of the paper)."""
SURFACE_OPACITY = 0.07
"""Approximate opacity of a ray along the normal at the surface. The vertices of a cloud's mesh are afterwards moved
to the model's silhouettes (`silhouette_surface`)."""
INTERIOR_OPACITY = 0.25
"""Opacity at which the density gradient is read. Further out the gradient is noise."""
SEARCH_DEPTH = 0.1
"""The surface is searched within this distance of the given depth (about a centimetre)."""
SEARCH_STEPS = 40
MIN_COSINE = 0.17
"""Smallest cosine between a ray and the surface normal: pixels smear faces seen at more than 80 degrees."""
_MIN_RATIO_OPACITY = 1e-3
OPAQUE = 5.0
"""Optical depth behind which no density is evaluated: less than a hundredth of the light is left."""
_STEPS_AT_ONCE = 5


@torch.no_grad()
def surface_depth(
    model: SpectralModel,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    initial_depth: Float[Tensor, "n 1"],
    cosines: Float[Tensor, "n 1"] | None = None,
) -> tuple[Float[Tensor, "n 1"], Float[Tensor, "n 1"]]:
    """Depth of the surface along rays, searched in fine steps around an initial depth.

    The surface is where a ray along the normal would have collected ``SURFACE_OPACITY``. Oblique rays cross more of
    the density shell, so the density, but not its rise, is multiplied by the cosine of their angle.

    Args:
        model: trained model, in evaluation mode.
        origins: origins of the rays.
        directions: unit vectors.
        initial_depth: depth within ``SEARCH_DEPTH`` of the surface.
        cosines: cosine of the angle between each ray and the surface's inward normal. By default the normal is the
            density gradient at ``INTERIOR_OPACITY``.

    Returns:
        The depth, and the opacity collected over the searched interval.
    """
    offsets = torch.linspace(-SEARCH_DEPTH, SEARCH_DEPTH, SEARCH_STEPS + 1, device=initial_depth.device)
    edges = (initial_depth + offsets).clamp_min(0.0)
    densities, lengths = densities_along(model, origins, directions, edges), edges.diff(dim=-1)
    opaque = opaque_density(densities, lengths, model.field.rise_length)
    opacity = 1.0 - torch.exp(-(opaque * lengths).sum(dim=-1, keepdim=True))
    if cosines is None:
        interior = origins + directions * opacity_crossing_depth(edges, opaque, INTERIOR_OPACITY)[:, None]
        inward_normals = functional.normalize(model.field.density_gradient(interior), dim=-1)
        cosines = (inward_normals * directions).sum(dim=-1, keepdim=True).clamp_min(MIN_COSINE)
    as_from_front = opaque + densities * (cosines - 1.0)  # a rise is the same from everywhere
    return opacity_crossing_depth(edges, as_from_front, SURFACE_OPACITY)[:, None], opacity


def opacity_crossing_depth(
    edges: Float[Tensor, "rays samples_and_1"], densities: Float[Tensor, "rays samples"], level: float
) -> Float[Tensor, "rays"]:
    """Depth at which the opacity collected along each ray first reaches ``level``.

    The density is constant between edges, so the optical depth is linear there and the crossing is exact.

    Args:
        edges: depths that bound the samples, ascending.
        densities: density in each interval, per unit of depth, not negative.
        level: opacity, in (0, 1).

    Returns:
        The depth; the last edge for a ray that never reaches the level.

    Example:
        >>> edges = torch.tensor([[0.0, 1.0, 2.0]])
        >>> opacity_crossing_depth(edges, torch.tensor([[0.0, 1.0]]), level=0.5)
        tensor([1.6931])
    """
    optical_depth = functional.pad(torch.cumsum(densities * edges.diff(dim=-1), dim=-1), (1, 0))
    target = -math.log1p(-level)
    after = (optical_depth < target).sum(dim=-1, keepdim=True).clamp(1, densities.shape[-1])
    before = after - 1
    collected = optical_depth.gather(1, before)
    fraction = (target - collected) / (optical_depth.gather(1, after) - collected).clamp_min(1e-12)
    near, far = edges.gather(1, before), edges.gather(1, after)
    return (near + fraction.clamp(0.0, 1.0) * (far - near))[:, 0]


def camera_rays(
    cameras: Cameras, frames: Int[np.ndarray, "n"], xy_px: Float[np.ndarray, "n 2"], device: torch.device | str
) -> RayBundle:
    """Rays of the measured cameras, which the model corrects, through image points from the upper left corner."""
    return cameras.generate_rays(
        camera_indices=torch.from_numpy(np.asarray(frames)[:, None]),
        coords=torch.from_numpy(np.asarray(xy_px)[:, ::-1].copy()).float(),
    ).to(device)


@torch.no_grad()
def render_object(model: SpectralModel, rays: RayBundle) -> tuple[dict[str, Tensor], Float[Tensor, "n bands"]]:
    """Render measured rays: the model's outputs, and the object's reflectance without the background's part.

    A model without a background extends the object's spectrum over the rest of a ray, so nothing is removed.
    """
    background = model.background_spectrum(rays)  # before the model corrects the rays
    outputs = model(rays)
    spectra, opacity = outputs["spectral"], outputs["accumulation"]
    if model.background is not None:
        spectra = safe_ratio(spectra - background * (1.0 - opacity), opacity, minimum=_MIN_RATIO_OPACITY)
    return outputs, spectra.clamp(0.0, 1.0)


@torch.no_grad()
def rendered_density(model: SpectralModel, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 1"]:
    """Density at points as it is rendered: 0 where the occupancy grid is empty."""
    return model.field.density_fn(points) * _may_hold_matter(model, points)[..., None]


@torch.no_grad()
def densities_along(
    model: SpectralModel,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    edges: Float[Tensor, "rays steps_and_1"],
) -> Float[Tensor, "rays steps"]:
    """Density in the middle of each step; 0 where the occupancy grid is empty, which is never rendered.

    Without a GPU, it is also 0 behind an optical depth of ``OPAQUE``.

    Args:
        model: trained model, in evaluation mode.
        origins: origins of the rays.
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
        evaluated = known[:, some] & (depth < OPAQUE)[:, None]
        found = torch.zeros_like(densities[:, some])
        if evaluated.any():
            found[evaluated] = model.field.density_fn(points[:, some][evaluated][:, None])[:, 0, 0]
        densities[:, some] = found
        depth += (found * lengths[:, some]).sum(dim=-1)
    return densities


def _may_hold_matter(model: SpectralModel, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
    """Whether the occupancy grid may hold matter at points; true everywhere without a grid."""
    grid = model.occupancy
    if grid is None:
        return torch.ones_like(points[..., 0], dtype=torch.bool)
    cells, inside = cell_of(points, grid.opacity.shape, grid.lower, grid.cell)
    return inside & (grid.opacity.flatten()[cells] >= 0.0)
