"""How uncertain a calibrated reflectance is, from the noise of sample, white and dark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class ReflectanceUncertainty:
    """Variance of a calibrated reflectance: in each band a parabola over the reflectance itself.

    ``variance = constant + linear * R + quadratic * R^2``: the sample's and the dark's readings give the first, the
    sample's photons the second, the white reference the third.
    """

    constant: Float[np.ndarray, "bands"]
    linear: Float[np.ndarray, "bands"]
    quadratic: Float[np.ndarray, "bands"]

    def standard_deviation(self, reflectance: Float[np.ndarray, "*shape bands"]) -> Float[np.ndarray, "*shape bands"]:
        """Standard deviation of a pixel's reflectance; negative reflectances (noise) count as 0."""
        lit = np.maximum(reflectance, 0.0)
        return np.sqrt(self.constant + (self.linear + self.quadratic * lit) * lit)
