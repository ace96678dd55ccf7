"""The surface in a soft density, defined by the model's own silhouettes.

A trained density rises over a few millimetres, because the object covers only a part of a pixel on its outline. A
mask ends where the object covers half of a pixel, and there the model has learned to render half of the object. So a
ray that touches the true surface collects an opacity of one half. This defines the surface without a threshold on the
opacity of frontal rays, which depends on the curvature, the pixels and the training.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.fields.surface_opacity import opaque_density
from hsi_sc_nerf.surface.surface_depth import opacity_crossing_depth

REACH, FAR_REACH = 0.055, 0.11
"""A touching ray is followed this far to both sides (about 6 and 12 mm). On a sphere of 35 mm it leaves a density
that grows over 1 mm only by the second. There it may meet other parts of the object, and what rises again is not
counted."""
NEAR_SAMPLES, FAR_SAMPLES = 6, 3
"""Samples to each side within the first reach, and between both."""
DIRECTIONS = 4
"""Touching rays through each point, evenly around the normal. The one with the least opacity counts: along the
strongest curvature, the path through the density is shortest and meets other parts of the object least."""
HOLLOW = 2.0
"""A point is in a hollow if every such ray collects more than this multiple of the optical depth along a plane."""
E_FOLDING_DEPTH = (1e-3, 1e-2)
"""Bounds of the depth over which the density at a surface grows by the factor e (about 0.1 to 1 mm)."""
MAX_STEPS = (0.014, 0.007, 0.0035, 0.0018)
"""Largest steps of the iterations (about 1.5 to 0.2 mm): a hard edge is found by halving them, a soft one sooner."""
SEARCH = (0.04, 0.06)
"""In hollows, the surface is searched from this distance in front of a point to this distance behind it."""
SEARCH_STEPS = 50
USUAL_OPACITY = 0.05
"""Opacity of a frontal ray at the surface, used if no point of the object has a touching ray."""
_NORMAL_STEP = 0.002
_LEAST_DENSITY = 1e-6


def move_to_silhouettes(
    density_fn: Callable[[Float[Tensor, "*n 3"]], Float[Tensor, "*n 1"]],
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    touching_opacity: float = 0.5,
    rise_length: float = 0.0,
) -> Float[Tensor, "n 3"]:
    """Points near the surface, moved along their normals to where a touching ray collects ``touching_opacity``.

    Towards the inside, the density near the surface grows exponentially, and so does the optical depth of a touching
    ray. So steps of Newton's method in its logarithm are nearly exact. No ray touches a hollow. There, the surface is
    where a frontal ray has collected the same opacity as frontal rays to the surface elsewhere, in the median.

    Args:
        density_fn: density of the model at points, per scene unit.
        points: within a millimetre or two of the surface, scene units.
        normals: outward unit vectors.
        touching_opacity: opacity of a ray that touches the surface, in (0, 1).
        rise_length: as in `opaque_density`.

    Example:
        >>> moved = move_to_silhouettes(model.field.density_fn, vertices, vertex_normals)
    """
    moved, touched = points, torch.ones_like(points[:, 0], dtype=torch.bool)
    tangents, step = _tangents(normals), _NORMAL_STEP * normals
    for max_step in MAX_STEPS:
        depth, touches = _least_touching_depth(density_fn, moved, tangents)
        depth = depth + rise_length * _density(density_fn, moved)  # which is the ray's largest
        touched &= touches
        rise = (_density(density_fn, moved - step) / _density(density_fn, moved + step)).log()
        e_folding = (2.0 * _NORMAL_STEP / rise.clamp_min(1e-6)).clamp(*E_FOLDING_DEPTH)
        inwards = e_folding * (-math.log1p(-touching_opacity) / depth).log()
        moved = moved - inwards.clamp(-max_step, max_step)[:, None] * normals
    if touched.all():
        return moved
    depths = torch.linspace(-SEARCH[0], SEARCH[1], SEARCH_STEPS + 1, device=points.device)
    middles = (depths[1:] + depths[:-1]) / 2.0
    densities = _density(density_fn, points[:, None] - normals[:, None] * middles[:, None])
    densities = opaque_density(densities, depths.diff(), rise_length)
    collected = torch.nn.functional.pad((densities * depths.diff()).cumsum(dim=1), (1, 0))
    opacity = USUAL_OPACITY
    if touched.any():
        at_surface = ((points - moved) * normals).sum(dim=-1, keepdim=True)
        collected = collected.gather(1, torch.searchsorted(depths, at_surface).clamp_max(SEARCH_STEPS))
        opacity = min(float(-torch.expm1(-collected[touched].median())), touching_opacity)
    in_hollow = opacity_crossing_depth(depths.expand(len(points), -1), densities, opacity)
    return torch.where(touched[:, None], moved, points - in_hollow[:, None] * normals)


def _least_touching_depth(
    density_fn: Callable[[Float[Tensor, "*n 3"]], Float[Tensor, "*n 1"]],
    points: Float[Tensor, "n 3"],
    tangents: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Least optical depth of rays through each point perpendicular to its normal, and whether that ray touches.

    A ray in a hollow does not touch: on both sides it goes deeper into the density.
    """
    first, second = tangents
    near_step, far_step = REACH / NEAR_SAMPLES, (FAR_REACH - REACH) / FAR_SAMPLES
    near = (torch.arange(NEAR_SAMPLES, device=points.device) + 0.5) * near_step
    far = REACH + (torch.arange(FAR_SAMPLES, device=points.device) + 0.5) * far_step
    along = torch.cat([near, far])[:, None]
    near_depths, depths = [], []
    for turn in range(DIRECTIONS):
        angle = math.pi * turn / DIRECTIONS
        direction = (math.cos(angle) * first + math.sin(angle) * second)[:, None]
        sides = torch.stack([_density(density_fn, points[:, None] + side * along * direction) for side in (1, -1)])
        near_depths.append(sides[..., :NEAR_SAMPLES].sum(dim=(0, 2)) * near_step)
        falling = sides[..., NEAR_SAMPLES - 1 :].cummin(dim=-1).values[..., 1:]
        depths.append(near_depths[-1] + falling.sum(dim=(0, 2)) * far_step)
    touches = torch.stack(near_depths).amin(dim=0) < HOLLOW * 2.0 * REACH * _density(density_fn, points)
    return torch.stack(depths).amin(dim=0), touches


def _density(density_fn: Callable[[Tensor], Tensor], points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    return density_fn(points)[..., 0].clamp_min(_LEAST_DENSITY)


def _tangents(normals: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors perpendicular to each normal and to each other."""
    # The axis of the normal's smallest component is never parallel to it.
    axis = torch.nn.functional.one_hot(normals.abs().argmin(dim=-1), 3).to(normals)
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    return first, torch.linalg.cross(normals, first)
