"""Spectral losses as pure functions: the paper's two (section "Loss Function"), and a variant of each.

All are means over the pixels of the mask, float32, and 0 with gradient 0 where nothing counts. Values and gradients
are finite for any finite spectra, in float16 too (``hsi_sc_nerf.numerics``).

``valid`` tells which values of the target are measurements. The others count nowhere, whatever number stands there,
and no gradient comes from them. ``band_weights`` (of mean 1) tell how much each band counts; without them all count
alike.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import cleared, has_angle
from hsi_sc_nerf.numerics import masked_mean, narrow, one_minus_cosine, select_pixels, spectral_angle, widen

# Root mean square reflectance below which a spectrum has no usable direction. A count of the packed cubes is 2e-5.
DIRECTION_FLOOR = 1e-4


CHARBONNIER_SCALE = 0.02
"""Error in reflectance from which on the Charbonnier loss grows like the error, not like its square."""


def hsi_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
    band_weights: Float[Tensor, "bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared error over pixels **and bands** (paper, L_hsi).

    The paper prints a sum over the bands. Its released code takes the mean, 204 times smaller for its cubes, and the
    printed weights (0.75 for this loss, 0.25 for the angular one) belong to that mean; so does the independence of
    the weights from the number of bands.

    Args:
        predicted: Rendered reflectance.
        target: Measured reflectance.
        mask: Pixels that count; all without one.
        valid: Values of the target that are measurements, each of which counts alike; all without it.
        band_weights: How much each band counts.

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the pixels; likewise ``valid``.
    """
    difference, valid = _difference(predicted, target, mask, valid)
    costs = _weighted(difference.square(), band_weights)
    return narrow(masked_mean(costs, valid), predicted, target)


def charbonnier_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
    band_weights: Float[Tensor, "bands"] | None = None,
    scale: float = CHARBONNIER_SCALE,
) -> Float[Tensor, ""]:
    """Mean of ``2 s^2 (sqrt(1 + (d / s)^2) - 1)`` over pixels and bands, d the error and s the scale.

    The Charbonnier penalty (Charbonnier et al., "Two deterministic half-quadratic regularization algorithms for
    computed imaging", ICIP 1994), scaled so that a small error costs what it costs in `hsi_loss`, while a large one
    (a highlight, a silhouette) pulls like ``2 s |d|`` only. Arguments and errors are those of `hsi_loss`.
    """
    difference, valid = _difference(predicted, target, mask, valid)
    square = (difference / scale).square()
    # sqrt(1 + q) - 1 would lose small q to rounding.
    costs = _weighted(2.0 * scale**2 * square / ((1.0 + square).sqrt() + 1.0), band_weights)
    return narrow(masked_mean(costs, valid), predicted, target)


def angular_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
    band_weights: Float[Tensor, "bands"] | None = None,
    direction_floor: float = DIRECTION_FLOOR,
) -> Float[Tensor, ""]:
    """Mean over pixels of one minus the cosine of the spectral angle, in [0, 2] (paper, Eq. ang_cosine_loss).

    The paper's constant in the denominator has no printed value. Here it is a floor under each norm, not an addend:
    spectra above it are compared exactly, and the gradient of nearly black ones stays below
    ``1 / (direction_floor sqrt(bands))``. A zero spectrum costs 1 and has gradient 0.

    Args:
        predicted: Rendered reflectance.
        target: Measured reflectance.
        mask: Pixels that count; all without one.
        valid: Values of the target that are measurements; all without it. The angle is that between the spectra in
            a pixel's valid bands; a pixel with fewer than two has none and is left out.
        band_weights: How much each band counts in the products of spectra that the angle is made of.
        direction_floor: Root mean square reflectance under which a spectrum's direction fades.

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the pixels; likewise ``valid``.
    """
    p, t, counted = _compared_directions(predicted, target, mask, valid, band_weights)
    norm_floor = direction_floor * math.sqrt(predicted.shape[-1])
    return narrow(masked_mean(one_minus_cosine(p, t, norm_floor=norm_floor), counted), predicted, target)


def angle_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
    band_weights: Float[Tensor, "bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over pixels of the spectral angle itself (radians, in [0, pi]): the paper's loss before its cosine.

    Its gradient does not fade as the angle does. Arguments and errors are those of `angular_loss`; a zero spectrum
    costs pi / 2 and has gradient 0.
    """
    p, t, counted = _compared_directions(predicted, target, mask, valid, band_weights)
    return narrow(masked_mean(spectral_angle(p, t), counted), predicted, target)


def _weighted(costs: Tensor, band_weights: Tensor | None) -> Tensor:
    return costs if band_weights is None else costs * band_weights.to(costs)


def _difference(
    predicted: Tensor, target: Tensor, mask: Tensor | None, valid: Tensor | None
) -> tuple[Float[Tensor, "n bands"], Bool[Tensor, "n bands"] | None]:
    """Errors of the pixels that count, and which of them are against measurements."""
    if valid is not None:
        predicted, target = cleared(predicted, valid), cleared(target, valid)
        valid = select_pixels(valid, mask)
    return widen(select_pixels(predicted, mask)) - widen(select_pixels(target, mask)), valid


def _compared_directions(
    predicted: Tensor, target: Tensor, mask: Tensor | None, valid: Tensor | None, band_weights: Tensor | None
) -> tuple[Float[Tensor, "n bands"], Float[Tensor, "n bands"], Bool[Tensor, "n"] | None]:
    """Spectra of the pixels that count, whose angles are to be compared, and which of them have an angle."""
    p, t, counted = predicted, target, None
    if valid is not None:
        # The length of fewer bands is shorter: this makes it one of all bands, which is what a floor is of.
        scale = (predicted.shape[-1] / valid.sum(-1, keepdim=True).clamp_min(1)).sqrt()
        p, t = widen(cleared(predicted, valid)) * scale, widen(cleared(target, valid)) * scale
        counted = select_pixels(has_angle(valid)[..., None], mask)[:, 0]
    p, t = select_pixels(p, mask), select_pixels(t, mask)
    if band_weights is not None:
        roots = torch.sqrt(band_weights).to(p)
        p, t = p * roots, t * roots
    return p, t, counted
