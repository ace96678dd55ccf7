"""What is left of the visual hull's cap over a hollow, fixed to the hollow's rim.

Masks do not show a hollow that faces upwards, so training begins with a cap over it, a cone as flat as the cameras
look down. Where the cap stays opaque, no ray shows the hollow, and the object is too tall. Pixels tell the cap from a
real top: without the top they show the chamber, while what is learned under a cap resembles it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Int

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.models.floating_matter import (
    MIN_OPACITY,
    clear_and_compare,
    lowest_in_the_air,
    pixels_that_look_at,
)
from hsi_sc_nerf.models.spectral_model import SpectralModel

MOST_RISE = 0.7
"""The squared errors of pixels that look at a layer of a cap rise by this fraction at most without it: by up to 0.5
on tomatoes, and by 1.9 to 22 where the layer is of a real top (docs/validation/surface.md)."""


@torch.no_grad()
def clear_cap(model: SpectralModel, manager: SpectralDataManager, step: int) -> None:
    """Clear what lies over the top of the object for good.

    It is for a late step: while the surface is still too high everywhere, pixels do without the real top as well.

    Args:
        model: with an occupancy grid.
        manager: of the training frames.
        step: of training; the pixels are drawn by it.
    """
    grid = model.occupancy
    assert grid is not None
    before = grid.opacity.clone()
    matter, height = before > MIN_OPACITY, torch.arange(before.shape[2], device=before.device).expand_as(before)

    def rise_without(layer: int) -> float:
        """Of the squared errors of pixels that look at a layer, those above being cleared."""
        grid.clear(height > layer)
        pixels = pixels_that_look_at((matter & (height == layer)).numpy(force=True), manager, step)
        if not len(pixels):
            return np.inf
        errors, rises = clear_and_compare(model, manager, height == layer, pixels)
        return float(rises.mean() / errors.mean().clamp_min(1e-12))

    layers = np.flatnonzero(matter.numpy(force=True).any(axis=(0, 1)))
    top = top_layer(layers[layers >= lowest_in_the_air(manager)], rise_without)
    grid.opacity.copy_(before)
    if top is not None:
        grid.clear(height > top)


def top_layer(layers: Int[np.ndarray, "n"], rise_without: Callable[[int], float]) -> int | None:
    """The lowest layer that pixels do without, in which the top of the object may lie; None if they need the highest.

    Args:
        layers: that hold matter, upwards.
        rise_without: fraction by which the squared errors at a layer rise without it, once those above are cleared.

    Example:
        >>> top_layer(np.arange(8), lambda layer: 0.1 if layer >= 5 else 9.0)
        5
    """
    top = None
    for layer in map(int, layers[::-1]):
        if not rise_without(layer) <= MOST_RISE:  # nor where it is not a number
            break
        top = layer
    return top
