"""From a scene to the counts and the truth of its captures, one at a time and in any order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt16

from hsi_sc_nerf import paper
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.effect import effect_rng, find_effect, of_kind
from hsi_sc_nerf.simulate.effects import detector
from hsi_sc_nerf.simulate.effects.detector import ExposureEffect, ReadoutEffect, SpectralSmile
from hsi_sc_nerf.simulate.effects.image import (
    Drying,
    IlluminationEffect,
    ImageRotation,
    LensDistortion,
    OpticalBlur,
    TexturedBackground,
)
from hsi_sc_nerf.simulate.light import Light, LightEffect, Lighting, SurfaceLightEffect, colour_spectra, render
from hsi_sc_nerf.simulate.materials import MATERIALS, endmembers
from hsi_sc_nerf.simulate.render import exact_weights
from hsi_sc_nerf.simulate.scene import Scene

WHITE_MATERIALS = ("white_tarp", "tarp_surround")
TARP_MARGIN = 0.08
"""Width of the margin around the tarp as a fraction of the image side."""
PERFECT_DARK_LINES, DARK_LINES = 1, 64
"""Lines of a dark cube: of a perfect sensor, whose lines are equal, and of a sensor with read-out effects."""
WHITE_EXPOSURE = 0
"""Exposure number of the white tarp; the frames have the following numbers."""
LIGHT_SPACING_M = 0.0025
"""Largest distance of the surface points at which light is computed; it is interpolated between them."""
LINES_AT_ONCE = 64
"""Lines of an image that are exposed at a time, which bounds the memory."""


@dataclass(frozen=True)
class SimulatedCapture:
    """The cubes of one capture and the light that they record.

    Attributes:
        counts: raw counts.
        dark: counts of the dark cube.
        light: noise-free light on the sensor, rotated as the counts are.
        integration_time_ms: integration time.
    """

    counts: UInt16[np.ndarray, "lines samples bands"]
    dark: UInt16[np.ndarray, "dark_lines samples bands"]
    light: Light
    integration_time_ms: float


@dataclass(frozen=True)
class SimulatedFrame(SimulatedCapture):
    """A capture of the object, and its truth as upright images.

    Attributes:
        material_weights: fraction of each material in each pixel, summing to 1.
        coverage: fraction of each pixel that the object covers.
    """

    material_weights: Float[np.ndarray, "lines samples materials"]
    coverage: Float[np.ndarray, "lines samples"]


class Simulation:
    """A scene ready for its captures, which `frame` and `white` simulate in any order and from several threads.

    Attributes:
        plan: the frames.
        captures: their names.
        materials: names of the columns of the frames' material weights.
        endmembers: reflectance of the materials at the start of the session at the header's wavelengths.
        object_part: the scanned object, object frame.
        detector_maps: maps of each read-out effect by its name.

    Example:
        >>> simulation = Simulation(load_scene("pear"))
        >>> simulation.frame(0).counts.shape
        (128, 128, 204)
    """

    def __init__(self, scene: Scene) -> None:
        effects, size_px = scene.effects, scene.camera.size_px
        self.scene = scene
        self.plan = assemble.frame_plan(scene)
        self.intrinsics = assemble.intrinsics(scene.camera)
        self.lens = find_effect(effects, LensDistortion)
        self._blur = find_effect(effects, OpticalBlur)
        self._rotation = find_effect(effects, ImageRotation)
        self._drying = find_effect(effects, Drying)
        self._illumination = of_kind(effects, IlluminationEffect)
        self._exposures = of_kind(effects, ExposureEffect)
        self._readout = of_kind(effects, ReadoutEffect)

        self.object_part = assemble.object_part(scene)
        background = find_effect(effects, TexturedBackground)
        lights = tuple(effect for effect in effects if isinstance(effect, LightEffect))
        self.renderer = assemble.build_renderer(
            scene,
            self.object_part,
            background.materials if background else (),
            LIGHT_SPACING_M if of_kind(lights, SurfaceLightEffect) else None,
        )
        self._lighting = Lighting(self.renderer, lights) if lights else None
        self.materials = self.renderer.materials
        self._background = None
        if background:
            # The pattern replaces the chamber, which is the last material.
            pattern = background.cover(size_px, self.materials, effect_rng(scene.seed, background))
            self._background = pattern - np.eye(len(self.materials))[-1]
        self._object_materials = [(MATERIALS | scene.materials)[name] for name in self.object_part.materials]
        self.camera_to_world = self.plan.camera_to_world
        self.captures = tuple(f"{scene.name}_{i:03d}" for i in range(len(self.camera_to_world)))
        self.wavelengths_nm = detector.band_centres_nm(scene.sensor.bands)
        smile = find_effect(effects, SpectralSmile)
        self._detector_nm = smile.wavelengths_nm(self.wavelengths_nm, size_px) if smile else self.wavelengths_nm
        self._signal_of_white = detector.white_signal(scene.sensor, self._detector_nm)
        self.detector_maps = {
            effect.name: effect.detector_maps(size_px, scene.sensor.bands, effect_rng(scene.seed, effect))
            for effect in self._readout
        }
        self.endmembers = endmembers(self.materials, self.wavelengths_nm, scene.materials)
        self._detector_endmembers = self._detector_reflectance(self.materials)

    def frame(self, number: int) -> SimulatedFrame:
        """Simulate one frame of the plan."""
        elapsed = float(self.plan.elapsed[number])
        lens = self.lens.straighten if self.lens else None
        view = self.intrinsics, self.camera_to_world[number], self.scene.camera.supersampling, lens
        rendering = render(self.renderer, *view, self._lighting)
        weights, light_weights = rendering.material_weights, rendering.light_weights
        if self._background is not None:
            count = len(self.materials)
            if self._lighting is not None:
                light_weights[..., :count] += light_weights[..., count - 1, None] * self._background
            weights = exact_weights((weights + weights[..., -1:] * self._background).reshape(-1, count))
            weights = weights.reshape(*rendering.coverage.shape, count)
            if self._lighting is None:
                light_weights = weights
        spectra = self._detector_endmembers
        if self._drying:
            of_object = [self.materials.index(name) for name in self.object_part.materials]
            spectra = spectra.copy()
            spectra[..., of_object, :] = self._drying.spectra(
                spectra[..., of_object, :], self._object_materials, self._detector_nm, elapsed
            )
        light = Light(light_weights, colour_spectra(rendering.colours, spectra))
        light = self._on_sensor(light, elapsed)
        counts, dark = self._expose(light, number + 1)
        time_ms = self._integration_time_ms(of_white=False)
        return SimulatedFrame(counts, dark, light, time_ms, weights, rendering.coverage)

    def white(self) -> SimulatedCapture:
        """Simulate the capture of the white tarp before the first frame."""
        weights = white_capture_weights(self.scene.camera.size_px)
        light = self._on_sensor(Light(weights, self._detector_reflectance(WHITE_MATERIALS)), elapsed=0.0)
        return SimulatedCapture(*self._expose(light, WHITE_EXPOSURE), light, self._integration_time_ms(of_white=True))

    def _exposure_factor(self, of_white: bool) -> float:
        return math.prod(exposure.factor(of_white) for exposure in self._exposures)

    def _integration_time_ms(self, of_white: bool) -> float:
        return paper.INTEGRATION_TIME_MS * self._exposure_factor(of_white)

    def _detector_reflectance(self, names: Sequence[str]) -> Float[np.ndarray, "*samples materials bands"]:
        """Reflectance at the detector's wavelengths: one table, or one for each sample under a spectral smile."""
        return np.moveaxis(endmembers(names, self._detector_nm, self.scene.materials), 0, -2)

    def _on_sensor(self, light: Light, elapsed: float) -> Light:
        """The light after optics and illumination at time ``elapsed``, rotated as in the file."""
        weights = self._blur.image(light.weights) if self._blur else light.weights
        size_px = self.scene.camera.size_px
        lamp_k = self.scene.sensor.lamp_temperature_k
        factors = tuple(e.factor(size_px, self.wavelengths_nm, lamp_k, elapsed) for e in self._illumination)
        if self._rotation:
            weights, factors = self._rotation.orient(weights), tuple(map(self._rotation.orient, factors))
        return replace(light, weights=weights, illumination=factors)

    def _expose(
        self, light: Light, exposure: int
    ) -> tuple[UInt16[np.ndarray, "lines samples bands"], UInt16[np.ndarray, "dark_lines samples bands"]]:
        """Counts of an image and of its dark cube."""
        lines, samples = light.weights.shape[:2]
        bands = len(self.wavelengths_nm)
        signal_of_white = self._signal_of_white * self._exposure_factor(of_white=exposure == WHITE_EXPOSURE)
        counts = np.empty((lines, samples, bands), np.uint16)
        random = [effect_rng(self.scene.seed, effect, exposure, 0) for effect in self._readout]
        for first in range(0, lines, LINES_AT_ONCE):
            rows = slice(first, first + LINES_AT_ONCE)
            counts[rows] = self._digitise(light.radiance(rows, signal_of_white), random)
        random = [effect_rng(self.scene.seed, effect, exposure, 1) for effect in self._readout]
        dark_lines = DARK_LINES if self._readout else PERFECT_DARK_LINES
        dark = self._digitise(np.zeros((dark_lines, samples, bands), np.float32), random)
        return counts, dark

    def _digitise(
        self, signal: Float[np.ndarray, "lines samples bands"], random: list[np.random.Generator]
    ) -> UInt16[np.ndarray, "lines samples bands"]:
        """Digitised counts of a signal in counts above dark, which is overwritten."""
        counts = signal
        counts += self.scene.sensor.dark_level
        for effect, rng in zip(self._readout, random, strict=True):
            counts = effect.read_out(counts, self.scene.sensor, self.detector_maps[effect.name], rng)
        return detector.digitise(counts, self.scene.sensor)


def white_capture_weights(size_px: int) -> Float[np.ndarray, "lines samples 2"]:
    """Fractions of the tarp, which fills most of the image, and of its dark surroundings."""
    edge = max(1, round(TARP_MARGIN * size_px))
    tarp = np.zeros((size_px, size_px), np.float32)
    tarp[edge:-edge, edge:-edge] = 1.0
    return np.stack([tarp, 1.0 - tarp], axis=-1)
