"""Light of a diffuse chamber on a surface that hides part of it from itself.

The chamber is infinitely far away and of the same radiance everywhere. What turns is lit by what it does not hide
from itself (`ChamberShading`), and, one reflection further, by the light of what hides it (`InterReflection`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from hsi_sc_nerf.simulate.effects.stages import SurfaceLightEffect
from hsi_sc_nerf.simulate.reading import between

if TYPE_CHECKING:
    from hsi_sc_nerf.simulate.lighting import SurfaceLight

DIRECTIONS = 96


@dataclass(frozen=True)
class ChamberShading(SurfaceLightEffect):
    """Where neighbours hide part of the chamber it is darker: at the foot of the object, between kernels.

    Irradiance is the share of directions, weighted by their cosine to the normal, in which the chamber is seen.
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
