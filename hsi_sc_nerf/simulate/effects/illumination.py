"""Effects of the lamps: their output over the session, and their light over the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import IlluminationEffect
from hsi_sc_nerf.simulate.lamps import lamp_photons
from hsi_sc_nerf.simulate.reading import between

REFERENCE_NM = 700.0
"""Where a change of colour temperature alone leaves the light as it is."""


@dataclass(frozen=True)
class LampDrift(IlluminationEffect):
    """The lamps' output changes after the white tarp was taken, as lamps settle: fast at first, then slower."""

    name: ClassVar[str] = "lamp_drift"
    percent: float = between(-90.0, 900.0, default=-5.0)
    """Change of the light at 700 nm from the session's start to its end, percent."""
    temperature_change_k: float = between(-1000.0, 1000.0, default=0.0)
    """Change of the lamps' colour temperature from the session's start to its end, kelvin."""
    settling: float = between(0.02, 100.0, default=0.5)
    """Share of the session after which the rate of change has fallen to 37 %; if large, the change is steady."""

    def share_done(self, elapsed: float) -> float:
        """How much of the whole change has happened: 0 at the start of the session, 1 at its end."""
        return float(np.expm1(-elapsed / self.settling) / np.expm1(-1.0 / self.settling))

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "1 1 bands"]:
        """Output at a time over output at the start: Planck spectra' ratio, 1 at 700 nm, times the drift there."""
        done = self.share_done(elapsed)
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
    """Share of the light that the image's corners lack."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "lines samples 1"]:
        """cos⁴ of an angle whose tangent grows with the distance from the image's centre."""
        from_centre = (np.arange(size_px) + 0.5) / size_px - 0.5
        # 1 in the corners.
        distance_squared = 2.0 * (from_centre[:, None] ** 2 + from_centre**2)
        corner_tangent_squared = (1.0 - self.edge_loss) ** -0.5 - 1.0
        return ((1.0 + corner_tangent_squared * distance_squared) ** -2.0)[..., None].astype(np.float32)
