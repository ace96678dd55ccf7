"""Noise of the detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import ReadoutContext, ReadoutEffect
from hsi_sc_nerf.simulate.reading import between


@dataclass(frozen=True)
class PhotonNoise(ReadoutEffect):
    """Electrons arrive by chance: the variance of a signal is the signal itself, in electrons (Poisson)."""

    name: ClassVar[str] = "photon_noise"
    full_well: float = between(100.0, 1e7, default=30_000.0)
    """Electrons at the digitiser's largest count."""

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Draw the electrons of the light and give them back as counts; the dark level is no light."""
        electrons_per_count = self.full_well / context.largest_count
        electrons = np.maximum(counts - context.dark_level, 0.0) * electrons_per_count
        drawn = context.frame_rng.poisson(electrons).astype(np.float32)
        return drawn / np.float32(electrons_per_count) + context.dark_level
