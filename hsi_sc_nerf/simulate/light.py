"""Light as a sum of few colours: at the surface, at the points that a camera sees, and on the sensor.

Radiance is relative to that of the white tarp under the lamps at the start of the session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.render import Hits, Renderer
from hsi_sc_nerf.simulate.surface import Surface

SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7  # h c / k_B


def lamp_photons(wavelengths_nm: Float[np.ndarray, "*shape"], temperature_k: float) -> Float[np.ndarray, "*shape"]:
    """Relative photon spectrum of a tungsten lamp: Planck's law in photons, 1 / (l^4 (exp(c2 / (l T)) - 1))."""
    exponent = SECOND_RADIATION_CONSTANT_NM_K / (wavelengths_nm * temperature_k)
    return (wavelengths_nm / 1000.0) ** -4 / np.expm1(exponent)


@dataclass(frozen=True)
class Colour:
    """A spectrum: the product of the reflectances of some materials and of a factor over wavelength.

    Attributes:
        materials: columns of the endmembers whose reflectances are multiplied, ascending; white if empty.
        bands: (wavelength in nm, factor) nodes of a polyline, constant outside its range; factor 1 if empty.
    """

    materials: tuple[int, ...]
    bands: tuple[tuple[float, float], ...] = ()

    def reflected_by(self, material: int) -> Colour:
        """The colour after a reflection by one more material."""
        return Colour(tuple(sorted((*self.materials, material))), self.bands)

    def spectrum(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
    ) -> Float[np.ndarray, "*samples bands"]:
        """Radiance of the colour."""
        spectrum = np.ones(wavelengths_nm.shape)
        for material in self.materials:
            spectrum = spectrum * endmembers[..., material, :]
        if self.bands:
            spectrum = spectrum * np.interp(wavelengths_nm, *np.transpose(self.bands))
        return spectrum


def colour_spectra(
    colours: Sequence[Colour],
    endmembers: Float[np.ndarray, "*samples materials bands"],
    wavelengths_nm: Float[np.ndarray, "*samples bands"],
) -> Float[np.ndarray, "*samples colours bands"]:
    """Spectra of several colours, stacked."""
    return np.stack([colour.spectrum(endmembers, wavelengths_nm) for colour in colours], axis=-2)


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
    """

    surface: Surface
    colours: tuple[Colour, ...]
    chamber_lit: Float[np.ndarray, "p colours"]
    lamp_lit: Float[np.ndarray, "p colours"]

    @property
    def materials(self) -> Float[np.ndarray, "p materials"]:
        """Fraction of each material at each point."""
        return self.surface.renderer.weights[self.surface.vertex]


@dataclass(frozen=True, eq=False)
class HitLight:
    """View-dependent factors on the light of a surface at the hits of one camera's rays.

    Attributes:
        chamber: factor on the light of the chamber.
        lamp: factor on the light of the lamp; includes its irradiance.
        to_lamp: unit direction to the lamp; None without a lamp.
        chamber_colour: colour of the chamber.
        mirrored: mirrored light at each hit and its colour.
    """

    chamber: Float[np.ndarray, "hits"]
    lamp: Float[np.ndarray, "hits"]
    to_lamp: Float[np.ndarray, "3"] | None
    chamber_colour: Colour
    mirrored: tuple[tuple[Colour, Float[np.ndarray, "hits"]], ...] = ()


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


LightEffect: TypeAlias = SurfaceLightEffect | ViewLightEffect


def even_light(surface: Surface) -> SurfaceLight:
    """The light of a surface under the irradiance 1 at every point."""
    materials = surface.renderer.weights[surface.vertex]
    return SurfaceLight(surface, single_colours(surface.renderer), materials, materials)


def single_colours(renderer: Renderer) -> tuple[Colour, ...]:
    """The colours of single materials, in the renderer's order."""
    return tuple(Colour((i,)) for i in range(len(renderer.materials)))
