"""The lamps' spectrum."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7  # h c / k_B


def lamp_photons(wavelengths_nm: Float[np.ndarray, "*shape"], temperature_k: float) -> Float[np.ndarray, "*shape"]:
    """Photon spectrum of a tungsten lamp, relative: Planck's law in photons, 1 / (l^4 (exp(c2 / (l T)) - 1))."""
    exponent = SECOND_RADIATION_CONSTANT_NM_K / (wavelengths_nm * temperature_k)
    return (wavelengths_nm / 1000.0) ** -4 / np.expm1(exponent)
