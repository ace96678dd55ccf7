"""Light that enters the object at one place and leaves it at another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from hsi_sc_nerf.simulate.effects.stages import SurfaceLightEffect
from hsi_sc_nerf.simulate.reading import between

if TYPE_CHECKING:
    from hsi_sc_nerf.simulate.lighting import SurfaceLight

SHARP_NM, WIDTH_NM = 400.0, 1000.0
LEVELS = 2
"""Widths at which softened light is computed; in between it runs straight from one to the next."""


@dataclass(frozen=True)
class Translucency(SurfaceLightEffect):
    """The object's patterns and its shading by the chamber are softer, the longer the wavelength.

    Light wanders under the skin, and further where less is absorbed. What a matte surface would send is spread over
    the object's surface with a standard deviation that grows evenly from 0 at 400 nm to ``width_mm`` at 1000 nm; its
    total over the surface is kept. Nothing passes from the object to its support, and the edges of shadows that the
    lamp casts stay sharp.
    """

    name: ClassVar[str] = "translucency"
    width_mm: float = between(0.1, 20.0, default=2.0)
    """How far light at 1000 nm spreads (standard deviation along the surface), millimetres."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Give each colour of the object a copy for each width, which counts in its share of the bands."""
        surface = light.surface
        on_object = surface.is_object[:, None]
        of_object = [i for i, lit in enumerate(light.chamber_lit.T) if lit[surface.is_object].any()]
        sharp = [lit[:, of_object] * on_object for lit in (light.chamber_lit, light.lamp_lit)]
        plain = [lit * ~on_object for lit in (light.chamber_lit, light.lamp_lit)]
        colours, columns = list(light.colours), [[lit] for lit in plain]
        for level, bands in enumerate(_shares_of_bands()):
            colours += [replace(light.colours[i], bands=bands) for i in of_object]
            both = np.concatenate(sharp, axis=1)
            if level > 0:
                both = surface.spread_over_object(both, 1e-3 * self.width_mm * level / LEVELS)
            for lit, softened in zip(columns, np.split(both, 2, axis=1), strict=True):
                lit.append(softened)
        chamber_lit, lamp_lit = (np.concatenate(lit, axis=1) for lit in columns)
        return replace(light, colours=tuple(colours), chamber_lit=chamber_lit, lamp_lit=lamp_lit)


def _shares_of_bands() -> list[tuple[tuple[float, float], ...]]:
    """Share of each width in each band, as points (nm, share) of a line; they sum to 1 in every band."""
    nodes_nm = [SHARP_NM + (WIDTH_NM - SHARP_NM) * i / LEVELS for i in range(LEVELS + 1)]
    return [tuple((nm, float(i == j)) for j, nm in enumerate(nodes_nm)) for i in range(LEVELS + 1)]
