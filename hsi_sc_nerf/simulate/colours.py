"""Colours of light: the spectra that what a point sends to the camera is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Colour:
    """Light of the white tarp that was reflected by each of some materials, and of some bands only.

    Attributes:
        materials: columns of the endmembers whose reflectances are multiplied, in rising order; of none, it is white.
        bands: (wavelength in nm, factor) of points between which the factor runs straight, level outside them;
            without any, the factor is 1.
    """

    materials: tuple[int, ...]
    bands: tuple[tuple[float, float], ...] = ()

    def reflected_by(self, material: int) -> Colour:
        """The colour after one more reflection."""
        return Colour(tuple(sorted((*self.materials, material))), self.bands)

    def spectrum(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
    ) -> Float[np.ndarray, "*samples bands"]:
        """Its radiance relative to the white tarp's."""
        spectrum = np.ones(wavelengths_nm.shape)
        for material in self.materials:
            spectrum = spectrum * endmembers[..., material, :]
        if self.bands:
            spectrum = spectrum * np.interp(wavelengths_nm, *np.transpose(self.bands))
        return spectrum


def colour_spectra(
    colours: Sequence[Colour],
    endmembers: Float[np.ndarray, "*samples materials bands"],
    wavelengths_nm: Float[np.ndarray, "*samples bands"],
) -> Float[np.ndarray, "*samples colours bands"]:
    """The spectra of several colours, stacked."""
    return np.stack([colour.spectrum(endmembers, wavelengths_nm) for colour in colours], axis=-2)
