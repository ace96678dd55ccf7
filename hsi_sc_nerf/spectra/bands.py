"""Which bands of an instrument stand for the wavelengths that a formula names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

Spectra = TypeVar("Spectra", np.ndarray, Tensor)
"""Reflectance, bands last: an array or a tensor on any device."""

NEAR_NM = 10.0
"""A band whose centre is this near stands for a wavelength; so does one nearer than half the distance of bands."""
FAR_NM = 30.0
"""A band further away than this does not, however far apart the bands are."""


def covered(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Sequence[float]) -> Bool[np.ndarray, "targets"]:
    """Which of the wavelengths that one formula names have a band near enough to stand for them, and only for them.

    Not those beyond the ends or in a gap; nor two that share a band, of which any ratio is 1 and any difference 0.
    """
    targets = np.asarray(targets_nm, float)
    spacing_nm = np.median(np.diff(np.sort(wavelengths_nm))) if len(wavelengths_nm) > 1 else 0.0
    bands = nearest_bands(wavelengths_nm, targets)
    near = np.abs(wavelengths_nm[bands] - targets) <= np.clip(spacing_nm / 2.0, NEAR_NM, FAR_NM)
    shared = (bands[:, None] == bands) & (targets[:, None] != targets) & near
    return near & ~shared.any(axis=1)


def require_bands(
    wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Sequence[float], what: str
) -> Int[np.ndarray, "targets"]:
    """Index of the band that stands for each wavelength, which ``what`` is made of.

    Raises:
        InputError: a wavelength has no band near it, or none that stands for it alone.
    """
    missing = np.asarray(targets_nm, float)[~covered(wavelengths_nm, targets_nm)]
    if len(missing):
        near = " and another near ".join(f"{target:g}" for target in missing)
        raise InputError(
            f"{what} needs a band near {near} nm, and the {len(wavelengths_nm)} bands given, "
            f"{wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm, do not have that; choose something else, or "
            "give more bands."
        )
    return nearest_bands(wavelengths_nm, targets_nm)
