"""Uneven light: from the light effects of a scene to the light of each pixel.

Without light effects every point has the irradiance 1, that of the white tarp, so its radiance is its reflectance.
With them the light of a pixel is the mean over its rays of

    chamber * chamber_lit + lamp * lamp_lit + mirrored

where ``chamber_lit`` and ``lamp_lit`` belong to the surface (`SurfaceLight`), and the factors ``chamber`` and
``lamp`` and the mirrored light depend on the view (`HitLight`). Effects act in this order: shading by the chamber,
inter-reflection, translucency, lamp, gloss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.simulate.effect import of_kind
from hsi_sc_nerf.simulate.light import (
    Colour,
    HitLight,
    LightEffect,
    SurfaceLightEffect,
    ViewLightEffect,
    even_light,
    single_colours,
)
from hsi_sc_nerf.simulate.render import Hits, Lens, Renderer
from hsi_sc_nerf.simulate.surface import Surface


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image and its light.

    Attributes:
        material_weights: fraction of each material in each pixel, summing to exactly 1.
        coverage: fraction of each pixel that the object covers.
        light_weights: amount of each colour in the light of each pixel; in even light ``material_weights`` itself.
        colours: colours of the light; those of single materials come first.
    """

    material_weights: Float[np.ndarray, "h w materials"]
    coverage: Float[np.ndarray, "h w"]
    light_weights: Float[np.ndarray, "h w colours"]
    colours: tuple[Colour, ...]


def render(
    renderer: Renderer,
    intrinsics: PinholeIntrinsics,
    camera_to_world: Float[np.ndarray, "4 4"],
    supersampling: int,
    lens: Lens | None = None,
    lighting: Lighting | None = None,
) -> Rendering:
    """An image of a camera; a pixel is the mean over ``supersampling``² evenly spaced rays (a box filter).

    Args:
        renderer: the parts.
        intrinsics: of the camera.
        camera_to_world: pose of the camera, OpenGL axes, metres.
        supersampling: rays per pixel along each side.
        lens: bends the rays of the pinhole camera.
        lighting: light on the parts of ``renderer``; even light by default.
    """
    size = intrinsics.h, intrinsics.w
    weights = np.empty((*size, len(renderer.materials)), np.float32)
    coverage = np.empty(size, np.float32)
    colours, light_of_rows = single_colours(renderer), []
    for rows, hits in renderer.camera_hits(intrinsics, camera_to_world, supersampling, lens):
        weights[rows] = renderer.material_weights(hits).reshape(-1, intrinsics.w, len(renderer.materials))
        coverage[rows] = hits.mean(hits.is_object).reshape(-1, intrinsics.w)
        if lighting is not None:
            light, colours = lighting.light(hits, camera_to_world)
            light_of_rows.append(light.reshape(-1, intrinsics.w, len(colours)))
    return Rendering(weights, coverage, np.concatenate(light_of_rows) if lighting else weights, colours)


class Lighting:
    """The light on the parts of a renderer under some effects; view-independent light is computed once, here."""

    def __init__(self, renderer: Renderer, effects: Sequence[LightEffect]) -> None:
        self._on_view = of_kind(effects, ViewLightEffect)
        self._renderer = renderer
        self._light = even_light(Surface(self._renderer))
        for effect in of_kind(effects, SurfaceLightEffect):
            self._light = effect.on_surface(self._light)

    def light(
        self, hits: Hits, camera_to_world: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "pixels colours"], tuple[Colour, ...]]:
        """The light of each pixel as weights of colours, and the colours."""
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
