"""Named false-colour composites of three bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.spectra.bands import Spectra, covered, require_bands


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
"""By name."""


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
    """
    return spectra[..., require_bands(wavelengths_nm, rgb_nm, name).tolist()]
