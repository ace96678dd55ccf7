"""Pairs of spectral images in blocks, cleared where they are not valid, so that float64 copies stay small."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Values of one image in a block: 8 MiB a temporary in float64, of which there are some dozens.
BLOCK_VALUES = 1 << 20
Image = Float[Tensor, "h w bands"]
Mask = Bool[Tensor, "h w"]
Valid = Bool[Tensor, "h w bands"]


def image_blocks(
    predicted: Tensor, target: Tensor, valid: Tensor | None, dim: int
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Both images in slices along ``dim``, 0 where not valid, and which of their values are."""
    check_shapes(predicted, target)
    step = max(1, BLOCK_VALUES * predicted.shape[dim] // max(1, predicted.numel()))
    pairs = zip(predicted.split(step, dim), target.split(step, dim), strict=True)
    if valid is None:
        yield from ((p, t, None) for p, t in pairs)
    else:
        for (p, t), v in zip(pairs, valid.split(step, dim), strict=True):
            yield cleared(p, v), cleared(t, v), v


def check_shapes(predicted: Tensor, target: Tensor) -> None:
    """Raise ValueError where the images differ in shape."""
    if predicted.shape != target.shape:
        raise ValueError(f"the images differ in shape: {tuple(predicted.shape)} and {tuple(target.shape)}")


def cleared(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``values``, 0 where they are not valid: what stood there, NaN included, touches neither values nor gradients.

    Raises:
        ValueError: ``valid`` is not boolean or of another shape.
    """
    check_valid(values, valid)
    return torch.where(valid, values, 0.0)


def check_valid(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> None:
    """Raise ValueError where the validity is not boolean, or its shape is not that of the values."""
    if valid.dtype != torch.bool or valid.shape != values.shape:
        raise ValueError(
            f"the validity of values of shape {tuple(values.shape)} is boolean with that shape, not {valid.dtype} "
            f"with shape {tuple(valid.shape)}"
        )
