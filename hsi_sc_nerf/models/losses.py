"""Losses as pure functions: the paper's two (section "Loss Function"), the spectral angle itself, and of weights.

Every spectral loss is a float32 mean over the pixels that count, and 0 with gradient 0 if none does. Values and
gradients are finite for any finite spectra, float16 included (``hsi_sc_nerf.numerics``). Where ``valid`` is given,
values of the target that are no measurements change neither the loss nor its gradient.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import cleared, has_angle
from hsi_sc_nerf.numerics import masked_mean, narrow, one_minus_cosine, spectral_angle, widen

DIRECTION_FLOOR = 1e-4
"""Root mean square reflectance below which a spectrum has no usable direction (a packed count is 2e-5)."""


def hsi_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    valid: Bool[Tensor, "*pixels bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared error over pixels **and bands** (paper, L_hsi).

    The paper prints a sum over the bands. Its released code takes the mean, and the printed weights (0.75 for this
    loss, 0.25 for the angular one) belong to the mean.

    Args:
        predicted: rendered reflectance.
        target: measured reflectance.
        valid: values of the target that are measurements, each of which counts alike; None for all.

    Raises:
        ValueError: ``valid`` is not boolean, or its shape is not that of the spectra.

    Example:
        >>> target = torch.rand(1024, 204)
        >>> hsi_loss(target + 0.1, target)
        tensor(0.0100)
    """
    if valid is not None:
        predicted, target = cleared(predicted, valid), cleared(target, valid)
    return narrow(masked_mean((widen(predicted) - widen(target)).square(), valid), predicted, target)


def angular_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    valid: Bool[Tensor, "*pixels bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over pixels of one minus the cosine of the spectral angle, in [0, 2] (paper, Eq. ang_cosine_loss).

    The paper's constant in the denominator has no printed value. Here it is a lower bound of each norm, not an
    addend: spectra above it are compared exactly, and the gradient of nearly black ones stays below
    ``1 / (DIRECTION_FLOOR sqrt(bands))``. A zero spectrum costs 1 and has gradient 0.

    Args:
        predicted: rendered reflectance.
        target: measured reflectance.
        valid: values of the target that are measurements; None for all. The angle is that between the spectra in a
            pixel's valid bands; a pixel with fewer than two valid bands is left out.

    Raises:
        ValueError: ``valid`` is not boolean, or its shape is not that of the spectra.
    """
    p, t, counted = _pixels_with_an_angle(predicted, target, valid)
    norm_floor = DIRECTION_FLOOR * math.sqrt(predicted.shape[-1])
    return narrow(masked_mean(one_minus_cosine(p, t, norm_floor=norm_floor), counted), predicted, target)


def angle_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    valid: Bool[Tensor, "*pixels bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over pixels of the spectral angle (radians, in [0, pi]): the paper's loss before its cosine.

    Unlike that of the cosine, the gradient does not vanish at small angles. Arguments and errors are those of
    `angular_loss`; a zero spectrum costs pi / 2 and has gradient 0.
    """
    p, t, counted = _pixels_with_an_angle(predicted, target, valid)
    return narrow(masked_mean(spectral_angle(p, t), counted), predicted, target)


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
    spectrum in front of it changes no pixel. Pixels that the object covers partly count less: it may be there.

    Args:
        weights: weights of the samples.
        heights: heights of the samples above the support, in any unit.
        free: how much the ray's pixel counts as free of the object: 0 on the object, 1 beside it.

    Example:
        >>> free_space_loss(torch.tensor([[0.3, 0.7]]), torch.tensor([[0.01, -0.01]]), torch.ones(1))
        tensor(0.3000)
    """
    above = heights > 0.0
    return (weights * above * (free * ~above.all(dim=-1))[:, None]).sum()


def _pixels_with_an_angle(
    predicted: Tensor, target: Tensor, valid: Tensor | None
) -> tuple[Float[Tensor, "*pixels bands"], Float[Tensor, "*pixels bands"], Bool[Tensor, "*pixels"] | None]:
    """Spectra whose flagged values are cleared, and which of them have an angle (None for all)."""
    if valid is None:
        return predicted, target, None
    cleared_both = cleared(predicted, valid), cleared(target, valid)
    # The norm over fewer bands is smaller. Scaled to all bands, it compares with the norm floor.
    scale = (predicted.shape[-1] / valid.sum(-1, keepdim=True).clamp_min(1)).sqrt()
    p, t = (widen(spectra) * scale for spectra in cleared_both)
    return p, t, has_angle(valid)
