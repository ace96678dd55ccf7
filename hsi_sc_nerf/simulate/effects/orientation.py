"""How the image lies on the sensor, and so in the file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hsi_sc_nerf.simulate.effects.stages import OrientationEffect
from hsi_sc_nerf.simulate.reading import between


@dataclass(frozen=True)
class ImageRotation(OrientationEffect):
    """The camera's slit stands upright and scans sideways, as a SPECIM IQ's: the file holds the image on its side.

    The sensor stays as it is: its line is the samples of every cube, and a dark cube has no up. So the image is
    turned before it meets the sensor, and patterns, smile and noise lie in the file as they do without this effect.
    """

    name: ClassVar[str] = "image_rotation"
    quarter_turns: int = between(1, 3, default=1)
    """Counter-clockwise turns by 90 degrees from the upright image to the file (``np.rot90``'s k)."""

    def orient(self, image: np.ndarray) -> np.ndarray:
        """Turn an upright image (lines, samples, ...) to how it lies in the file."""
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns))
