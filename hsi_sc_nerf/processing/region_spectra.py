"""Spectra of the object and of the background, from packed frames and their masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, unpack
from hsi_sc_nerf.packed.dataset import PackedFrame

_BORDER_FRACTION = 1 / 32
_OBJECT_PIXELS = 2000


def background_spectrum(
    frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "bands"]:
    """Median over frames of `border_spectrum`; 0 in a band that no frame measured there."""
    spectra = np.stack([border_spectrum(frame.cube_path, mask) for frame, mask in zip(frames, masks, strict=True)])
    measured = np.isfinite(spectra).any(axis=0)
    background = np.zeros(spectra.shape[1])
    background[measured] = np.nanmedian(spectra[:, measured], axis=0)
    return background


def object_spectrum(
    frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "bands"]:
    """Mean over frames of the mean reflectance in the mask; 0 in a band that no frame measured there.

    At most `_OBJECT_PIXELS` or a few more pixels of a frame are read, evenly spread over the mask.
    """
    total = np.zeros(frames[0].cube().shape[-1])
    number = np.zeros_like(total)
    for frame, mask in zip(frames, masks, strict=True):
        pixels = np.flatnonzero(mask)
        chosen = np.unravel_index(pixels[:: max(1, len(pixels) // _OBJECT_PIXELS)], mask.shape)
        reflectance, valid = unpack(frame.cube()[chosen])
        measured = valid.sum(axis=0)
        total += reflectance.sum(axis=0) / np.maximum(measured, 1)
        number += measured > 0
    return total / np.maximum(number, 1)


def border_spectrum(cube_path: Path, mask: Bool[np.ndarray, "lines samples"]) -> Float[np.ndarray, "bands"]:
    """Median of what is measured on the image's border outside of the mask; nan in a band without any value."""
    lines, samples = mask.shape
    width = max(1, round(_BORDER_FRACTION * min(lines, samples)))
    border = ~mask
    border[width : lines - width, width : samples - width] = False
    counts = open_cube(cube_path).memmap()[border]
    # Flagged values are the largest number.
    return median_of_smallest(counts, (counts != FLAGGED).sum(axis=0)) / REFLECTANCE_SCALE


def median_of_smallest(
    values: Num[np.ndarray, "n *shape"], number: Int[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Median along the first axis of the ``number`` smallest values; nan where the number is 0."""
    if len(values) == 0:
        return np.full(values.shape[1:], np.nan)
    ordered = np.sort(values, axis=0)
    middle = [np.take_along_axis(ordered, np.maximum(number - odd, 0)[None] // 2, axis=0)[0] for odd in (0, 1)]
    # An even number has two middle values; of an odd number both are the same.
    return np.where(number > 0, 0.5 * (middle[0].astype(np.float64) + middle[1]), np.nan)
