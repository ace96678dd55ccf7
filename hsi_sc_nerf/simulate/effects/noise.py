"""Noise: what differs from one exposure to the next.

With both effects the variance of a pixel's counts is a line over its mean, the photon transfer curve (Janesick,
"Photon Transfer", SPIE 2007): ``variance = (mean - dark) / g + (electrons / g)^2``, g the electrons per count. The
digitiser adds 1/12.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.stages import ReadoutContext, ReadoutEffect
from hsi_sc_nerf.simulate.reading import between

FEW_ELECTRONS = 50.0
"""Below this mean, Poisson numbers are drawn exactly; above, by `many_electrons` in half the time."""


@dataclass(frozen=True)
class PhotonNoise(ReadoutEffect):
    """Electrons arrive by chance: the variance of a signal is the signal itself, in electrons (Poisson)."""

    name: ClassVar[str] = "photon_noise"

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Draw the electrons of the light and give them back as counts; the dark level is no light."""
        electrons = np.maximum(counts - np.float32(context.dark_level), 0.0, dtype=np.float32)
        electrons *= np.float32(context.electrons_per_count)
        # Line by line, which stays within the processor's cache.
        for line in electrons:
            line[...] = poisson(line, context.rng)
        electrons /= np.float32(context.electrons_per_count)
        electrons += np.float32(context.dark_level)
        return electrons


@dataclass(frozen=True)
class ReadNoise(ReadoutEffect):
    """The amplifier adds the same noise to every reading, however much light there was."""

    name: ClassVar[str] = "read_noise"
    electrons: float = between(0.0, 1e5, default=40.0)
    """Root mean square, electrons."""

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Add normal noise."""
        spread = np.float32(self.electrons / context.electrons_per_count)
        for line in counts:
            line += spread * context.rng.standard_normal(line.shape, dtype=np.float32)
        return counts


def poisson(mean: Float[np.ndarray, "*n"], rng: np.random.Generator) -> Float[np.ndarray, "*n"]:
    """Poisson numbers as float32: exact below `FEW_ELECTRONS`, else by `many_electrons`."""
    drawn = many_electrons(mean, rng.standard_normal(mean.shape, dtype=np.float32))
    few = mean < FEW_ELECTRONS
    drawn[few] = rng.poisson(mean[few])
    return drawn


def many_electrons(mean: Float[np.ndarray, "*n"], normal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Whole numbers from standard normal ones that are distributed like Poisson numbers of a large mean.

    A Cornish-Fisher expansion with the Poisson distribution's skewness, ``mean + s z + (z^2 - 1) / 6``, rounded.
    Mean and variance are exact with ``s^2 = mean - 1/18 - 1/12`` (the last two are of the square and of the
    rounding). From `FEW_ELECTRONS` on the cumulative distribution is nowhere off by more than 2e-4.
    """
    number = np.sqrt(np.maximum(mean - np.float32(5.0 / 36.0), 0.0, dtype=np.float32))
    # s z + (z^2 - 1) / 6 = (s + z / 6) z - 1 / 6, in place.
    number += normal / np.float32(6.0)
    number *= normal
    number += mean - np.float32(1.0 / 6.0)
    np.rint(number, out=number)
    return np.maximum(number, 0.0, out=number)
