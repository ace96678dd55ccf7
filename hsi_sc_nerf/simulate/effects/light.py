"""Effects of light: occlusion of the diffuse chamber, inter-reflection, a directional lamp and gloss.

The chamber is infinitely far away and has the same radiance in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import HitLight, Reflection, SurfaceLight, SurfaceLightEffect, ViewLightEffect
from hsi_sc_nerf.simulate.render import Hits
from hsi_sc_nerf.simulate.surface import SceneSurface

DIRECTIONS = 96
"""Default number of directions in which the surroundings of a point are sampled."""


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
        visibility, _ = light.surface.surroundings(self.directions)
        return replace(light, chamber_lit=light.chamber_lit * visibility.astype(np.float32)[:, None])


@dataclass(frozen=True)
class InterReflection(SurfaceLightEffect):
    """Object, container and disc illuminate each other by diffuse reflections.

    Irradiance is that of the visible chamber, as in `ChamberShading`, plus the light of the occluders. The occluders
    are lit as without this effect: evenly, or as `ChamberShading` determines if it is on. The back of a surface sends
    no light. The light of a `Lamp` is reflected as well.
    """

    name: ClassVar[str] = "inter_reflection"
    directions: int = between(8, 4096, default=DIRECTIONS)
    """Directions sampled at each point; the error is inversely proportional to it, the time proportional."""
    bounces: int = between(1, 8, default=1)
    """Reflections that light is followed over."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """Add one colour for each set of materials that light meets on its way."""
        visibility, form_factors = light.surface.surroundings(self.directions)
        plain = light.materials * visibility.astype(np.float32)[:, None]
        reflect = Reflection(form_factors, self.bounces)
        bounced = reflect(light.colours, light.chamber_lit, light.materials)
        chamber_lit = np.column_stack([plain, *bounced.values()])
        lamp_lit = np.zeros_like(chamber_lit)
        lamp_lit[:, : plain.shape[1]] = light.lamp_lit
        colours = (*light.colours, *bounced)
        return replace(light, colours=colours, chamber_lit=chamber_lit, lamp_lit=lamp_lit, reflection=reflect)


@dataclass(frozen=True)
class Lamp(ViewLightEffect):
    """Part of the light comes from a direction that is fixed relative to the camera, and casts shadows.

    The rays of the lamp are parallel. Its irradiance is ``fraction`` times the cosine between normal and lamp
    direction where the lamp is visible; the chamber provides ``1 - fraction``. A white tarp that faces the lamp keeps
    irradiance 1. The visible wall of the chamber does not change.
    """

    name: ClassVar[str] = "lamp"
    fraction: float = between(0.0, 1.0, default=0.4)
    """Fraction of the lamp in the light on a white tarp that faces it."""
    azimuth_deg: float = between(-180.0, 180.0, default=-35.0)
    """Azimuth of the lamp, degrees: 0 is behind the camera; positive turns towards the right edge of the camera's
    picture, negative towards the left."""
    elevation_deg: float = between(-90.0, 90.0, default=30.0)
    """Elevation of the lamp above the optical axis of the camera, degrees."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """Replace part of the chamber's light by the lamp's."""
        to_lamp = self.direction(camera_to_world)
        cosine = hits.facing_normals @ to_lamp
        lit = np.flatnonzero(cosine > 0.0)
        lamp = np.zeros_like(light.lamp)
        is_free = hits.renderer.is_free(hits.positions()[lit], hits.facing_normals[lit], to_lamp)
        lamp[lit] = self.fraction * cosine[lit] * is_free
        return replace(light, chamber=light.chamber * np.float32(1.0 - self.fraction), lamp=lamp, to_lamp=to_lamp)

    def on_points(self, surface: SceneSurface, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "p"]:
        """Irradiance of the lamp at the points of a surface."""
        to_lamp, normals = self.direction(camera_to_world), surface.mesh.vertex_normals()
        is_free = surface.renderer.is_free(surface.mesh.vertices, normals, to_lamp)
        return self.fraction * np.maximum(normals @ to_lamp, 0.0) * is_free

    def direction(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Unit vector from the object to the lamp, object frame."""
        azimuth, elevation = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        in_camera = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        return camera_to_world[:3, :3] @ in_camera


@dataclass(frozen=True)
class Gloss(ViewLightEffect):
    """The object (not its support) has a smooth transparent coat over its matte body.

    The coat reflects the fraction F (`fresnel`) of the light and transmits 1 - F to the body and back. It mirrors the
    chamber or what hides it, once. A `Lamp` adds a highlight of GGX facets; its light reaches the body through the
    coat as in Kelemen and Szirmay-Kalos (2001), which is reciprocal and conserves energy. A highlight can be brighter
    than the white tarp.
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

        lamp, of_chamber, body = light.lamp.copy(), np.zeros_like(light.chamber), np.ones_like(light.chamber)
        body[glossy] -= reflectance
        onwards, of_ray = hits.onwards(mirror, glossy), np.zeros(len(hits.directions), np.float32)
        of_ray[hits.ray[glossy]] = reflectance
        open_rays = np.isin(hits.ray[glossy], onwards.ray, invert=True)
        of_chamber[glossy] = light.chamber[glossy] * reflectance * open_rays
        mirrored = [(light.chamber_colour, of_chamber)]
        if light.to_lamp is not None:
            cosine_to_lamp = np.maximum(normals @ light.to_lamp, 0.0)
            through = (1.0 - fresnel(cosine_to_lamp, self.refractive_index)) * (1.0 - reflectance)
            lamp[glossy] *= through / (1.0 - mean_fresnel(self.refractive_index))
            highlight = np.zeros_like(light.lamp)
            highlight[glossy] = light.lamp[glossy] * np.pi * self.highlight(normals, to_camera, light.to_lamp)
            mirrored.append(((), highlight))
        return replace(
            light,
            chamber=light.chamber * body,
            lamp=lamp,
            reflections=light.reflections * body,
            mirrored=(*light.mirrored, *mirrored),
            mirrored_hits=(onwards, of_ray[onwards.ray]),
        )

    def highlight(
        self,
        normals: Float[np.ndarray, "n 3"],
        to_camera: Float[np.ndarray, "n 3"],
        to_lamp: Float[np.ndarray, "*n 3"],
    ) -> Float[np.ndarray, "n"]:
        """BRDF (1/sr) of the coat for unit directions to lamp and camera: GGX facets, Walter et al. (2007).

        Shadowing is Smith's, the reflectance of each facet Schlick's.
        """
        half = unit_vectors(to_camera + to_lamp)
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


EFFECTS: tuple[type[Effect], ...] = (ChamberShading, InterReflection, Lamp, Gloss)
"""The effects in the order in which they act."""
