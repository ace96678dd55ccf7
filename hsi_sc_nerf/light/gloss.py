"""Light that a glossy skin mirrors, in addition to what its material reflects.

Highlights of the lamps move over the turning object, and depend on the normal in the camera's frame. Over all
directions that are mirrored into the camera, their radiance sums to the mirrored fraction times the lamps'
irradiance: so the highlights tell how much the skin mirrors. The same fraction of the chamber's light is mirrored in
all views alike, which the views could not tell from the material.

A point that turns through a highlight has too bright a material where other views are few. So highlights and
corrections of all materials are found together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hsi_sc_nerf.findings import CERTAIN
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.light.shared_errors import CORRELATED
from hsi_sc_nerf.light.stationary_light import StationaryLight
from hsi_sc_nerf.light.views import SMALLEST
from hsi_sc_nerf.robust_scatter import robust_std, tukey_weights

CELL = 0.08
"""Side of the highlights' cells in x and y of the unit normal: 5 degrees for a surface that faces the camera."""
HALF = int(np.ceil(1.0 / CELL))
LEAST_MEASUREMENTS = 5
"""Number of measurements of a cell that counts."""
HIGHLIGHT_RAD = 0.45
"""Radius of a lamp's highlight in normals: a rough skin before a lamp of 15 degrees has one of 0.35."""
LEAST_REFLECTANCE = 0.003
"""A skin that mirrors less changes no result."""
HIGHLIGHT_STD = 0.1
"""Expected size of a highlight, for cells that the views do not determine."""
STEPS = 8
"""Turns of highlights and weights."""
REFLECTANCE_ERROR = 0.2
"""Relative error of the mirrored fraction by those of the lamps' strength and of the normals, which all highlights
share (docs/validation/light.md)."""
HIGHLIGHT_ERROR, CHAMBER_ERROR = 0.3, 0.3
"""Relative errors of a highlight at one point, and of the chamber's light that is mirrored there."""


@dataclass(frozen=True, eq=False)
class Gloss:
    """The gloss of an object.

    Attributes:
        reflectance: fraction of the light that is mirrored, 0 to 1.
        std: standard deviation of it.
        highlights: what the lamps' highlights add to the reflectance, by y and x of the normal in the camera's frame
            in cells of `CELL`; 0 where there are none.
    """

    reflectance: float
    std: float
    highlights: Float[np.ndarray, "side side"]

    def at(
        self, normals: Float[np.ndarray, "n 3"], light: StationaryLight
    ) -> tuple[Float[np.ndarray, "n bands"], Float[np.ndarray, "n"]]:
        """What gloss adds to the reflectance where a surface has these normals.

        Args:
            normals: unit vectors, camera's frame.
            light: the light of the chamber and the lamps' colour.

        Returns:
            The addition, and the standard deviation of its mean over the bands.
        """
        highlight = self.highlight(normals)
        chamber = np.full(len(normals), self.reflectance * mirrored_chamber(light))
        # Of a whole cloud, these are its largest arrays.
        bands = highlight.astype(np.float32)[:, None] * light.lamp_colour.astype(np.float32)
        bands += chamber.astype(np.float32)[:, None] * light.chamber_colour.astype(np.float32)
        return bands, np.hypot(CHAMBER_ERROR * chamber, HIGHLIGHT_ERROR * highlight)

    def taken_off(
        self, reflectance: Float[np.ndarray, "n bands"], normals: Float[np.ndarray, "n 3"], light: StationaryLight
    ) -> Float[np.ndarray, "n bands"]:
        """Reflectance without what gloss adds where a surface has these normals; at least `SMALLEST`."""
        return np.maximum(reflectance - self.at(normals, light)[0], SMALLEST)

    def highlight(self, normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """What the lamps add, interpolated between the cells."""
        column, line = normals[:, :2].T / CELL + HALF - 0.5
        return ndimage.map_coordinates(self.highlights, [line, column], order=1, mode="nearest")


def find_gloss(
    element: Int[np.ndarray, "m"],
    normals: Float[np.ndarray, "m 3"],
    residuals: Float[np.ndarray, "m"],
    irradiance: Float[np.ndarray, "m"],
    light: StationaryLight,
) -> Gloss | None:
    """The gloss that explains what material and chamber leave of the measurements, or None.

    Args:
        element: index of the measured element of the object.
        normals: of the measurements, unit vectors in the camera's frame.
        residuals: measured reflectance less that of the material under its irradiance and less the mirrored light of
            the chamber, means over the bands.
        irradiance: at the measurements, mean over the bands.
        light: with the lamps whose highlights are looked for.

    Example:
        >>> residuals = (measured - material[element] * irradiance).mean(axis=1)
        >>> gloss = find_gloss(element, normals, residuals, irradiance.mean(axis=1), light)
        >>> 0.0 if gloss is None else gloss.reflectance
    """
    if not len(light.lamps):
        return None
    across, line = np.clip(np.floor(normals[:, :2].T / CELL).astype(int) + HALF, 0, 2 * HALF - 1)
    cells, near = line * 2 * HALF + across, _near_highlights(light)
    known = np.bincount(cells, minlength=near.size) >= LEAST_MEASUREMENTS
    in_highlights = np.flatnonzero(known & near)
    if not len(in_highlights) or not (known & ~near).any():
        return None
    column = np.full(near.size, -1)
    column[in_highlights] = np.arange(len(in_highlights))
    highlights, left = _fit_highlights(column[cells], element, residuals, irradiance)
    # A normal's x and y turn by half of what the mirrored direction turns: dw = 4 cos dn, and dn = dx dy / cos.
    unit = 4.0 * CELL**2 / (np.pi * float(light.lamps.sum()))
    errors = ndimage.median(left, cells, np.flatnonzero(known & ~near))
    reflectance = unit * float(highlights.sum())
    noise = unit * float(errors.std() * np.sqrt(CORRELATED * len(in_highlights)))
    if reflectance < max(LEAST_REFLECTANCE, CERTAIN * noise):
        return None
    std = float(np.hypot(noise, REFLECTANCE_ERROR * reflectance))
    shown = np.zeros(near.size)
    shown[in_highlights] = np.maximum(highlights, 0.0)
    return Gloss(reflectance, std, shown.reshape(2 * HALF, 2 * HALF))


def mirrored_chamber(light: StationaryLight) -> float:
    """Radiance of the chamber that a perfect mirror shows to the camera, without its colour.

    It is the chamber's mean: the fitted unevenness is too uncertain. Taken off by direction, it resembles the lamps'
    light in bands in which the material is dark, and changes their colour.
    """
    return max(float(light.chamber[0]), 0.0)


def _fit_highlights(
    column: Int[np.ndarray, "m"],
    element: Int[np.ndarray, "m"],
    residuals: Float[np.ndarray, "m"],
    irradiance: Float[np.ndarray, "m"],
) -> tuple[Float[np.ndarray, "cells"], Float[np.ndarray, "m"]]:
    """Highlights by robust least squares, with the materials' corrections eliminated, and what both leave.

    Args:
        column: the highlights' cell of each measurement, -1 for none.
    """
    count, rows = len(column), np.flatnonzero(column >= 0)
    cells, elements = int(column.max()) + 1, int(element.max()) + 1
    highlit = scipy.sparse.csr_array((np.ones(len(rows)), (column[rows], rows)), shape=(cells, count))
    lit = scipy.sparse.csr_array((irradiance, (element, np.arange(count))), shape=(elements, count))
    weights, scatter = np.ones(count), robust_std(residuals, least=SMALLEST)
    for _ in range(STEPS):
        square = np.maximum(lit @ (weights * irradiance), 1e-12)
        shared = scipy.sparse.csr_array((highlit * weights) @ lit.T)
        by_material = scipy.sparse.csr_array(shared / square)
        information = np.diag(highlit @ weights) - (by_material @ shared.T).toarray()
        information += (scatter / HIGHLIGHT_STD) ** 2 * np.eye(cells)
        known = highlit @ (weights * residuals) - by_material @ (lit @ (weights * residuals))
        highlights = np.linalg.solve(information, known)
        left = residuals - highlit.T @ highlights
        left -= irradiance * ((lit @ (weights * left)) / square)[element]
        scatter = robust_std(left, least=SMALLEST)
        weights = np.maximum(tukey_weights(left, scatter), 1e-6)
    return highlights, left


def _near_highlights(light: StationaryLight) -> Bool[np.ndarray, "cells"]:
    """Cells whose normals lie near one that mirrors a lamp into the camera."""
    middles = (np.arange(2 * HALF) - HALF + 0.5) * CELL
    x, y = np.meshgrid(middles, middles)
    square = 1.0 - x**2 - y**2
    normals = np.stack([x, y, np.sqrt(np.maximum(square, 0.0))], axis=-1)
    mirrors = unit_vectors(light.to_lamps + np.array([0.0, 0.0, 1.0]))
    return (((normals @ mirrors.T).max(axis=-1) > np.cos(HIGHLIGHT_RAD)) & (square > 0.0)).ravel()
