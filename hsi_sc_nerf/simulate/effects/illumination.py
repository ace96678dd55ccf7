"""Effects of the lamps: drift, falloff towards the image edges, and a directional lamp that casts shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import HitLight, ViewLightEffect, lamp_photons
from hsi_sc_nerf.simulate.render import Hits

REFERENCE_NM = 700.0
"""Wavelength at which a change of colour temperature does not change the light."""


class IlluminationEffect(Effect):
    """Changes the light of the lamps over time or over the image, for object and white tarp alike."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "#lines #samples #bands"]:
        """Ratio of the light with and without the effect; 1 at the image centre at the start of the session."""
        raise NotImplementedError


@dataclass(frozen=True)
class DriftingLamps(IlluminationEffect):
    """The output of the lamps drifts exponentially after the capture of the white tarp."""

    name: ClassVar[str] = "lamp_drift"
    percent: float = between(-90.0, 900.0, default=-5.0)
    """Change of the light at 700 nm over the session, percent."""
    temperature_change_k: float = between(-1000.0, 1000.0, default=0.0)
    """Change of the colour temperature over the session, kelvin."""
    settling: float = between(0.02, 100.0, default=0.5)
    """Time constant as a fraction of the session; a large value gives a linear drift."""

    def progress(self, elapsed: float) -> float:
        """Fraction of the whole change at time ``elapsed``: 0 at the start of the session, 1 at its end."""
        return float(np.expm1(-elapsed / self.settling) / np.expm1(-1.0 / self.settling))

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "1 1 bands"]:
        """Ratio of the output to that at the start: the drift at 700 nm times a ratio of Planck spectra."""
        done = self.progress(elapsed)
        now_k = lamp_temperature_k + done * self.temperature_change_k
        at_reference = np.asarray(REFERENCE_NM)
        tilt = lamp_photons(wavelengths_nm, now_k) / lamp_photons(wavelengths_nm, lamp_temperature_k)
        tilt /= lamp_photons(at_reference, now_k) / lamp_photons(at_reference, lamp_temperature_k)
        factor = (1.0 + done * self.percent / 100.0) * tilt
        return factor[None, None].astype(np.float32)


@dataclass(frozen=True)
class IlluminationFalloff(IlluminationEffect):
    """The image darkens towards its edges by the cos⁴ law, for object and white tarp alike."""

    name: ClassVar[str] = "illumination_falloff"
    edge_loss: float = between(0.0, 0.95, default=0.2)
    """Fraction of the light that is missing in the corners of the image."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "lines samples 1"]:
        """cos⁴ of an angle whose tangent is proportional to the distance from the image centre."""
        from_centre = (np.arange(size_px) + 0.5) / size_px - 0.5
        # Normalised to 1 in the corners.
        distance_squared = 2.0 * (from_centre[:, None] ** 2 + from_centre**2)
        corner_tangent_squared = (1.0 - self.edge_loss) ** -0.5 - 1.0
        return ((1.0 + corner_tangent_squared * distance_squared) ** -2.0)[..., None].astype(np.float32)


@dataclass(frozen=True)
class Lamp(ViewLightEffect):
    """Part of the light comes from a direction that is fixed relative to the camera, and casts shadows.

    The rays of the lamp are parallel. Its irradiance is ``fraction`` times the cosine between normal and lamp
    direction where the lamp is visible; the chamber provides ``1 - fraction``. A white tarp that faces the lamp keeps
    irradiance 1. `InterReflection` follows the chamber's light only, and the visible wall of the chamber does not
    change.
    """

    name: ClassVar[str] = "lamp"
    fraction: float = between(0.0, 1.0, default=0.4)
    """Fraction of the lamp in the light on a white tarp that faces it."""
    azimuth_deg: float = between(-180.0, 180.0, default=-35.0)
    """Azimuth of the lamp, degrees: 0 is behind the camera, positive is to the right of it."""
    elevation_deg: float = between(-90.0, 90.0, default=30.0)
    """Elevation of the lamp above the optical axis of the camera, degrees."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """Replace part of the chamber's light by the lamp's."""
        to_lamp = self.direction(camera_to_world)
        cosine = hits.facing_normals @ to_lamp
        lit = np.flatnonzero(cosine > 0.0)
        lamp = np.zeros_like(light.lamp)
        lamp[lit] = self.fraction * cosine[lit] * hits.is_unoccluded(to_lamp, lit)
        return replace(light, chamber=light.chamber * np.float32(1.0 - self.fraction), lamp=lamp, to_lamp=to_lamp)

    def direction(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Unit vector from the object to the lamp, object frame."""
        azimuth, elevation = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        in_camera = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        return camera_to_world[:3, :3] @ in_camera
