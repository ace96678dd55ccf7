"""Bands of an instrument for the wavelengths of a formula."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

if TYPE_CHECKING:
    from torch import Tensor  # takes seconds, and the commands' help does without it

Spectra = TypeVar("Spectra", np.ndarray, "Tensor")
"""Reflectance, bands last: an array or a tensor on any device."""

NEAR_NM = 10.0
"""A band represents a wavelength if it is this near, or nearer than half the spacing of the bands."""
FAR_NM = 30.0
"""Largest distance at which a band represents a wavelength."""


def covered(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Sequence[float]) -> Bool[np.ndarray, "targets"]:
    """Which wavelengths of a formula have a band near them that no other of its wavelengths has.

    Two wavelengths with the same band are not covered, because their ratio would always be 1.
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
    """Index of the band for each wavelength of ``what``.

    Raises:
        InputError: a wavelength is not `covered`.
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
