"""Effects of the diffuse chamber: occlusion, inter-reflection, and a textured wall.

The chamber is infinitely far away and has the same radiance in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import SurfaceLight, SurfaceLightEffect
from hsi_sc_nerf.simulate.texture import over, smooth_noise, smoothstep

DIRECTIONS = 96
"""Default number of directions in which the surroundings of a point are sampled."""
BLOTCH_SCALES = (0.20, 0.08, 0.03)
"""Width of the blotches of paint as a fraction of the image side."""
EDGE_STEEPNESS = 8.0
"""Slope of a blotch's fraction over the noise value at its edge."""
BOARDS, JOINT_WIDTH = 5, 0.008
"""Number of boards across the image; width of the black joints as a fraction of the image side."""


@dataclass(frozen=True)
class ChamberShading(SurfaceLightEffect):
    """Points from which part of the chamber is occluded receive less light (ambient occlusion).

    Irradiance is the cosine-weighted fraction of directions in which the chamber is visible. Occluders are black
    unless `InterReflection` is on.
    """

    name: ClassVar[str] = "chamber_shading"
    directions: int = between(8, 4096, default=DIRECTIONS)
    """Directions sampled at each point; the error is inversely proportional to it, the time proportional."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Multiply the chamber's light by its visibility."""
        visibility = light.surface.surroundings(self.directions).chamber_visibility.astype(np.float32)
        return replace(light, chamber_lit=light.chamber_lit * visibility[:, None])


@dataclass(frozen=True)
class InterReflection(SurfaceLightEffect):
    """Object, container and disc illuminate each other by one diffuse reflection.

    Irradiance is that of the visible chamber, as in `ChamberShading`, plus the light of the occluders. The occluders
    are lit as without this effect: evenly, or as `ChamberShading` determines if it is on. The back of a surface sends
    no light.
    """

    name: ClassVar[str] = "inter_reflection"
    directions: int = between(8, 4096, default=DIRECTIONS)
    """Directions sampled at each point; the error is inversely proportional to it, the time proportional."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Add one colour for each pair of materials of which one illuminates the other."""
        around = light.surface.surroundings(self.directions)
        materials = light.materials
        from_neighbours = (around.form_factors @ light.chamber_lit).astype(np.float32)
        plain = materials * around.chamber_visibility.astype(np.float32)[:, None]
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
class TexturedBackground(Effect):
    """The wall of the chamber is made of boards with blotches of paint, which are stationary in the image.

    Structure from motion finds more features on the wall than on the object and estimates a stationary camera.
    """

    name: ClassVar[str] = "textured_background"
    materials: ClassVar[tuple[str, ...]] = ("plywood", "blue_paint", "black_paint")
    contrast: float = between(0.0, 1.0, default=1.0)
    """Fraction of the pattern in the wall; the rest is the white chamber."""

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Fractions of ``materials`` in each pixel of the wall: boards with black joints and blotches of paint."""
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
