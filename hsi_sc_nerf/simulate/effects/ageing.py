"""Effects of time on the object: it dries, and it shrinks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import DeformationEffect, MaterialEffect
from hsi_sc_nerf.simulate.materials import Material, PlantTissue, water_absorbance
from hsi_sc_nerf.simulate.reading import between


@dataclass(frozen=True)
class Drying(MaterialEffect):
    """Plant tissue loses water at a steady rate, and its water bands (970 nm and neighbours) fade.

    A material that a scene gives as a measured spectrum has no known water and keeps its colour.
    """

    name: ClassVar[str] = "drying"
    water_loss: float = between(0.0, 1.0, default=0.3)
    """Share of the water that is gone at the end of the session."""

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
