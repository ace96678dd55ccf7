"""Effects of the object: it dries, shrinks, reflects like a mirror, and scatters light below its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effects.stages import DeformationEffect, MaterialEffect, SurfaceLightEffect, ViewLightEffect
from hsi_sc_nerf.simulate.light import Colour, HitLight, SurfaceLight
from hsi_sc_nerf.simulate.materials import Material, PlantTissue, water_absorbance
from hsi_sc_nerf.simulate.render import Hits

SHARP_NM, WIDTH_NM = 400.0, 1000.0
LEVELS = 2
"""Widths at which softened light is computed; in between it runs straight from one to the next."""


@dataclass(frozen=True)
class Drying(MaterialEffect):
    """Plant tissue loses water at a steady rate, and its water bands (970 nm and neighbours) fade.

    A material that a scene gives as a measured spectrum has no known water and keeps its colour.
    """

    name: ClassVar[str] = "drying"
    water_loss: float = between(0.0, 1.0, default=0.3)
    """Fraction of the water that is gone at the end of the session."""

    def spectra(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        materials: Sequence[Material],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
        elapsed: float,
    ) -> Float[np.ndarray, "*samples materials bands"]:
        """Take the lost water's absorbance away; reflectance stays below the tissue's plateau."""
        water = np.array([m.water if isinstance(m, PlantTissue) else 0.0 for m in materials])
        lost = self.water_loss * elapsed * water[:, None] * water_absorbance(wavelengths_nm)[..., None, :]
        return endmembers * 10.0**lost


@dataclass(frozen=True)
class Deformation(DeformationEffect):
    """The object shrinks at a steady rate towards the point that it stands on: it is no rigid body."""

    name: ClassVar[str] = "deformation"
    shrink_percent: float = between(0.0, 50.0, default=2.0)
    """Loss of height and width from the session's start to its end, percent."""

    def deform(
        self, vertices: Float[np.ndarray, "v 3"], foot_m: Float[np.ndarray, "3"], elapsed: float
    ) -> Float[np.ndarray, "v 3"]:
        """Scale about the foot."""
        return foot_m + (1.0 - self.shrink_percent / 100.0 * elapsed) * (vertices - foot_m)


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
        mirrored_fraction = fresnel(cosine, self.refractive_index)
        mirror = 2.0 * cosine[:, None] * normals - to_camera

        chamber, lamp, of_chamber = light.chamber.copy(), light.lamp.copy(), np.zeros_like(light.chamber)
        chamber[glossy] *= 1.0 - mirrored_fraction
        of_chamber[glossy] = light.chamber[glossy] * mirrored_fraction * hits.is_free(mirror, glossy)
        mirrored = [(light.chamber_colour, of_chamber)]
        if light.to_lamp is not None:
            cosine_to_lamp = np.maximum(normals @ light.to_lamp, 0.0)
            through = (1.0 - fresnel(cosine_to_lamp, self.refractive_index)) * (1.0 - mirrored_fraction)
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
    """Fraction of unpolarised light that a smooth surface mirrors, in [0, 1], by Schlick (1994)."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


def mean_fresnel(refractive_index: float) -> float:
    """Fraction that it mirrors of light that comes evenly from everywhere: the cosine-weighted mean of `fresnel`."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) / 21.0


def _at_normal(refractive_index: float) -> float:
    return ((refractive_index - 1.0) / (refractive_index + 1.0)) ** 2


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
        """Give each colour of the object a copy for each width, which counts in its fraction of the bands."""
        surface = light.surface
        on_object = surface.is_object[:, None]
        of_object = [i for i, lit in enumerate(light.chamber_lit.T) if lit[surface.is_object].any()]
        sharp = [lit[:, of_object] * on_object for lit in (light.chamber_lit, light.lamp_lit)]
        plain = [lit * ~on_object for lit in (light.chamber_lit, light.lamp_lit)]
        colours, columns = list(light.colours), [[lit] for lit in plain]
        for level, bands in enumerate(_fractions_of_bands()):
            colours += [replace(light.colours[i], bands=bands) for i in of_object]
            both = np.concatenate(sharp, axis=1)
            if level > 0:
                both = surface.spread_over_object(both, 1e-3 * self.width_mm * level / LEVELS)
            for lit, softened in zip(columns, np.split(both, 2, axis=1), strict=True):
                lit.append(softened)
        chamber_lit, lamp_lit = (np.concatenate(lit, axis=1) for lit in columns)
        return replace(light, colours=tuple(colours), chamber_lit=chamber_lit, lamp_lit=lamp_lit)


def _fractions_of_bands() -> list[tuple[tuple[float, float], ...]]:
    """Fraction of each width in each band, as points (nm, fraction) of a line; they sum to 1 in every band."""
    nodes_nm = [SHARP_NM + (WIDTH_NM - SHARP_NM) * i / LEVELS for i in range(LEVELS + 1)]
    return [tuple((nm, float(i == j)) for j, nm in enumerate(nodes_nm)) for i in range(LEVELS + 1)]
