"""Light that stands still in the camera's frame: an uneven chamber and lamps.

    radiance(direction, band) = chamber(direction) * chamber_colour(band) + lamps(direction) * lamp_colour(band)

``chamber`` is a sum of spherical harmonics of low order, ``lamps`` a sum of a few round lobes. Radiance 1 from all
sides gives the irradiance 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.light.directions import even_directions, harmonics, lobes

DEGREE = 2
"""Of the chamber's harmonics: irradiance hardly shows higher ones (Ramamoorthi and Hanrahan 2001)."""
TERMS = (DEGREE + 1) ** 2
FINE_DIRECTIONS = 1 << 13


@dataclass(frozen=True, eq=False)
class StandingLight:
    """The light of a session.

    Attributes:
        chamber: coefficient of each harmonic; 1, 0, 0 ... is an even chamber.
        lamps: irradiance of each lamp on a surface that faces it.
        to_lamps: unit vector to each lamp.
        nearness: one over the lamps' distance, 1/m; 0 for lamps at infinity.
        chamber_colour: factor by band; 1 for light of the white reference's colour.
        lamp_colour: likewise.
    """

    chamber: Float[np.ndarray, "terms"]
    lamps: Float[np.ndarray, "lamps"]
    to_lamps: Float[np.ndarray, "lamps 3"]
    nearness: float
    chamber_colour: Float[np.ndarray, "bands"]
    lamp_colour: Float[np.ndarray, "bands"]

    def on(self, normal: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Irradiance by chamber and lamps, without their colours, on an unoccluded surface at the centre."""
        of_chamber, of_lamps = units_on(normal, self.to_lamps)
        return float(of_chamber @ self.chamber), float(of_lamps @ self.lamps)


def even_light(bands: int) -> StandingLight:
    """The light of an even chamber without lamps."""
    return StandingLight(np.eye(TERMS)[0], np.zeros(0), np.zeros((0, 3)), 0.0, np.ones(bands), np.ones(bands))


def units_on(
    normal: Float[np.ndarray, "3"], to_lamps: Float[np.ndarray, "lamps 3"]
) -> tuple[Float[np.ndarray, "terms"], Float[np.ndarray, "lamps"]]:
    """Irradiance of each harmonic and of each lamp of strength 1 on an unoccluded surface at the centre."""
    fine = even_directions(FINE_DIRECTIONS)
    cosines = np.maximum(fine @ normal, 0.0)
    cosines /= cosines.sum()
    return cosines @ harmonics(fine, DEGREE), cosines @ lobes(fine, to_lamps)
