"""A lamp that stands still beside the camera while the object turns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import ViewLightEffect
from hsi_sc_nerf.simulate.reading import between

if TYPE_CHECKING:
    from hsi_sc_nerf.simulate.lighting import HitLight
    from hsi_sc_nerf.simulate.render import Hits


@dataclass(frozen=True)
class Lamp(ViewLightEffect):
    """Part of the light comes from one direction, fixed to the camera, and casts shadows.

    Irradiance is ``1 - share`` of what the chamber gives, and ``share`` times the cosine between the facet's normal
    and the lamp's direction where the lamp is seen: a white tarp that faces the lamp keeps irradiance 1. The lamp's
    rays are parallel; what it lights does not light its neighbours (`InterReflection` is the chamber's alone). The
    wall of the chamber that the camera sees stands in both and stays as it is.
    """

    name: ClassVar[str] = "lamp"
    share: float = between(0.0, 1.0, default=0.4)
    """Share of the light on a white tarp that faces the lamp."""
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
        lamp[lit] = self.share * cosine[lit] * hits.is_free(to_lamp, lit)
        return replace(light, chamber=light.chamber * np.float32(1.0 - self.share), lamp=lamp, to_lamp=to_lamp)

    def direction(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Unit vector from the object to the lamp, object frame."""
        azimuth, elevation = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        in_camera = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        return camera_to_world[:3, :3] @ in_camera
