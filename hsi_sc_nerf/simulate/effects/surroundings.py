"""Effects of what stands around the turntable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import ChamberEffect
from hsi_sc_nerf.simulate.reading import between
from hsi_sc_nerf.simulate.shapes import smoothstep
from hsi_sc_nerf.simulate.texture import over, smooth_noise

BLOTCH_SCALES = (0.20, 0.08, 0.03)
"""Widths of the pattern's blotches, shares of the image's side."""
EDGE_STEEPNESS = 8.0
"""How sharp the edges of a blotch are: its share rises from 0 to 1 over 1 / this of the noise's range."""
BOARDS, JOINT_WIDTH = 5, 0.008
"""Upright boards across the image, and the width of the black joints between them, share of the image's side."""


@dataclass(frozen=True)
class TexturedBackground(ChamberEffect):
    """The chamber's wall is no even white: boards with splashes of paint that stand still in the image.

    Structure from motion finds more features on it than on the object, and takes the camera for one that does not
    move.
    """

    name: ClassVar[str] = "textured_background"
    materials: ClassVar[tuple[str, ...]] = ("plywood", "blue_paint", "black_paint")
    contrast: float = between(0.0, 1.0, default=1.0)
    """Share of the pattern in what the wall shows; the rest is the even chamber."""

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Boards of wood with black joints, under blotches of paint of three sizes."""
        wood, blue, black = np.eye(3)
        place = (np.arange(size_px) + 0.5) / size_px
        y, x = (axis.ravel() for axis in np.meshgrid(place, place, indexing="ij"))
        points = np.stack([x, y, np.zeros_like(x)], axis=-1)
        pattern = np.tile(wood, (size_px**2, 1))
        from_joint = np.abs((x * BOARDS + rng.uniform()) % 1.0 - 0.5) / BOARDS
        pattern = over(pattern, black, smoothstep((JOINT_WIDTH - from_joint) / JOINT_WIDTH + 0.5))
        for scale, paint in zip(BLOTCH_SCALES, (blue, black, blue), strict=True):
            field = smooth_noise(points, scale, rng)
            pattern = over(pattern, paint, smoothstep(EDGE_STEEPNESS * (field - 0.4)))
        shares = np.zeros((size_px**2, len(materials)))
        shares[:, [materials.index(name) for name in self.materials]] = self.contrast * pattern
        shares[:, -1] += 1.0 - self.contrast
        return shares.reshape(size_px, size_px, -1)
