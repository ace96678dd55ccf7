"""Effects of the detector: spectral smile, exposure, noise, fixed patterns and bad pixels.

With `photon_noise` and `read_noise` the variance of a pixel's counts is a line over its mean, the photon transfer curve (Janesick,
"Photon Transfer", SPIE 2007): ``variance = (mean - dark) / g + (electrons / g)^2``, g the electrons per count. The
digitiser adds 1/12.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effects.stages import DetectorEffect, ExposureEffect, ReadoutContext, ReadoutEffect

FEW_ELECTRONS = 50.0
"""Below this mean, Poisson numbers are drawn exactly; above, by `many_electrons` in half the time."""


@dataclass(frozen=True)
class SpectralSmile(DetectorEffect):
    """Lines of one wavelength are curved on the detector: its pixels see other wavelengths than the header states.

    The shift is a parabola along the detector's line: nothing in the middle, ``shift_nm`` at both ends. It is in all
    captures, and calibration with the tarp's mean spectrum leaves it in.
    """

    name: ClassVar[str] = "spectral_smile"
    shift_nm: float = between(-20.0, 20.0, default=1.5)
    """Wavelength at the ends of the line less that in its middle, nm."""

    def wavelengths_nm(
        self, centres_nm: Float[np.ndarray, "bands"], samples: int
    ) -> Float[np.ndarray, "samples bands"]:
        """Wavelength of each detector pixel."""
        from_middle = (2.0 * np.arange(samples) + 1.0) / samples - 1.0
        return centres_nm + self.shift_nm * from_middle[:, None] ** 2


@dataclass(frozen=True)
class Saturation(ExposureEffect):
    """The integration time is too long: what is too bright stops at the largest count.

    It lengthens the integration time of the whole session, white tarp included, because the paper's session has one
    (10 ms), here set for a dark object. So calibration stays right wherever neither the object nor the tarp stops; a
    tarp at 0.82 of the largest count stops, in its brightest bands, from a factor of about 1.2 on. `tarp_exposure`
    gives the tarp a time of its own.
    """

    name: ClassVar[str] = "saturation"
    exposure_factor: float = between(1.0, 100.0, default=1.5)
    """Integration time over the one at which the tarp counts the sensor's ``white_level``."""

    def factor(self, of_white: bool) -> float:
        """`exposure_factor`, in all captures."""
        return self.exposure_factor


@dataclass(frozen=True)
class TarpExposure(ExposureEffect):
    """The white tarp is taken with another integration time than the frames, as one sets it by hand for each.

    The metadata of each capture states its own; reflectance is off by the factor for who does not read them.
    """

    name: ClassVar[str] = "tarp_exposure"
    exposure_factor: float = between(0.01, 100.0, default=0.5)
    """Integration time of the white tarp over that of the frames."""

    def factor(self, of_white: bool) -> float:
        """`exposure_factor` for the tarp; the frames keep theirs."""
        return self.exposure_factor if of_white else 1.0


@dataclass(frozen=True)
class DarkPattern(ReadoutEffect):
    """The dark level is another one in each detector pixel; a dark cube takes it off."""

    name: ClassVar[str] = "dark_pattern"
    spread: float = between(0.0, 1000.0, default=6.0)
    """Standard deviation over the detector pixels, counts."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """``dark_offset``: counts to add to the dark level, float32, normal."""
        return {"dark_offset": np.float32(self.spread) * rng.standard_normal((samples, bands), dtype=np.float32)}

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Add the pattern."""
        counts += context.maps["dark_offset"]
        return counts


@dataclass(frozen=True)
class BadPixels(ReadoutEffect):
    """Some detector pixels do not follow the light: dead ones stay at the dark level, hot ones at the largest count.

    A detector pixel is one sample in one band, so each is a line across the image of its band. Whole bands can be
    dead, too.
    """

    name: ClassVar[str] = "bad_pixels"
    dead_fraction: float = between(0.0, 0.5, default=0.0005)
    """Fraction of the detector pixels that are dead."""
    hot_fraction: float = between(0.0, 0.5, default=0.0005)
    """Fraction of the detector pixels that are hot."""
    dead_bands: int = between(0, 2048, default=0)
    """Number of bands that are dead in all samples."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """``dead`` and ``hot``: which pixels are, never both.

        Their numbers are the fractions, rounded; the pixels of dead bands come on top and are dead, not hot.
        """
        pixels = samples * bands
        dead, hot = round(self.dead_fraction * pixels), round(self.hot_fraction * pixels)
        chosen = rng.permutation(pixels)
        maps = np.zeros((2, pixels), bool)
        maps[0, chosen[:dead]] = True
        maps[1, chosen[dead : dead + hot]] = True
        of_dead, of_hot = maps.reshape(2, samples, bands)
        # Drawn last, so that the other pixels are the same with and without dead bands.
        dead_bands = rng.permutation(bands)[: self.dead_bands]
        of_dead[:, dead_bands] = True
        of_hot[:, dead_bands] = False
        return {"dead": of_dead, "hot": of_hot}

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Overwrite what the bad pixels read."""
        counts[:, context.maps["dead"]] = context.dark_level
        counts[:, context.maps["hot"]] = context.largest_count
        return counts


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
