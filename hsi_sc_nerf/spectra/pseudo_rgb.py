"""Bands of pseudo-RGB and gray pictures, and their 8-bit values."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import ArrayLike


def nearest_bands(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: ArrayLike) -> Int[np.ndarray, "targets"]:
    """Index of the band whose centre is nearest to each target."""
    return np.abs(wavelengths_nm[None, :] - np.asarray(targets_nm, float)[:, None]).argmin(axis=1)


def bands_within(
    wavelengths_nm: Float[np.ndarray, "bands"], range_nm: tuple[float, float]
) -> Int[np.ndarray, "inside"]:
    """Indices of the bands in ``range_nm``, or of all bands if none is in it."""
    inside = (wavelengths_nm >= range_nm[0]) & (wavelengths_nm <= range_nm[1])
    return np.flatnonzero(inside if inside.any() else np.ones_like(inside))


def to_8_bit(reflectance: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Reflectance 0 to 1 as 0 to 255, linear (no gamma), rounded and clipped."""
    return np.rint(np.clip(reflectance, 0.0, 1.0) * 255.0).astype(np.uint8)
