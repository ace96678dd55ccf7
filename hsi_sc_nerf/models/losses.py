"""The two spectral losses of the paper (section "Loss Function"), as pure functions.

Both are means over the pixels of the mask, float32, and 0 with gradient 0 where nothing counts. Values and gradients
are finite for any finite spectra, in float16 too (``hsi_sc_nerf.numerics``).

``valid`` tells which values of the target are measurements. The others count nowhere, whatever number stands there,
and no gradient comes from them.
"""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.models.validity import cleared, has_angle
from hsi_sc_nerf.numerics import masked_mean, narrow, one_minus_cosine, select_pixels, widen

# Root mean square reflectance below which a spectrum has no usable direction. A count of the packed cubes is 2e-5.
DIRECTION_FLOOR = 1e-4


def hsi_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
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

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the pixels; likewise ``valid``.
    """
    if valid is not None:
        predicted, target = cleared(predicted, valid), cleared(target, valid)
        valid = select_pixels(valid, mask)
    difference = widen(select_pixels(predicted, mask)) - widen(select_pixels(target, mask))
    return narrow(masked_mean(difference.square(), valid), predicted, target)


def angular_loss(
    predicted: Float[Tensor, "*pixels bands"],
    target: Float[Tensor, "*pixels bands"],
    mask: Bool[Tensor, "*pixels"] | None = None,
    valid: Bool[Tensor, "*pixels bands"] | None = None,
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
        direction_floor: Root mean square reflectance under which a spectrum's direction fades.

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the pixels; likewise ``valid``.
    """
    bands = predicted.shape[-1]
    p, t, counted = predicted, target, None
    if valid is not None:
        # The length of fewer bands is shorter: this makes it one of all bands, which is what the floor is.
        scale = (bands / valid.sum(-1, keepdim=True).clamp_min(1)).sqrt()
        p, t = widen(cleared(predicted, valid)) * scale, widen(cleared(target, valid)) * scale
        counted = select_pixels(has_angle(valid)[..., None], mask)[:, 0]
    norm_floor = direction_floor * math.sqrt(bands)
    distances = one_minus_cosine(select_pixels(p, mask), select_pixels(t, mask), norm_floor=norm_floor)
    return narrow(masked_mean(distances, counted), predicted, target)
