"""Losses of the density along rays that an occupancy grid samples: distortion, and matter in free space."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.models.occupancy_sampler import OccupancySampler
from hsi_sc_nerf.models.supersampling import parts_of_pixels

FREE_SPACE_WEIGHT = 0.01
"""Weight of the loss of matter above the support beside the object (docs/validation/surface.md)."""
SUPPORT_SOFTNESS_M = 0.002
"""The support's own density reaches this far above it. Without a known container, its height is known too badly."""


def mean_distortion(sampler: OccupancySampler, outputs: dict[str, Any], pixels: int) -> Float[Tensor, ""]:
    """`separate_distortion`, mean over a batch of so many pixels; rays that were not sampled have none."""
    (*_, weights), (*_, samples) = outputs["weights_list"], outputs["ray_samples_list"]
    ends = (samples.frustums.starts[..., 0], samples.frustums.ends[..., 0])
    fractions = _of_sampled_rays(sampler, outputs, weights.new_ones(pixels))
    return (fractions * separate_distortion(weights[..., 0], *ends)).sum() / pixels


def mean_free_space(
    sampler: OccupancySampler, outputs: dict[str, Any], free: Bool[Tensor, "pixels"], support_height: float
) -> Float[Tensor, ""]:
    """`free_space_loss`, mean over all pixels.

    Args:
        sampler: of the rays.
        outputs: the model's, in training.
        free: which pixels show nothing of the object.
        support_height: scene units.
    """
    (*_, weights), (*_, samples) = outputs["weights_list"], outputs["ray_samples_list"]
    heights = samples.frustums.get_positions()[..., 2] - support_height
    return free_space_loss(weights[..., 0], heights, _of_sampled_rays(sampler, outputs, free.to(weights))) / len(free)


def _of_sampled_rays(
    sampler: OccupancySampler, outputs: dict[str, Any], of_pixels: Float[Tensor, "pixels"]
) -> Float[Tensor, "sampled"]:
    parts = parts_of_pixels(of_pixels, len(outputs["spectral"]))
    return parts if sampler.rays is None else parts[sampler.rays]


def separate_distortion(
    weights: Float[Tensor, "rays samples"], starts: Float[Tensor, "rays samples"], ends: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays"]:
    """Distortion of the weights along each ray (Barron et al. 2022, Eq. 15), of samples that may lie apart.

    The mean distance between two points of the ray that are drawn by its weights, unnormalised: it is small where the
    weights are concentrated.

    Args:
        weights: weights of the samples.
        starts: starts of the samples, in order.
        ends: likewise.
    """
    middles = (starts + ends) / 2.0
    # Samples are in order: pairs are summed once, by what lies before each sample.
    before = torch.cumsum(weights, dim=-1) - weights
    moment_before = torch.cumsum(weights * middles, dim=-1) - weights * middles
    between = 2.0 * (weights * (middles * before - moment_before)).sum(dim=-1)
    return between + (weights.square() * (ends - starts)).sum(dim=-1) / 3.0


def free_space_loss(
    weights: Float[Tensor, "rays samples"], heights: Float[Tensor, "rays samples"], free: Float[Tensor, "rays"]
) -> Float[Tensor, ""]:
    """Weight above the support, summed over the rays that pass the object by and reach its support.

    There is nothing but air above the support beside the object. The spectra do not tell: matter of the support's own
    spectrum in front of it changes no pixel.

    Args:
        weights: weights of the samples.
        heights: heights of the samples above the support, in any unit.
        free: how much the ray counts: 0 if its pixel may show the object, otherwise its part of the pixel.

    Example:
        >>> free_space_loss(torch.tensor([[0.3, 0.7]]), torch.tensor([[0.01, -0.01]]), torch.ones(1))
        tensor(0.3000)
    """
    above = heights > 0.0
    return (weights * above * (free * ~above.all(dim=-1))[:, None]).sum()
