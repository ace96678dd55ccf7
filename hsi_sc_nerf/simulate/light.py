"""Light as a sum of few colours: at the surface, at the points that a camera sees, and on the sensor.

Radiance is relative to that of the white tarp under the lamps at the start of the session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.surface import Surface

SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7  # h c / k_B


def lamp_photons(wavelengths_nm: Float[np.ndarray, "*shape"], temperature_k: float) -> Float[np.ndarray, "*shape"]:
    """Photon spectrum of a tungsten lamp, relative: Planck's law in photons, 1 / (l^4 (exp(c2 / (l T)) - 1))."""
    exponent = SECOND_RADIATION_CONSTANT_NM_K / (wavelengths_nm * temperature_k)
    return (wavelengths_nm / 1000.0) ** -4 / np.expm1(exponent)


@dataclass(frozen=True)
class Colour:
    """Light of the white tarp that was reflected by each of some materials, and of some bands only.

    Attributes:
        materials: columns of the endmembers whose reflectances are multiplied, in rising order; of none, it is white.
        bands: (wavelength in nm, factor) of points between which the factor runs straight, level outside them;
            without any, the factor is 1.
    """

    materials: tuple[int, ...]
    bands: tuple[tuple[float, float], ...] = ()

    def reflected_by(self, material: int) -> Colour:
        """The colour after one more reflection."""
        return Colour(tuple(sorted((*self.materials, material))), self.bands)

    def spectrum(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
    ) -> Float[np.ndarray, "*samples bands"]:
        """Its radiance relative to the white tarp's."""
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
    """The spectra of several colours, stacked."""
    return np.stack([colour.spectrum(endmembers, wavelengths_nm) for colour in colours], axis=-2)


@dataclass(frozen=True)
class Light:
    """``weights @ spectra``, times each of the illumination factors.

    Attributes:
        weights: how much of each colour each pixel sees.
        spectra: of those colours, relative to the white tarp's; one table, or one for each sample of a line.
        illumination: factors that broadcast to (lines, samples, bands).
    """

    weights: Float[np.ndarray, "lines samples colours"]
    spectra: Float[np.ndarray, "*samples colours bands"]
    illumination: tuple[Float[np.ndarray, "#lines #samples #bands"], ...] = ()

    def radiance(
        self, rows: slice | None = None, signal_of_white: Float[np.ndarray, "*samples bands"] | float = 1.0
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Radiance of some (by default all) lines, float32.

        It is relative to the white tarp's under the lamps at the session's start; with ``signal_of_white`` (counts
        above dark) it is in counts instead.
        """
        rows = rows or slice(None)
        signal = np.asarray(signal_of_white)
        spectra = (self.spectra * (signal[..., None, :] if signal.ndim else signal)).astype(np.float32)
        weights = self.weights[rows].astype(np.float32, copy=False)
        if spectra.ndim == 2:
            # One large product: many small ones lose their time between the cores.
            radiance = (weights.reshape(-1, len(spectra)) @ spectra).reshape(*weights.shape[:2], -1)
        else:
            # A table a sample: one product of matrices for each.
            radiance = np.matmul(weights.swapaxes(0, 1), spectra).swapaxes(0, 1).copy()
        for factor in self.illumination:
            radiance *= factor[rows] if len(factor) > 1 else factor
        return radiance


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
        """Fraction of each material at each point."""
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


def even_light(surface: Surface) -> SurfaceLight:
    """Irradiance 1 everywhere."""
    materials = surface.renderer.weights[surface.vertex]
    colours = tuple(Colour((i,)) for i in range(len(surface.renderer.materials)))
    return SurfaceLight(surface, colours, materials, materials)
