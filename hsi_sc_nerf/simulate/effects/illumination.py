"""Effects of the lamps: drift, falloff over the image, and a lamp beside the camera that casts shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effects.stages import IlluminationEffect, ViewLightEffect
from hsi_sc_nerf.simulate.light import HitLight, lamp_photons
from hsi_sc_nerf.simulate.render import Hits

REFERENCE_NM = 700.0
"""Where a change of colour temperature alone leaves the light as it is."""


@dataclass(frozen=True)
class DriftingLamps(IlluminationEffect):
    """The lamps' output changes after the white tarp was taken, as lamps settle: fast at first, then slower."""

    name: ClassVar[str] = "lamp_drift"
    percent: float = between(-90.0, 900.0, default=-5.0)
    """Change of the light at 700 nm from the session's start to its end, percent."""
    temperature_change_k: float = between(-1000.0, 1000.0, default=0.0)
    """Change of the lamps' colour temperature from the session's start to its end, kelvin."""
    settling: float = between(0.02, 100.0, default=0.5)
    """Fraction of the session after which the rate of change has fallen to 37 %; if large, the change is steady."""

    def fraction_done(self, elapsed: float) -> float:
        """How much of the whole change has happened: 0 at the start of the session, 1 at its end."""
        return float(np.expm1(-elapsed / self.settling) / np.expm1(-1.0 / self.settling))

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "1 1 bands"]:
        """Output at a time over output at the start: Planck spectra' ratio, 1 at 700 nm, times the drift there."""
        done = self.fraction_done(elapsed)
        now_k = lamp_temperature_k + done * self.temperature_change_k
        at_reference = np.asarray(REFERENCE_NM)
        tilt = lamp_photons(wavelengths_nm, now_k) / lamp_photons(wavelengths_nm, lamp_temperature_k)
        tilt /= lamp_photons(at_reference, now_k) / lamp_photons(at_reference, lamp_temperature_k)
        factor = (1.0 + done * self.percent / 100.0) * tilt
        return factor[None, None].astype(np.float32)


@dataclass(frozen=True)
class IlluminationFalloff(IlluminationEffect):
    """The image gets darker towards its edges by the cos⁴ law, the white tarp's like the object's."""

    name: ClassVar[str] = "illumination_falloff"
    edge_loss: float = between(0.0, 0.95, default=0.2)
    """Fraction of the light that the image's corners lack."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "lines samples 1"]:
        """cos⁴ of an angle whose tangent grows with the distance from the image's centre."""
        from_centre = (np.arange(size_px) + 0.5) / size_px - 0.5
        # 1 in the corners.
        distance_squared = 2.0 * (from_centre[:, None] ** 2 + from_centre**2)
        corner_tangent_squared = (1.0 - self.edge_loss) ** -0.5 - 1.0
        return ((1.0 + corner_tangent_squared * distance_squared) ** -2.0)[..., None].astype(np.float32)


@dataclass(frozen=True)
class Lamp(ViewLightEffect):
    """Part of the light comes from one direction, fixed to the camera, and casts shadows.

    Irradiance is ``1 - fraction`` of what the chamber gives, and ``fraction`` times the cosine between the facet's normal
    and the lamp's direction where the lamp is seen: a white tarp that faces the lamp keeps irradiance 1. The lamp's
    rays are parallel; what it lights does not light its neighbours (`InterReflection` is the chamber's alone). The
    wall of the chamber that the camera sees stands in both and stays as it is.
    """

    name: ClassVar[str] = "lamp"
    fraction: float = between(0.0, 1.0, default=0.4)
    """Fraction of the light on a white tarp that faces the lamp."""
    azimuth_deg: float = between(-180.0, 180.0, default=-35.0)
    """Where the lamp stands as the camera sees it: 0 behind the camera, positive to the right of it, degrees."""
    elevation_deg: float = between(-90.0, 90.0, default=30.0)
    """How far the lamp stands above the camera's axis, degrees."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """Move part of the light from the chamber to the lamp."""
        to_lamp = self.direction(camera_to_world)
        cosine = hits.facing_normals @ to_lamp
        lit = np.flatnonzero(cosine > 0.0)
        lamp = np.zeros_like(light.lamp)
        lamp[lit] = self.fraction * cosine[lit] * hits.is_free(to_lamp, lit)
        return replace(light, chamber=light.chamber * np.float32(1.0 - self.fraction), lamp=lamp, to_lamp=to_lamp)

    def direction(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Unit vector from the object to the lamp, object frame."""
        azimuth, elevation = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        in_camera = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        return camera_to_world[:3, :3] @ in_camera
