"""Effects of the object: drying, shrinkage, gloss and subsurface scattering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import Colour, HitLight, SurfaceLight, SurfaceLightEffect, ViewLightEffect
from hsi_sc_nerf.simulate.materials import Material, PlantTissue, water_absorbance
from hsi_sc_nerf.simulate.render import Hits

SHARP_NM, WIDTH_NM = 400.0, 1000.0
LEVELS = 2
"""Number of widths at which diffused light is computed; between them it is interpolated linearly."""


@dataclass(frozen=True)
class Drying(Effect):
    """Plant tissue loses water at a constant rate, and its water absorption bands (970 nm and others) fade.

    Materials with a measured spectrum do not change, because their water content is not known.
    """

    name: ClassVar[str] = "drying"
    water_loss: float = between(0.0, 1.0, default=0.3)
    """Fraction of the water that is lost at the end of the session."""

    def spectra(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        materials: Sequence[Material],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
        elapsed: float,
    ) -> Float[np.ndarray, "*samples materials bands"]:
        """Reflectance of the object's materials at time ``elapsed``, in [0, 1], without the lost water."""
        water = np.array([m.water if isinstance(m, PlantTissue) else 0.0 for m in materials])
        lost = self.water_loss * elapsed * water[:, None] * water_absorbance(wavelengths_nm)[..., None, :]
        # Rounding must not lift a reflectance above 1.
        return np.minimum(endmembers * 10.0**lost, 1.0)


@dataclass(frozen=True)
class Deformation(Effect):
    """The object shrinks at a constant rate towards the point on which it stands."""

    name: ClassVar[str] = "deformation"
    shrink_percent: float = between(0.0, 50.0, default=2.0)
    """Loss of height and width over the session, percent."""

    def deform(
        self, vertices: Float[np.ndarray, "v 3"], foot_m: Float[np.ndarray, "3"], elapsed: float
    ) -> Float[np.ndarray, "v 3"]:
        """Vertices at time ``elapsed``, in [0, 1]; the object stands on the point ``foot_m``."""
        return foot_m + (1.0 - self.shrink_percent / 100.0 * elapsed) * (vertices - foot_m)


@dataclass(frozen=True)
class Gloss(ViewLightEffect):
    """The object (not its support) has a smooth transparent coat over its matte body.

    The coat reflects the fraction F (`fresnel`) of the light and transmits 1 - F to the body and back. It mirrors the
    chamber where the mirror direction is unoccluded, and nothing elsewhere. A `Lamp` adds a highlight of GGX facets;
    its light reaches the body through the coat as in Kelemen and Szirmay-Kalos (2001), which is reciprocal and
    conserves energy. A highlight can be brighter than the white tarp.
    """

    name: ClassVar[str] = "gloss"
    refractive_index: float = between(1.0, 3.0, default=1.45)
    """Refractive index of the coat; 1.45 is that of a plant cuticle."""
    roughness: float = between(0.03, 1.0, default=0.25)
    """GGX roughness alpha of the lamp's highlight: 0.03 is nearly a mirror, 1 nearly matte."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """Attenuate the light of the body and add the mirrored light."""
        glossy = np.flatnonzero(hits.is_object)
        normals = hits.facing_normals[glossy]
        to_camera = -hits.directions[hits.ray[glossy]]
        cosine = np.einsum("nk,nk->n", normals, to_camera)
        reflectance = fresnel(cosine, self.refractive_index)
        mirror = 2.0 * cosine[:, None] * normals - to_camera

        chamber, lamp, of_chamber = light.chamber.copy(), light.lamp.copy(), np.zeros_like(light.chamber)
        chamber[glossy] *= 1.0 - reflectance
        of_chamber[glossy] = light.chamber[glossy] * reflectance * hits.is_unoccluded(mirror, glossy)
        mirrored = [(light.chamber_colour, of_chamber)]
        if light.to_lamp is not None:
            cosine_to_lamp = np.maximum(normals @ light.to_lamp, 0.0)
            through = (1.0 - fresnel(cosine_to_lamp, self.refractive_index)) * (1.0 - reflectance)
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
        """BRDF (1/sr) of the coat for unit directions to lamp and camera: GGX facets, Walter et al. (2007).

        Shadowing is Smith's, the reflectance of each facet Schlick's.
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
    """Fraction of unpolarised light that a smooth surface reflects, in [0, 1], after Schlick (1994)."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


def mean_fresnel(refractive_index: float) -> float:
    """Cosine-weighted mean of `fresnel` over the half space, in [0, 1]."""
    at_normal = _at_normal(refractive_index)
    return at_normal + (1.0 - at_normal) / 21.0


def _at_normal(refractive_index: float) -> float:
    return ((refractive_index - 1.0) / (refractive_index + 1.0)) ** 2


@dataclass(frozen=True)
class Translucency(SurfaceLightEffect):
    """Light scatters below the surface of the object, which blurs patterns and shading at long wavelengths.

    The light of a matte surface diffuses over the surface of the object. The standard deviation grows linearly from 0
    at 400 nm to ``width_mm`` at 1000 nm, and the total over the surface stays the same. No light passes to the
    support, and cast shadows of the lamp stay sharp.
    """

    name: ClassVar[str] = "translucency"
    width_mm: float = between(0.1, 20.0, default=2.0)
    """Standard deviation along the surface at 1000 nm, millimetres."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Add, for each colour of the object, one diffused copy for each width and its weight in each band."""
        surface = light.surface
        on_object = surface.is_object[:, None]
        of_object = [i for i, lit in enumerate(light.chamber_lit.T) if lit[surface.is_object].any()]
        sharp = [lit[:, of_object] * on_object for lit in (light.chamber_lit, light.lamp_lit)]
        plain = [lit * ~on_object for lit in (light.chamber_lit, light.lamp_lit)]
        colours, columns = list(light.colours), [[lit] for lit in plain]
        for level, bands in enumerate(_band_weights()):
            colours += [replace(light.colours[i], bands=bands) for i in of_object]
            both = np.concatenate(sharp, axis=1)
            if level > 0:
                both = surface.spread_over_object(both, 1e-3 * self.width_mm * level / LEVELS)
            for lit, softened in zip(columns, np.split(both, 2, axis=1), strict=True):
                lit.append(softened)
        chamber_lit, lamp_lit = (np.concatenate(lit, axis=1) for lit in columns)
        return replace(light, colours=tuple(colours), chamber_lit=chamber_lit, lamp_lit=lamp_lit)


def _band_weights() -> list[tuple[tuple[float, float], ...]]:
    """Weight of each width over wavelength, as (nm, weight) nodes of a polyline; weights sum to 1 everywhere."""
    nodes_nm = [SHARP_NM + (WIDTH_NM - SHARP_NM) * i / LEVELS for i in range(LEVELS + 1)]
    return [tuple((nm, float(i == j)) for j, nm in enumerate(nodes_nm)) for i in range(LEVELS + 1)]
