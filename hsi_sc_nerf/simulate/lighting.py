"""Light that is not even: from the effects of the stage `light` to the light that each pixel gets.

Without these effects each point gets the irradiance 1, that of the white tarp, and so has its reflectance as its
radiance. With them the light of a pixel is the mean over its rays of

    chamber * chamber_lit + lamp * lamp_lit + mirrored

where ``chamber_lit`` and ``lamp_lit``, as weights of colours, belong to the surface (`SurfaceLight`), and the factors
``chamber`` and ``lamp`` and what is mirrored depend on where camera and lamp stand (`HitLight`).

They act in this order: shading by the chamber, inter-reflection of what is so lit, translucency of what a matte
surface would then send; the lamp takes its share from the chamber; gloss lies over it all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.simulate.colours import Colour
from hsi_sc_nerf.simulate.effects.stages import LensEffect, LightEffect, SurfaceLightEffect, ViewLightEffect
from hsi_sc_nerf.simulate.render import Hits, Renderer
from hsi_sc_nerf.simulate.surface import Surface


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Radiance of each point of a surface, the same in all directions.

    Attributes:
        surface: the points.
        colours: names the columns; the first are the renderer's materials, in their order.
        chamber_lit: under a chamber of radiance 1.
        lamp_lit: under a lamp that gives each point the irradiance 1.
    """

    surface: Surface
    colours: tuple[Colour, ...]
    chamber_lit: Float[np.ndarray, "p colours"]
    lamp_lit: Float[np.ndarray, "p colours"]

    @property
    def materials(self) -> Float[np.ndarray, "p materials"]:
        """Share of each material at each point."""
        return self.surface.renderer.weights[self.surface.vertex]


@dataclass(frozen=True, eq=False)
class HitLight:
    """What becomes of a surface's light on its way to one camera, where its rays hit.

    Attributes:
        chamber: factor on the light that the chamber gives.
        lamp: factor on the light that the lamp gives, its irradiance with it.
        to_lamp: unit direction to the lamp, if there is one.
        chamber_colour: of the chamber.
        mirrored: further light at each hit, by its colour.
    """

    chamber: Float[np.ndarray, "hits"]
    lamp: Float[np.ndarray, "hits"]
    to_lamp: Float[np.ndarray, "3"] | None
    chamber_colour: Colour
    mirrored: tuple[tuple[Colour, Float[np.ndarray, "hits"]], ...] = ()


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees.

    Attributes:
        material_weights: share of each material in each pixel, summing to exactly 1.
        coverage: share of each pixel that the object covers.
        light_weights: how much light of each colour each pixel gets.
        colours: of the light, the plain materials first.
    """

    material_weights: Float[np.ndarray, "h w materials"]
    coverage: Float[np.ndarray, "h w"]
    light_weights: Float[np.ndarray, "h w colours"]
    colours: tuple[Colour, ...]


class Lighting:
    """The light on one set of parts under some effects: what is the same from everywhere is computed here, once."""

    def __init__(self, renderer: Renderer, effects: Sequence[LightEffect]) -> None:
        on_surface = [effect for effect in effects if isinstance(effect, SurfaceLightEffect)]
        self._on_view = [effect for effect in effects if isinstance(effect, ViewLightEffect)]
        self._renderer = renderer
        self._light = even_light(Surface(self._renderer))
        for effect in on_surface:
            self._light = effect.on_surface(self._light)

    def render(
        self,
        intrinsics: PinholeIntrinsics,
        camera_to_world: Float[np.ndarray, "4 4"],
        supersampling: int,
        lens: LensEffect | None = None,
    ) -> Rendering:
        """What a camera sees; as `Renderer.render`, and the light with it."""
        size, materials = (intrinsics.h, intrinsics.w), len(self._renderer.materials)
        weights = np.empty((*size, materials), np.float32)
        coverage = np.empty(size, np.float32)
        light_of_rows = []
        for rows, hits in self._renderer.camera_hits(intrinsics, camera_to_world, supersampling, lens):
            weights[rows] = self._renderer.material_weights(hits).reshape(-1, intrinsics.w, materials)
            coverage[rows] = hits.mean(hits.is_object).reshape(-1, intrinsics.w)
            light, colours = self.light(hits, camera_to_world)
            light_of_rows.append(light.reshape(-1, intrinsics.w, len(colours)))
        return Rendering(weights, coverage, np.concatenate(light_of_rows), colours)

    def light(
        self, hits: Hits, camera_to_world: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "pixels colours"], tuple[Colour, ...]]:
        """The light that each pixel gets, as weights of colours, and these."""
        surface, count = self._light.surface, len(hits.ray)
        chamber = len(self._renderer.materials) - 1
        at_hits = HitLight(np.ones(count, np.float32), np.zeros(count, np.float32), None, Colour((chamber,)))
        for effect in self._on_view:
            at_hits = effect.at_hits(hits, at_hits, camera_to_world)
        colours = (*self._light.colours, *(colour for colour, _ in at_hits.mirrored))
        light = np.zeros((hits.pixels, len(colours)), np.float32)
        for factor, lit in ((at_hits.chamber, self._light.chamber_lit), (at_hits.lamp, self._light.lamp_lit)):
            if factor.any():
                light[:, : lit.shape[1]] += hits.mix(surface.triangles, len(lit), factor) @ lit
        light[:, chamber] = 1.0 - hits.mean(np.ones(count))
        for i, (_, mirrored) in enumerate(at_hits.mirrored, start=len(self._light.colours)):
            light[:, i] = hits.mean(mirrored)
        return light, colours


def even_light(surface: Surface) -> SurfaceLight:
    """Irradiance 1 everywhere."""
    materials = surface.renderer.weights[surface.vertex]
    colours = tuple(Colour((i,)) for i in range(len(surface.renderer.materials)))
    return SurfaceLight(surface, colours, materials, materials)
