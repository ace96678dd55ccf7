"""Spectral losses as pure functions: the paper's two (section "Loss Function"), and the spectral angle itself.

Every loss is a float32 mean over the pixels that count, and 0 with gradient 0 if none does. Values and
gradients are finite for any finite spectra, float16 included (``hsi_sc_nerf.numerics``). Where ``valid`` is given,
values of the target that are no measurements change neither the loss nor its gradient.
"""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import cleared, has_angle
from hsi_sc_nerf.numerics import masked_mean, mean_square, narrow, one_minus_cosine, spectral_angle, widen

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
    if valid is None:
        return mean_square(predicted, target)
    mean = mean_square(cleared(predicted, valid), cleared(target, valid))
    return narrow(widen(mean) * (valid.numel() / valid.sum().clamp_min(1)), mean)


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
    norm_floor = DIRECTION_FLOOR * math.sqrt(predicted.shape[-1])
    if valid is None:
        return masked_mean(one_minus_cosine(predicted, target, norm_floor=norm_floor))
    # The norm over fewer bands is smaller. Scaled to all bands, it compares with the norm floor.
    scale = (predicted.shape[-1] / valid.sum(-1, keepdim=True).clamp_min(1)).sqrt()
    p, t = (widen(cleared(spectra, valid)) * scale for spectra in (predicted, target))
    loss = masked_mean(one_minus_cosine(p, t, norm_floor=norm_floor), has_angle(valid))
    return narrow(loss, predicted, target)


def angle_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    valid: Bool[Tensor, "*pixels bands"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over pixels of the spectral angle (radians, in [0, pi]): the paper's loss before its cosine.

    Unlike that of the cosine, the gradient does not vanish at small angles. Arguments and errors are those of
    `angular_loss`; a zero spectrum costs pi / 2 and has gradient 0.
    """
    if valid is None:
        return masked_mean(spectral_angle(predicted, target))
    return masked_mean(spectral_angle(cleared(predicted, valid), cleared(target, valid)), has_angle(valid))
