"""Values that are no measurements, kept out of losses and metrics."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MIN_BANDS_OF_AN_ANGLE = 2
"""A spectrum of a single band is a length: it has no direction that could differ."""


def cleared(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``values``, 0 where they are not valid: what stood there, NaN included, touches neither values nor gradients.

    Raises:
        ValueError: ``valid`` is not boolean or of another shape.
    """
    if valid.dtype != torch.bool or valid.shape != values.shape:
        raise ValueError(
            f"the validity of values of shape {tuple(values.shape)} is boolean with that shape, not {valid.dtype} "
            f"with shape {tuple(valid.shape)}"
        )
    return torch.where(valid, values, 0.0)


def count_bands(valid: Bool[Tensor, "*pixels bands"]) -> Int[Tensor, "*pixels"]:
    """How many bands of each pixel are valid."""
    # torch makes integers of this kind of all that it adds up: 64-bit ones of a whole image are half a gigabyte.
    return valid.sum(-1, dtype=torch.int16)


def has_angle(valid: Bool[Tensor, "*pixels bands"]) -> Bool[Tensor, "*pixels"]:
    """Pixels with bands enough to tell a spectral angle from."""
    return count_bands(valid) >= MIN_BANDS_OF_AN_ANGLE
