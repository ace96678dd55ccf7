"""Light that is stationary in the camera's frame: an uneven chamber and lamps, as functions of direction.

    radiance(direction, band) = chamber(direction) * chamber_colour(band) + lamps(direction) * lamp_colour(band)

``chamber`` is a sum of spherical harmonics of low order, ``lamps`` a sum of a few round lobes. Radiance is in units
of that of an even chamber, in which every unoccluded surface has the irradiance 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import sph_harm_y

from hsi_sc_nerf.geometry.camera import GOLDEN_ANGLE, unit_vectors

DEGREE = 2
"""Largest degree of the chamber's harmonics: irradiance hardly shows higher ones (Ramamoorthi and Hanrahan 2001)."""
TERMS = (DEGREE + 1) ** 2
DEGREE_OF_TERM = np.repeat(np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
FINE_DIRECTIONS = 1 << 13
LOBE_WIDTH_RAD = 0.055
"""Standard deviation of a lobe: that of a lamp of 22 cm at 1 m, and the distance between the rays' directions. A
wider lobe lights beyond the terminator, which the fit makes up for by a stronger lamp (docs/validation/light.md)."""

LEAST_COSINE = 0.15
"""Lamps at grazing angles hardly light a surface, however near they are."""


@dataclass(frozen=True, eq=False)
class StationaryLight:
    """The light of a session.

    Attributes:
        chamber: coefficient of each harmonic; 1, 0, 0 ... is an even chamber.
        lamps: irradiance of each lamp on a surface that faces it.
        to_lamps: unit vector to each lamp.
        nearness: one over the lamps' distance, 1/m; 0 for lamps at infinity.
        chamber_colour: factor of the chamber's light by band; 1 for light of the white reference's colour.
        lamp_colour: factor of the lamps' light by band.
    """

    chamber: Float[np.ndarray, "terms"]
    lamps: Float[np.ndarray, "lamps"]
    to_lamps: Float[np.ndarray, "lamps 3"]
    nearness: float
    chamber_colour: Float[np.ndarray, "bands"]
    lamp_colour: Float[np.ndarray, "bands"]

    def on(self, normal: Float[np.ndarray, "3"], position_m: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Irradiance by chamber and lamps, without their colours, on an unoccluded surface near the centre."""
        of_chamber, of_lamps = unit_irradiance(normal, self.to_lamps)
        nearer = relative_nearness(position_m[None], normal[None], self.to_lamps)[0]
        return float(of_chamber @ self.chamber), float(of_lamps * (1.0 + self.nearness * nearer) @ self.lamps)


def even_chamber(bands: int) -> StationaryLight:
    """The light of an even chamber without lamps."""
    return StationaryLight(np.eye(TERMS)[0], np.zeros(0), np.zeros((0, 3)), 0.0, np.ones(bands), np.ones(bands))


def unit_irradiance(
    normal: Float[np.ndarray, "3"], to_lamps: Float[np.ndarray, "lamps 3"]
) -> tuple[Float[np.ndarray, "terms"], Float[np.ndarray, "lamps"]]:
    """Irradiance of each harmonic and of each lamp of strength 1 on an unoccluded surface at the centre."""
    fine = even_directions(FINE_DIRECTIONS)
    cosines = np.maximum(fine @ normal, 0.0)
    cosines /= cosines.sum()
    return cosines @ harmonics(fine), cosines @ lobes(fine, to_lamps)


def even_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit vectors spread evenly over the sphere on a Fibonacci spiral; each stands for 4 pi / count sr."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = GOLDEN_ANGLE * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)


def harmonics(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n terms"]:
    """Real spherical harmonics up to `DEGREE`, by ascending degree (`DEGREE_OF_TERM`); their mean square is 1."""
    polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    orders = np.arange(TERMS) - DEGREE_OF_TERM * (DEGREE_OF_TERM + 1)
    terms = sph_harm_y(DEGREE_OF_TERM, np.abs(orders), polar[:, None], azimuth[:, None])
    return (
        np.sqrt(4.0 * np.pi) * np.where(orders == 0, 1.0, np.sqrt(2.0)) * np.where(orders < 0, terms.imag, terms.real)
    )


def lobes(
    directions: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "lamps 3"]
) -> Float[np.ndarray, "n lamps"]:
    """Radiance of round lobes (von Mises-Fisher) of irradiance 1 on a surface that faces them.

    Args:
        directions: evenly spread over the sphere.
        towards: unit vectors to the middles of the lobes.
    """
    cosines = directions @ towards.T
    radiance = np.exp((cosines - 1.0) / LOBE_WIDTH_RAD**2)
    return radiance / ((4.0 / len(directions)) * (radiance * np.maximum(cosines, 0.0)).sum(axis=0))


def tangents(towards: Float[np.ndarray, "lamps 3"]) -> Float[np.ndarray, "lamps 2 3"]:
    """Two unit vectors perpendicular to each other and to each of the given ones."""
    helper = np.eye(3)[np.abs(towards).argmin(axis=1)]
    first = unit_vectors(np.cross(towards, helper))
    return np.stack([first, np.cross(towards, first)], axis=1)


def relative_nearness(
    positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], to_lamps: Float[np.ndarray, "lamps 3"]
) -> Float[np.ndarray, "n lamps"]:
    """Relative change of each lamp's irradiance with the lamps' nearness, m.

    At a place x the direction w of a lamp at the distance 1 / nearness becomes w - nearness (x - (x w) w), and its
    irradiance on a surface that faces it 1 + 2 nearness (x w) times that at the centre, to first order.
    """
    cosines = np.maximum(normals @ to_lamps.T, LEAST_COSINE)
    outwards = (positions * normals).sum(axis=1, keepdims=True)
    return 3.0 * positions @ to_lamps.T - outwards / cosines
