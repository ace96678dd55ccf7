"""Whether an object is shaded at all: what tells of it, its noise, and the decision.

Two things tell of uneven light. The brightness of elements changes from view to view as the light says. And elements
of like spectra are the darker the less light reaches them, which also shows light that does not change with the turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.light.fit import LightFit
from hsi_sc_nerf.light.views import TurningElements, Views

ALIKE = 12
"""Each element is compared with so many others of the most similar spectra."""
LEAST_UNEVENNESS = 0.01
"""Irradiance that varies by less over the object changes no result."""
CERTAIN = 3.0
"""Standard deviations by which an effect must exceed its noise."""


@dataclass(frozen=True)
class ShadingEvidence:
    """What tells of uneven light on an object.

    Attributes:
        turning: brightness changes from view to view by this factor of what the fitted light says: 1 if it is right.
        turning_std: standard deviation of it.
        turning_spread: standard deviation of irradiance between the views of an element, relative.
        profile: brightness changes by this factor of what the light says between elements of like spectra: 1 if the
            light is right and materials alike, 0 in even light.
        profile_std: standard deviation of it.
        profile_spread: standard deviation of irradiance between elements, relative.
    """

    turning: float
    turning_std: float
    turning_spread: float
    profile: float
    profile_std: float
    profile_spread: float

    @property
    def shaded(self) -> bool:
        """Whether the light is uneven beyond noise."""
        turning = self.turning_spread > LEAST_UNEVENNESS and self.turning > CERTAIN * self.turning_std
        # Half way between even light and the light as it was fitted.
        profile = self.profile_spread > LEAST_UNEVENNESS and self.profile - 0.5 > self.profile_std
        return turning or profile


def shading_evidence(elements: TurningElements, views: Views, fit: LightFit) -> ShadingEvidence:
    """Look for uneven light.

    Args:
        elements: that were measured.
        views: their measurements, by the same bands as the fit.
        fit: light and materials.
    """
    rows = np.flatnonzero(views.tells_light)
    element, weights = views.element[rows], fit.weights[rows]
    brightness = np.log(np.maximum(views.reflectance[rows].mean(axis=1), 1e-4))
    # Brightness of a material is that of its mean over the bands.
    shown = (fit.material[element] * fit.irradiance[rows]).mean(axis=1)
    light = np.log(shown / fit.material[element].mean(axis=1))
    count = len(elements.positions)
    total = np.maximum(np.bincount(element, weights, count), 1e-9)
    means = [np.bincount(element, weights * values, count) / total for values in (brightness, light)]
    brighter, lighter = (values - mean[element] for values, mean in zip((brightness, light), means, strict=True))
    cells = elements.cells
    turning = _slope(brighter, lighter, weights, cells[element])
    seen = np.unique(element)
    spectra = np.stack([np.bincount(element, weights * band, count) for band in views.reflectance[rows].T], axis=-1)
    shapes = spectra[seen] / np.linalg.norm(spectra[seen], axis=1, keepdims=True)
    _, alike = cKDTree(shapes).query(shapes, min(ALIKE + 1, len(seen)))
    # Each against the mean of those like it, itself among them.
    own_brighter, own_lighter = (mean[seen] - mean[seen][alike].mean(axis=1) for mean in means)
    profile = _slope(own_brighter, own_lighter, np.ones(len(seen)), cells[seen])
    return ShadingEvidence(*turning, float(np.std(lighter)), *profile, float(np.std(means[1][seen])))


def _slope(
    response: Float[np.ndarray, "n"],
    cause: Float[np.ndarray, "n"],
    weights: Float[np.ndarray, "n"],
    cells: np.ndarray,
) -> tuple[float, float]:
    """Regression through the origin, and its standard deviation where the errors in a cell are shared."""
    square = max(float((weights * cause**2).sum()), 1e-12)
    slope = float((weights * cause * response).sum()) / square
    sums = np.bincount(cells, weights * cause * (response - slope * cause))
    return slope, float(np.sqrt((sums**2).sum()) / square)
