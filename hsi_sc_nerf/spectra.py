"""Spectra at an instrument's bands: the bands near wavelengths, named composites of three."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor  # takes seconds, and the commands' help does without it

Spectra = TypeVar("Spectra", np.ndarray, "Tensor")
"""Reflectance, bands last: an array or a tensor on any device."""

NEAR_NM = 10.0
"""A band represents a wavelength if it is this near, or nearer than half the spacing of the bands."""
FAR_NM = 30.0
"""Largest distance at which a band represents a wavelength."""
SAME_BAND_NM = 0.01
"""Bands of two files whose wavelengths differ by no more are the same."""


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


def nearest_bands(wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: ArrayLike) -> Int[np.ndarray, "targets"]:
    """Index of the band whose centre is nearest to each target."""
    return np.abs(wavelengths_nm[None, :] - np.asarray(targets_nm, float)[:, None]).argmin(axis=1)


def same_bands(
    wavelengths_nm: Float[np.ndarray, "bands"], targets_nm: Float[np.ndarray, "targets"]
) -> Int[np.ndarray, "targets"] | None:
    """Index of the band at each target wavelength; None if a target lies more than `SAME_BAND_NM` from all bands."""
    bands = nearest_bands(wavelengths_nm, targets_nm)
    return bands if np.abs(wavelengths_nm[bands] - targets_nm).max() <= SAME_BAND_NM else None


def listed_twice(wavelengths_nm: Float[np.ndarray, "bands"]) -> float | None:
    """The first wavelength that two bands have; None if each band has its own."""
    ascending = np.sort(wavelengths_nm)
    twice = ascending[1:][np.diff(ascending) == 0.0]
    return float(twice[0]) if len(twice) else None


def bands_within(
    wavelengths_nm: Float[np.ndarray, "bands"], range_nm: tuple[float, float]
) -> Int[np.ndarray, "inside"]:
    """Indices of the bands in ``range_nm``, or of all bands if none is in it."""
    inside = (wavelengths_nm >= range_nm[0]) & (wavelengths_nm <= range_nm[1])
    return np.flatnonzero(inside if inside.any() else np.ones_like(inside))


def to_8_bit(reflectance: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Reflectance 0 to 1 as 0 to 255, linear (no gamma), rounded and clipped."""
    return np.rint(np.clip(reflectance, 0.0, 1.0) * 255.0).astype(np.uint8)


@dataclass(frozen=True)
class Composite:
    """Three bands shown as red, green and blue."""

    name: str
    wavelengths_nm: tuple[float, float, float]
    """Shown as red, green, blue."""
    shows: str
    """What it makes visible."""


COMPOSITES = {
    composite.name: composite
    for composite in (
        Composite("pseudo-RGB", paper.PSEUDO_RGB_NM, "the paper's picture for the eye"),
        # Paper, section "Example Applications" and its figures.
        Composite("apple", (801.0, 708.0, 551.0), "bruises"),
        Composite("maize visible", (650.0, 540.0, 470.0), "kernels as the eye sees them"),
        Composite("maize", (850.0, 580.0, 490.0), "dryness and starch, carotenoids, pigments of kernels"),
        Composite("pear", (980.0, 710.0, 550.0), "water status, maturity, peel colour"),
        # The classical colour-infrared film: near infrared, red, green.
        Composite("CIR", (800.0, 670.0, 550.0), "living green tissue, which appears red"),
    )
}
"""The composites by name."""


def available_composites(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[Composite]:
    """The named composites that these band centres can show."""
    return [one for one in COMPOSITES.values() if covered(wavelengths_nm, one.wavelengths_nm).all()]


def composite(
    spectra: Float[Spectra, "*shape bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    rgb_nm: Sequence[float],
    name: str = "the composite",
) -> Float[Spectra, "*shape 3"]:
    """Reflectance at the bands nearest to the wavelengths for red, green and blue; linear and not clipped.

    Raises:
        InputError: a wavelength has no band near it; the message names the composite.

    Example:
        >>> composite(np.array([0.1, 0.2, 0.3]), np.array([450.0, 550.0, 650.0]), (650.0, 550.0, 450.0)).tolist()
        [0.3, 0.2, 0.1]
    """
    return spectra[..., require_bands(wavelengths_nm, rgb_nm, name).tolist()]
