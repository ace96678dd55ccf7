"""Spectral indices of plant tissue: one number from the reflectance at a few wavelengths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.spectra.bands import Spectra, covered, require_bands


@dataclass(frozen=True)
class SpectralIndex:
    """A spectral index."""

    name: str
    expression: str
    """Printed formula: R800 is the reflectance at 800 nm."""
    wavelengths_nm: tuple[float, ...]
    formula: Callable[..., Any]
    """Of the reflectances at ``wavelengths_nm``, in their order (`Spectra`)."""
    drawn_range: tuple[float, float]
    """Values at the two ends of a colour map; plant tissue lies between."""
    tells: str


def ratio(numerator: Float[Spectra, "*shape"], denominator: Float[Spectra, "*shape"]) -> Float[Spectra, "*shape"]:
    """``numerator / denominator``; NaN where the denominator is not positive."""
    positive = denominator > 0
    with np.errstate(invalid="ignore"):
        return (numerator * positive) / (denominator * positive)


def normalised_difference(a: Float[Spectra, "*shape"], b: Float[Spectra, "*shape"]) -> Float[Spectra, "*shape"]:
    """``(a - b) / (a + b)``, in [-1, 1] for reflectance; NaN where the sum is not positive."""
    return ratio(a - b, a + b)


INDICES = {
    index.name: index
    for index in (
        # Rouse et al. 1974, Third ERTS-1 Symposium, NASA SP-351, 309-317, with the narrow bands of spectrometers.
        SpectralIndex(
            "NDVI", "(R800 - R670) / (R800 + R670)", (800.0, 670.0), normalised_difference, (0.0, 1.0), "green tissue"
        ),
        # Gitelson and Merzlyak 1994, Journal of Plant Physiology 143, 286-292.
        SpectralIndex(
            "red-edge NDVI",
            "(R750 - R705) / (R750 + R705)",
            (750.0, 705.0),
            normalised_difference,
            (0.0, 0.8),
            "chlorophyll, where NDVI saturates; ripening and senescence",
        ),
        # Peñuelas et al. 1997, International Journal of Remote Sensing 18, 2869-2875.
        SpectralIndex("water index", "R900 / R970", (900.0, 970.0), ratio, (0.9, 1.3), "water in the tissue"),
    )
}
"""By name."""


def available_indices(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[SpectralIndex]:
    """The named indices that these band centres can give."""
    return [one for one in INDICES.values() if covered(wavelengths_nm, one.wavelengths_nm).all()]


def index_values(
    index: SpectralIndex, spectra: Float[Spectra, "*shape bands"], wavelengths_nm: Float[np.ndarray, "bands"]
) -> Float[Spectra, "*shape"]:
    """The index of each spectrum, from the bands nearest to its wavelengths; NaN where it is undefined.

    Raises:
        InputError: a wavelength of the index has no band near it.

    Example:
        >>> spectra = np.array([[0.05, 0.45]])
        >>> index_values(INDICES["NDVI"], spectra, np.array([670.0, 800.0]))
        array([0.8])
    """
    bands = require_bands(wavelengths_nm, index.wavelengths_nm, index.name)
    return index.formula(*(spectra[..., int(band)] for band in bands))
