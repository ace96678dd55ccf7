"""Pictures from cubes: pseudo-RGB of three bands, and a gray image in which printed markers stand out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import ArrayLike

from hsi_sc_nerf import paper


def nearest_bands(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: ArrayLike) -> Int[np.ndarray, "targets"]:
    """Index of the band whose centre is nearest to each target."""
    return np.abs(wavelengths_nm[None, :] - np.asarray(targets_nm, float)[:, None]).argmin(axis=1)


def pseudo_rgb(
    reflectance: Float[np.ndarray, "lines samples bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    rgb_nm: Sequence[float] = paper.PSEUDO_RGB_NM,
) -> UInt8[np.ndarray, "lines samples 3"]:
    """The bands nearest to red, green and blue ``rgb_nm``; reflectance 1 is 255, linear (no gamma)."""
    return to_8_bit(reflectance[..., nearest_bands(wavelengths_nm, rgb_nm)])


def bands_within(
    wavelengths_nm: Float[np.ndarray, "bands"], range_nm: tuple[float, float]
) -> Int[np.ndarray, "inside"]:
    """Indices of the bands in ``range_nm``; of all bands where the instrument has none there."""
    inside = (wavelengths_nm >= range_nm[0]) & (wavelengths_nm <= range_nm[1])
    return np.flatnonzero(inside if inside.any() else np.ones_like(inside))


def to_8_bit(reflectance: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Reflectance 0 to 1 as 0 to 255, rounded; what lies outside is clipped."""
    return np.rint(np.clip(reflectance, 0.0, 1.0) * 255.0).astype(np.uint8)
