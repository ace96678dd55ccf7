"""Light that the object's smooth skin mirrors, the same in all bands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.colours import Colour
from hsi_sc_nerf.simulate.effects.stages import ViewLightEffect
from hsi_sc_nerf.simulate.reading import between

if TYPE_CHECKING:
    from hsi_sc_nerf.simulate.lighting import HitLight
    from hsi_sc_nerf.simulate.render import Hits


@dataclass(frozen=True)
class Gloss(ViewLightEffect):
    """The object (not its support) has a smooth clear skin over its matte body.

    The skin mirrors F of the light and lets 1 - F through, to the body and back (F: `fresnel`). In the mirror the
    chamber is seen where nothing else stands there, else nothing. With a `Lamp` there is its highlight as well, from
    a skin of fine facets, and its light reaches the body through the skin: the matte body under a skin of Kelemen and
    Szirmay-Kalos (2001), which is reciprocal, keeps all light of a white body, and for the chamber's even light is
    just 1 - F. A highlight may be brighter than the white tarp; all that a point sends is never more than it gets.
    """

    name: ClassVar[str] = "gloss"
    refractive_index: float = between(1.0, 3.0, default=1.45)
    """Of the skin; 1.45 is a plant's cuticle."""
    roughness: float = between(0.03, 1.0, default=0.25)
    """Width of the lamp's highlight: 0.03 almost a mirror, 1 almost matte (GGX's alpha)."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """Dim the body's light and add what the skin mirrors."""
        glossy = np.flatnonzero(hits.is_object)
        normals = hits.facing_normals[glossy]
        to_camera = -hits.directions[hits.ray[glossy]]
        cosine = np.einsum("nk,nk->n", normals, to_camera)
        mirrored_share = fresnel(cosine, self.refractive_index)
        mirror = 2.0 * cosine[:, None] * normals - to_camera

        chamber, lamp, of_chamber = light.chamber.copy(), light.lamp.copy(), np.zeros_like(light.chamber)
        chamber[glossy] *= 1.0 - mirrored_share
        of_chamber[glossy] = light.chamber[glossy] * mirrored_share * hits.is_free(mirror, glossy)
        mirrored = [(light.chamber_colour, of_chamber)]
        if light.to_lamp is not None:
            cosine_to_lamp = np.maximum(normals @ light.to_lamp, 0.0)
            through = (1.0 - fresnel(cosine_to_lamp, self.refractive_index)) * (1.0 - mirrored_share)
            lamp[glossy] *= through / (1.0 - mean_fresnel(self.refractive_index))
            highlight = np.zeros_like(light.lamp)
            highlight[glossy] = light.lamp[glossy] * np.pi * self.highlight(normals, to_camera, light.to_lamp)
            mirrored.append((Colour(()), highlight))
        return replace(light, chamber=chamber, lamp=lamp, mirrored=(*light.mirrored, *mirrored))

    def highlight(
        self,
        normals: Float[np.ndarray, "n 3"],
        to_camera: Float[np.ndarray, "n 3"],
        to_lamp: Float[np.ndarray, "*n 3"],
    ) -> Float[np.ndarray, "n"]:
        """The skin's reflection from the lamp to the camera (BRDF, 1/sr), both above it: Walter et al. (2007).

        GGX facets with Smith's shadowing, with Schlick's Fresnel of each facet.
        """
        half = to_camera + to_lamp
        half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
        to_camera_cosine = np.maximum(np.einsum("nk,nk->n", normals, to_camera), 1e-6)
        to_lamp_cosine = np.maximum((normals * to_lamp).sum(axis=-1), 1e-6)
        half_cosine = np.einsum("nk,nk->n", normals, half)
        squared = self.roughness**2
        facets = squared / (np.pi * (half_cosine**2 * (squared - 1.0) + 1.0) ** 2)
        shadowing = 1.0
        for cosine in (to_camera_cosine, to_lamp_cosine):
            shadowing = shadowing * 2.0 * cosine / (cosine + np.sqrt(squared + (1.0 - squared) * cosine**2))
        facet_mirrors = fresnel(np.einsum("nk,nk->n", to_camera, half), self.refractive_index)
        return facet_mirrors * facets * shadowing / (4.0 * to_camera_cosine * to_lamp_cosine)


def fresnel(cosine: Float[np.ndarray, "*n"], refractive_index: float) -> Float[np.ndarray, "*n"]:
    """Share of unpolarised light that a smooth surface mirrors, in [0, 1], by Schlick (1994)."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


def mean_fresnel(refractive_index: float) -> float:
    """Share that it mirrors of light that comes evenly from everywhere: the cosine-weighted mean of `fresnel`."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) / 21.0


def _at_normal(refractive_index: float) -> float:
    return ((refractive_index - 1.0) / (refractive_index + 1.0)) ** 2
