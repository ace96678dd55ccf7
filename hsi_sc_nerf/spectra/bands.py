"""Which bands of an instrument stand for the wavelengths that a formula names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.data.pseudo_rgb import nearest_bands
from hsi_sc_nerf.errors import InputError

Spectra = TypeVar("Spectra", np.ndarray, Tensor)
"""Reflectance, bands last: an array or a tensor on any device."""

NEAR_NM = 10.0
"""A band whose centre is this near stands for a wavelength; so does one nearer than half the distance of bands."""


def covered(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Sequence[float]) -> Bool[np.ndarray, "targets"]:
    """Which wavelengths have a band near enough to stand for them: not those beyond the ends or in a gap."""
    spacing_nm = np.median(np.diff(np.sort(wavelengths_nm))) if len(wavelengths_nm) > 1 else 0.0
    nearest = wavelengths_nm[nearest_bands(wavelengths_nm, targets_nm)]
    return np.abs(nearest - np.asarray(targets_nm, float)) <= max(NEAR_NM, spacing_nm / 2.0)


def require_bands(
    wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Sequence[float], what: str
) -> Int[np.ndarray, "targets"]:
    """Index of the band that stands for each wavelength, which ``what`` is made of.

    Raises:
        InputError: a wavelength has no band near it.
    """
    missing = np.asarray(targets_nm, float)[~covered(wavelengths_nm, targets_nm)]
    if len(missing):
        raise InputError(
            f"{what} needs a band near {', '.join(f'{target:g}' for target in missing)} nm, and the "
            f"{len(wavelengths_nm)} bands given, {wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm, have none "
            "there; choose something else, or give more bands."
        )
    return nearest_bands(wavelengths_nm, targets_nm)
