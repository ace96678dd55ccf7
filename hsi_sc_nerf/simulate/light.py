"""The noise-free light on the sensor, as few numbers as describe it exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Light:
    """``weights @ spectra``, times each of the illumination factors.

    Attributes:
        weights: how much of each colour each pixel sees.
        spectra: of those colours, relative to the white tarp's; one table, or one for each sample of a line.
        illumination: factors that broadcast to (lines, samples, bands).
    """

    weights: Float[np.ndarray, "lines samples colours"]
    spectra: Float[np.ndarray, "*samples colours bands"]
    illumination: tuple[Float[np.ndarray, "#lines #samples #bands"], ...] = ()

    def radiance(
        self, rows: slice | None = None, signal_of_white: Float[np.ndarray, "*samples bands"] | float = 1.0
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Radiance of some (by default all) lines, float32.

        It is relative to the white tarp's under the lamps at the session's start; with ``signal_of_white`` (counts
        above dark) it is in counts instead.
        """
        rows = rows or slice(None)
        signal = np.asarray(signal_of_white)
        spectra = (self.spectra * (signal[..., None, :] if signal.ndim else signal)).astype(np.float32)
        weights = self.weights[rows].astype(np.float32, copy=False)
        if spectra.ndim == 2:
            # One large product: many small ones lose their time between the cores.
            radiance = (weights.reshape(-1, len(spectra)) @ spectra).reshape(*weights.shape[:2], -1)
        else:
            # A table a sample: one product of matrices for each.
            radiance = np.matmul(weights.swapaxes(0, 1), spectra).swapaxes(0, 1).copy()
        for factor in self.illumination:
            radiance *= factor[rows] if len(factor) > 1 else factor
        return radiance
