"""Are the bands in the order of their wavelengths? A header whose list is reversed mirrors every spectrum.

Nothing in the counts tells: lamp and detector are weak at both ends. The object may: biological tissue absorbs the
blue and scatters the near infrared, and so do most pigments, blue ones too.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.findings import Finding, Level

BLUE_NM, INFRARED_NM = (430.0, 500.0), (850.0, 970.0)
"""Of the 400 to 1000 nm of silicon, one is about the other's mirror image."""
ORDER_AMBER, ORDER_RED = 1.3, 2.0
"""Reflectance in the blue over that in the infrared. White and grey things have 1, tissue less."""
LEAST_BLUE = 0.1
"""Of darker things noise and stray light may decide."""


def check_band_order(
    spectrum: Float[np.ndarray, "bands"], wavelengths_nm: Float[np.ndarray, "bands"]
) -> list[Finding]:
    """The finding ``band-order`` where the object is far brighter in the blue than in the infrared.

    Args:
        spectrum: the object's mean reflectance.
        wavelengths_nm: of its bands.

    Example:
        >>> check_band_order(np.array([0.6, 0.1]), np.array([450.0, 900.0]))[0].level
        'red'
    """
    in_blue, in_infrared = (
        (wavelengths_nm >= low) & (wavelengths_nm <= high) for low, high in (BLUE_NM, INFRARED_NM)
    )
    if not (in_blue.any() and in_infrared.any()):
        return []
    blue, infrared = float(spectrum[in_blue].mean()), float(spectrum[in_infrared].mean())
    ratio = blue / max(infrared, 1e-3)
    if blue < LEAST_BLUE or ratio <= ORDER_AMBER:
        return []
    level: Level = "red" if ratio > ORDER_RED else "amber"
    sentence = (
        f"The object reflects {100.0 * blue:.0f} % from {BLUE_NM[0]:g} to {BLUE_NM[1]:g} nm and "
        f"{100.0 * infrared:.0f} % from {INFRARED_NM[0]:g} to {INFRARED_NM[1]:g} nm, unlike plants and nearly all "
        "pigments: the headers probably list the wavelengths in reverse; compare them with a leaf, which is dark at "
        "680 nm and bright from 750 nm, and correct them."
    )
    return [Finding("band-order", level, sentence, {"blue_over_infrared": ratio})]
