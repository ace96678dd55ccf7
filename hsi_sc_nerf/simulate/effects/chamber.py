"""Effects of the diffuse chamber: occlusion, inter-reflection, and a textured wall.

The chamber is infinitely far away and has the same radiance in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effects.stages import ChamberEffect, SurfaceLightEffect
from hsi_sc_nerf.simulate.light import SurfaceLight
from hsi_sc_nerf.simulate.texture import over, smooth_noise, smoothstep

DIRECTIONS = 96
BLOTCH_SCALES = (0.20, 0.08, 0.03)
"""Widths of the pattern's blotches, fractions of the image's side."""
EDGE_STEEPNESS = 8.0
"""How sharp the edges of a blotch are: its fraction rises from 0 to 1 over 1 / this of the noise's range."""
BOARDS, JOINT_WIDTH = 5, 0.008
"""Upright boards across the image, and the width of the black joints between them, fraction of the image's side."""


@dataclass(frozen=True)
class ChamberShading(SurfaceLightEffect):
    """Where neighbours hide part of the chamber it is darker: at the foot of the object, between kernels.

    Irradiance is the fraction of directions, weighted by their cosine to the normal, in which the chamber is seen.
    What is seen instead is black, but for `InterReflection`.
    """

    name: ClassVar[str] = "chamber_shading"
    directions: int = between(8, 4096, default=DIRECTIONS)
    """Directions in which each point of the surface looks; errors fall as fast as this grows, time grows with it."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Dim the chamber's light."""
        free = light.surface.surroundings(self.directions).free.astype(np.float32)
        return replace(light, chamber_lit=light.chamber_lit * free[:, None])


@dataclass(frozen=True)
class InterReflection(SurfaceLightEffect):
    """Object, container and disc light each other, by one reflection, in their colours.

    Irradiance is what the chamber gives, as in `ChamberShading`, and what neighbours send that hide it. They
    themselves are lit as they are without this effect: evenly, or as `ChamberShading` says where that is named.
    Surfaces that are seen from behind send nothing.
    """

    name: ClassVar[str] = "inter_reflection"
    directions: int = between(8, 4096, default=DIRECTIONS)
    """Directions in which each point of the surface looks; errors fall as fast as this grows, time grows with it."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Add a colour for each pair of materials of which one lights the other."""
        around = light.surface.surroundings(self.directions)
        materials = light.materials
        from_neighbours = (around.seen @ light.chamber_lit).astype(np.float32)
        plain = materials * around.free.astype(np.float32)[:, None]
        bounced: dict = {}
        for i, material in enumerate(materials.T):
            at = np.flatnonzero(material)
            for j, of_neighbour in enumerate(from_neighbours.T):
                product = material[at] * of_neighbour[at]
                if product.any():
                    colour = light.colours[j].reflected_by(i)
                    if colour not in bounced:
                        bounced[colour] = np.zeros(len(materials), np.float32)
                    bounced[colour][at] += product
        chamber_lit = np.column_stack([plain, *bounced.values()])
        lamp_lit = np.zeros_like(chamber_lit)
        lamp_lit[:, : plain.shape[1]] = light.lamp_lit
        return replace(light, colours=(*light.colours, *bounced), chamber_lit=chamber_lit, lamp_lit=lamp_lit)


@dataclass(frozen=True)
class TexturedBackground(ChamberEffect):
    """The chamber's wall is no even white: boards with splashes of paint that stand still in the image.

    Structure from motion finds more features on it than on the object, and takes the camera for one that does not
    move.
    """

    name: ClassVar[str] = "textured_background"
    materials: ClassVar[tuple[str, ...]] = ("plywood", "blue_paint", "black_paint")
    contrast: float = between(0.0, 1.0, default=1.0)
    """Fraction of the pattern in what the wall shows; the rest is the even chamber."""

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
        fractions = np.zeros((size_px**2, len(materials)))
        fractions[:, [materials.index(name) for name in self.materials]] = self.contrast * pattern
        fractions[:, -1] += 1.0 - self.contrast
        return fractions.reshape(size_px, size_px, -1)
