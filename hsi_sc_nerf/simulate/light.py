"""Light as a sum of few colours: at the surface, at the points that a camera sees, and on the sensor.

Radiance is relative to that of the white tarp under the lamps at the start of the session. Without light effects
every point has the irradiance 1, that of the white tarp, so its radiance is its reflectance. With them the light of a
pixel is the mean over its rays of

    chamber * chamber_lit + lamp * lamp_lit + mirrored

where ``chamber_lit`` and ``lamp_lit`` belong to the surface (`SurfaceLight`), and the factors ``chamber`` and
``lamp`` and the mirrored light depend on the view (`HitLight`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.simulate.effect import Effect, of_kind
from hsi_sc_nerf.simulate.render import Hits, Lens, Renderer
from hsi_sc_nerf.simulate.surface import SceneSurface

SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7  # h c / k_B
FAINT = 1e-3
"""Largest weight of a colour of three materials or more that is neglected."""
Colour: TypeAlias = tuple[int, ...]
"""Materials (columns of the endmembers), ascending, whose reflectances are multiplied; white if empty."""


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
        camera_to_world: pose of the camera, OpenGL axes, metres.
        lighting: light on the parts of ``renderer``; even light by default.
    """
    size = intrinsics.h, intrinsics.w
    weights = np.empty((*size, len(renderer.materials)), np.float32)
    coverage = np.empty(size, np.float32)
    colours, light_of_rows = _single_colours(renderer), []
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
        self._light = even_light(SceneSurface(self._renderer))
        for effect in of_kind(effects, SurfaceLightEffect):
            self._light = effect.on_surface(self._light)

    def light(
        self, hits: Hits, camera_to_world: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "pixels colours"], tuple[Colour, ...]]:
        """The light of each pixel as weights of colours, and the colours."""
        chamber, surface = len(self._renderer.materials) - 1, self._light.surface
        at_hits = self._at_hits(hits, camera_to_world)
        colours = (*self._light.colours, *(colour for colour, _ in at_hits.mirrored))
        light = np.zeros((hits.pixels, len(colours)), np.float32)
        of_surface = light[:, : len(self._light.colours)]
        seen = [(hits, np.ones(len(hits.ray)), at_hits)]
        if at_hits.mirrored_hits is not None:
            onwards, fraction = at_hits.mirrored_hits
            seen.append((onwards, fraction, self._at_hits(onwards, camera_to_world)))
        of_lamps = self._reflected_lamps(camera_to_world)
        for there, fraction, lit in seen:
            for factor, unit in ((lit.chamber, self._light.chamber_lit), (lit.lamp, self._light.lamp_lit)):
                if factor.any():
                    of_surface += there.mix(surface.triangles, len(unit), fraction * factor) @ unit
            if of_lamps is not None:
                of_surface += there.mix(surface.triangles, len(of_lamps), fraction * lit.reflections) @ of_lamps
        light[:, chamber] = 1.0 - hits.mean(np.ones(len(hits.ray)))
        for i, (_, mirrored) in enumerate(at_hits.mirrored, start=len(self._light.colours)):
            light[:, i] = hits.mean(mirrored)
        return light, colours

    def _at_hits(self, hits: Hits, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        count, chamber = len(hits.ray), len(self._renderer.materials) - 1
        ones = np.ones(count, np.float32)
        light = HitLight(ones, np.zeros(count, np.float32), ones, None, (chamber,))
        for effect in self._on_view:
            light = effect.at_hits(hits, light, camera_to_world)
        return light

    def _reflected_lamps(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "p colours"] | None:
        """Light of lamps that leaves the surface after two reflections or more, as weights of its colours."""
        surface, reflection = self._light.surface, self._light.reflection
        by_lamps = [effect.on_points(surface, camera_to_world) for effect in self._on_view]
        if reflection is None or not any(np.any(lit) for lit in by_lamps):
            return None
        materials = self._light.materials
        leaving = materials * np.asarray(sum(by_lamps), np.float32)[:, None]
        reflected = reflection(_single_colours(self._renderer), leaving, materials)
        weights = np.zeros_like(self._light.lamp_lit)
        for column, colour in enumerate(self._light.colours):
            # Faint colours may be neglected in one light and not in the other.
            weights[:, column] += reflected.get(colour, 0.0)
        return weights


@dataclass(frozen=True)
class Light:
    """Noise-free light on the sensor: ``weights @ spectra`` times all illumination factors.

    Attributes:
        weights: amount of each colour in each pixel.
        spectra: radiance of the colours: one table, or one for each sample of a line.
        illumination: factors that broadcast to (lines, samples, bands).
    """

    weights: Float[np.ndarray, "lines samples colours"]
    spectra: Float[np.ndarray, "*samples colours bands"]
    illumination: tuple[Float[np.ndarray, "#lines #samples #bands"], ...] = ()

    def radiance(
        self, rows: slice | None = None, signal_of_white: Float[np.ndarray, "*samples bands"] | float = 1.0
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Radiance of some lines, float32.

        Args:
            rows: image lines; all by default.
            signal_of_white: counts above dark of the white tarp, for a radiance in counts.
        """
        rows = rows or slice(None)
        signal = np.asarray(signal_of_white)
        spectra = (self.spectra * (signal[..., None, :] if signal.ndim else signal)).astype(np.float32)
        weights = self.weights[rows].astype(np.float32, copy=False)
        if spectra.ndim == 2:
            # One large matrix product is faster than many small ones.
            radiance = (weights.reshape(-1, len(spectra)) @ spectra).reshape(*weights.shape[:2], -1)
        else:
            radiance = np.matmul(weights.swapaxes(0, 1), spectra).swapaxes(0, 1).copy()
        for factor in self.illumination:
            radiance *= factor[rows] if len(factor) > 1 else factor
        return radiance


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Radiance of each point of a surface, equal in all directions, as weights of colours.

    Attributes:
        surface: the points.
        colours: colour of each column; the first columns are the renderer's materials in their order.
        chamber_lit: weights under a chamber of radiance 1.
        lamp_lit: weights under a lamp of irradiance 1 at each point.
        reflection: how surfaces light each other; None if they do not.
    """

    surface: SceneSurface
    colours: tuple[Colour, ...]
    chamber_lit: Float[np.ndarray, "p colours"]
    lamp_lit: Float[np.ndarray, "p colours"]
    reflection: Reflection | None = None

    @property
    def materials(self) -> Float[np.ndarray, "p materials"]:
        """Fraction of each material at each point."""
        return self.surface.renderer.weights[self.surface.vertex]


@dataclass(frozen=True, eq=False)
class Reflection:
    """Diffuse reflections between the points of a surface.

    Attributes:
        form_factors: fraction of each point (column) in the view of each point (row).
        bounces: reflections that light is followed over.
    """

    form_factors: scipy.sparse.csr_array
    bounces: int

    def __call__(
        self, colours: Sequence[Colour], leaving: Float[np.ndarray, "p colours"], materials: np.ndarray
    ) -> dict[Colour, Float[np.ndarray, "p"]]:
        """Light that has been reflected since it left the surface, by colour.

        Args:
            colours: colours of the leaving light.
            leaving: weights of these colours at each point.
            materials: fraction of each material at each point.
        """
        total: dict[Colour, np.ndarray] = {}
        for bounce in range(self.bounces):
            arriving = (self.form_factors @ leaving).astype(np.float32)
            reflected: dict[Colour, np.ndarray] = {}
            for i, material in enumerate(materials.T):
                at = np.flatnonzero(material)
                for colour, of_neighbour in zip(colours, arriving.T, strict=True):
                    product = material[at] * of_neighbour[at]
                    if product.max(initial=0.0) > (FAINT if bounce else 0.0):
                        longer = tuple(sorted((*colour, i)))
                        reflected.setdefault(longer, np.zeros(len(materials), np.float32))[at] += product
            for colour, weights in reflected.items():
                total[colour] = total.get(colour, 0.0) + weights
            if not reflected:
                break
            colours, leaving = tuple(reflected), np.column_stack(list(reflected.values()))
        return total


@dataclass(frozen=True, eq=False)
class HitLight:
    """View-dependent factors on the light of a surface at the hits of one camera's rays.

    Attributes:
        chamber: factor on the light of the chamber.
        lamp: factor on the light of the lamp; includes its irradiance.
        reflections: factor on the lamp's light that comes by way of other surfaces.
        to_lamp: unit direction to the lamp; None without a lamp.
        chamber_colour: colour of the chamber.
        mirrored: mirrored light at each hit and its colour.
        mirrored_hits: where mirrored rays hit the scene itself, and the mirrored fraction of its light.
    """

    chamber: Float[np.ndarray, "hits"]
    lamp: Float[np.ndarray, "hits"]
    reflections: Float[np.ndarray, "hits"]
    to_lamp: Float[np.ndarray, "3"] | None
    chamber_colour: Colour
    mirrored: tuple[tuple[Colour, Float[np.ndarray, "hits"]], ...] = ()
    mirrored_hits: tuple[Hits, Float[np.ndarray, "mirrored"]] | None = None


class SurfaceLightEffect(Effect):
    """Changes the light that leaves the surface equally in all directions and rotates with the object."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """The light of the surface under the effect."""
        raise NotImplementedError


class ViewLightEffect(Effect):
    """Changes light that depends on the view; acts after all `SurfaceLightEffect`."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """The light under the effect at the hits of the camera's rays."""
        raise NotImplementedError

    def on_points(
        self, surface: SceneSurface, camera_to_world: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "p"] | float:
        """Irradiance that the effect adds at the points of a surface, which others reflect."""
        return 0.0


LightEffect: TypeAlias = SurfaceLightEffect | ViewLightEffect


def even_light(surface: SceneSurface) -> SurfaceLight:
    """The light of a surface under the irradiance 1 at every point."""
    materials = surface.renderer.weights[surface.vertex]
    return SurfaceLight(surface, _single_colours(surface.renderer), materials, materials)


def _single_colours(renderer: Renderer) -> tuple[Colour, ...]:
    """The colours of single materials, in the renderer's order."""
    return tuple((i,) for i in range(len(renderer.materials)))


def colour_spectra(
    colours: Sequence[Colour], endmembers: Float[np.ndarray, "*samples materials bands"]
) -> Float[np.ndarray, "*samples colours bands"]:
    """Radiance of several colours, stacked."""
    return np.stack([np.prod(endmembers[..., colour, :], axis=-2) for colour in colours], axis=-2)


def lamp_photons(wavelengths_nm: Float[np.ndarray, "*shape"], temperature_k: float) -> Float[np.ndarray, "*shape"]:
    """Relative photon spectrum of a tungsten lamp: Planck's law in photons, 1 / (l^4 (exp(c2 / (l T)) - 1))."""
    exponent = SECOND_RADIATION_CONSTANT_NM_K / (wavelengths_nm * temperature_k)
    return (wavelengths_nm / 1000.0) ** -4 / np.expm1(exponent)
