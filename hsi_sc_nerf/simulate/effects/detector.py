"""The sensor, and its effects: spectral smile, exposure, fixed patterns, bad pixels and noise.

With `PhotonNoise` and `ReadNoise` the variance of a pixel's counts is linear in its mean, the photon transfer curve
(Janesick, "Photon Transfer", SPIE 2007): ``variance = (mean - dark) / g + (electrons / g)^2``, where g is the number
of electrons per count. The digitiser adds 1/12.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import ClassVar, TypeAlias

import numpy as np
from jaxtyping import Float, UInt16

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import lamp_photons

Counts: TypeAlias = Float[np.ndarray, "lines samples bands"]
Maps: TypeAlias = Mapping[str, np.ndarray]
FEW_ELECTRONS = 50.0
"""Mean below which Poisson numbers are drawn exactly; above it `many_electrons` takes half the time."""


@dataclass(frozen=True)
class SensorSettings:
    """A perfect push-broom sensor: counts are linear in light and free of noise."""

    bands: int = between(3, 2048, default=paper.BANDS)
    bit_depth: int = between(8, 16, default=12)
    lamp_temperature_k: float = between(1500.0, 10000.0, default=3000.0)
    white_level: float = between(0.05, 1.0, default=0.82)
    """Counts of the white tarp in its brightest band, as a fraction of the largest count."""
    dark_level: int = between(0, 1000, default=120)
    """Counts without light."""
    full_well_electrons: float = between(100.0, 1e7, default=30_000.0)
    """Electrons at the largest count; used by the noise effects."""


def band_centres_nm(bands: int) -> Float[np.ndarray, "bands"]:
    """The 204 band centres of a SPECIM IQ as it exports them, or ``bands`` centres interpolated between them."""
    table = resources.files("hsi_sc_nerf.simulate").joinpath("specim_iq_band_centres_nm.csv")
    centres = np.array(table.read_text(encoding="utf-8").split()[1:], float)
    if bands == len(centres):
        return centres
    positions = np.linspace(0.0, len(centres) - 1.0, bands)
    return np.round(np.interp(positions, np.arange(len(centres)), centres), 2)


def quantum_efficiency(wavelengths_nm: Float[np.ndarray, "bands"]) -> Float[np.ndarray, "bands"]:
    """Electrons per photon of a silicon sensor behind its grating, in [0, 1]."""
    nodes_nm = [390.0, 420.0, 470.0, 530.0, 600.0, 680.0, 760.0, 840.0, 920.0, 980.0, 1010.0]
    values = [0.36, 0.44, 0.55, 0.63, 0.67, 0.62, 0.52, 0.39, 0.25, 0.14, 0.09]
    return np.interp(wavelengths_nm, nodes_nm, values)


def white_signal(
    sensor: SensorSettings, wavelengths_nm: Float[np.ndarray, "*samples bands"]
) -> Float[np.ndarray, "*samples bands"]:
    """Counts above dark of a reflectance of 1; its peak with dark is ``white_level`` of the largest count.

    Raises:
        InputError: the dark counts leave no room for it.
    """
    white = sensor.white_level * largest_count(sensor)
    if white <= sensor.dark_level:
        raise InputError(
            f"sensor.dark_level is {sensor.dark_level}, but the white counts no more than {white:g} (white_level of "
            f"the largest count {largest_count(sensor)}); lower it, or take a larger bit_depth."
        )
    # The peak is that of the header's bands, also under a spectral smile.
    electrons, at_centres = (
        lamp_photons(nm, sensor.lamp_temperature_k) * quantum_efficiency(nm)
        for nm in (wavelengths_nm, band_centres_nm(sensor.bands))
    )
    return electrons / at_centres.max() * (white - sensor.dark_level)


def largest_count(sensor: SensorSettings) -> int:
    """Largest count of the digitiser."""
    return 2**sensor.bit_depth - 1


def electrons_per_count(sensor: SensorSettings) -> float:
    """Gain of the sensor."""
    return sensor.full_well_electrons / largest_count(sensor)


def digitise(counts: Float[np.ndarray, "*n"], sensor: SensorSettings) -> UInt16[np.ndarray, "*n"]:
    """Integer counts from 0 to the largest; overwrites ``counts``."""
    np.rint(counts, out=counts)
    return np.clip(counts, 0, largest_count(sensor), out=counts).astype(np.uint16)


class ExposureEffect(Effect):
    """Changes the integration time."""

    def factor(self, of_white: bool) -> float:
        """Ratio of the integration time to the one at which the white tarp counts the sensor's ``white_level``.

        Args:
            of_white: whether the capture is that of the white tarp; all other frames have one integration time.
        """
        raise NotImplementedError


class ReadoutEffect(Effect):
    """Changes counts before they are digitised, in frames, white and dark cubes alike."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Maps (samples, bands) that are the same in every exposure, by name; stored with the truth."""
        return {}

    def read_out(self, counts: Counts, sensor: SensorSettings, maps: Maps, rng: np.random.Generator) -> Counts:
        """Counts under the effect, dark level included, neither rounded nor clipped; may overwrite ``counts``.

        Args:
            maps: result of the effect's `detector_maps`.
            rng: random generator of this exposure.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class SpectralSmile(Effect):
    """The wavelength of a band varies along the detector's line (spectral smile).

    The shift is a parabola: 0 in the middle of the line, ``shift_nm`` at both ends. It affects all captures, and
    calibration with the mean spectrum of the tarp does not remove it.
    """

    name: ClassVar[str] = "spectral_smile"
    shift_nm: float = between(-20.0, 20.0, default=1.5)
    """Wavelength at the ends of the line minus that in its middle, nm."""

    def wavelengths_nm(
        self, centres_nm: Float[np.ndarray, "bands"], samples: int
    ) -> Float[np.ndarray, "samples bands"]:
        """Wavelength of each detector pixel."""
        from_middle = (2.0 * np.arange(samples) + 1.0) / samples - 1.0
        return centres_nm + self.shift_nm * from_middle[:, None] ** 2


@dataclass(frozen=True)
class Saturation(ExposureEffect):
    """The integration time is too long, and bright pixels saturate.

    The effect changes the integration time of the whole session, white tarp included, as the paper's session has one
    integration time. Calibration stays correct where neither object nor tarp saturates. With the default
    ``white_level`` the tarp saturates in its brightest bands above a factor of 1.2; `TarpExposure` gives the tarp an
    integration time of its own.
    """

    name: ClassVar[str] = "saturation"
    exposure_factor: float = between(1.0, 100.0, default=1.5)
    """Ratio of the integration time to the one at which the tarp counts the sensor's ``white_level``."""

    def factor(self, of_white: bool) -> float:
        """`exposure_factor` in all captures."""
        return self.exposure_factor


@dataclass(frozen=True)
class TarpExposure(ExposureEffect):
    """White tarp and frames are captured with different integration times.

    The metadata of each capture state its integration time.
    """

    name: ClassVar[str] = "tarp_exposure"
    exposure_factor: float = between(0.01, 100.0, default=0.5)
    """Ratio of the white tarp's integration time to that of the frames."""

    def factor(self, of_white: bool) -> float:
        """`exposure_factor` for the tarp, 1 for the frames."""
        return self.exposure_factor if of_white else 1.0


@dataclass(frozen=True)
class DarkPattern(ReadoutEffect):
    """Each detector pixel has its own dark level (fixed pattern), which a dark cube records."""

    name: ClassVar[str] = "dark_pattern"
    spread: float = between(0.0, 1000.0, default=6.0)
    """Standard deviation over the detector pixels, counts."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """``dark_offset``: counts to add to the dark level, float32, normal."""
        return {"dark_offset": np.float32(self.spread) * rng.standard_normal((samples, bands), dtype=np.float32)}

    def read_out(self, counts: Counts, sensor: SensorSettings, maps: Maps, rng: np.random.Generator) -> Counts:
        """Add the fixed pattern."""
        counts += maps["dark_offset"]
        return counts


@dataclass(frozen=True)
class BadPixels(ReadoutEffect):
    """Some detector pixels are dead (constant dark level) or hot (constant largest count).

    A detector pixel is one sample in one band, so each bad pixel is a line in the image of its band. Whole bands can
    be dead as well.
    """

    name: ClassVar[str] = "bad_pixels"
    dead_fraction: float = between(0.0, 0.5, default=0.0005)
    """Fraction of the detector pixels that are dead."""
    hot_fraction: float = between(0.0, 0.5, default=0.0005)
    """Fraction of the detector pixels that are hot."""
    dead_bands: int = between(0, 2048, default=0)
    """Number of bands that are dead in all samples."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Boolean maps ``dead`` and ``hot``, which are disjoint; pixels of dead bands are dead in addition."""
        pixels = samples * bands
        dead, hot = round(self.dead_fraction * pixels), round(self.hot_fraction * pixels)
        chosen = rng.permutation(pixels)
        maps = np.zeros((2, pixels), bool)
        maps[0, chosen[:dead]] = True
        maps[1, chosen[dead : dead + hot]] = True
        of_dead, of_hot = maps.reshape(2, samples, bands)
        # Drawn last: the other bad pixels do not depend on the number of dead bands.
        dead_bands = rng.permutation(bands)[: self.dead_bands]
        of_dead[:, dead_bands] = True
        of_hot[:, dead_bands] = False
        return {"dead": of_dead, "hot": of_hot}

    def read_out(self, counts: Counts, sensor: SensorSettings, maps: Maps, rng: np.random.Generator) -> Counts:
        """Overwrite the counts of bad pixels."""
        counts[:, maps["dead"]] = sensor.dark_level
        counts[:, maps["hot"]] = largest_count(sensor)
        return counts


@dataclass(frozen=True)
class PhotonNoise(ReadoutEffect):
    """Shot noise: the number of electrons is Poisson distributed, so its variance equals its mean."""

    name: ClassVar[str] = "photon_noise"

    def read_out(self, counts: Counts, sensor: SensorSettings, maps: Maps, rng: np.random.Generator) -> Counts:
        """Draw the electrons of the signal above the dark level and convert them back to counts."""
        electrons = np.maximum(counts - np.float32(sensor.dark_level), 0.0, dtype=np.float32)
        electrons *= np.float32(electrons_per_count(sensor))
        # One line at a time fits in the processor's cache.
        for line in electrons:
            line[...] = poisson(line, rng)
        electrons /= np.float32(electrons_per_count(sensor))
        electrons += np.float32(sensor.dark_level)
        return electrons


@dataclass(frozen=True)
class ReadNoise(ReadoutEffect):
    """The amplifier adds normally distributed noise that does not depend on the signal."""

    name: ClassVar[str] = "read_noise"
    electrons: float = between(0.0, 1e5, default=40.0)
    """Root mean square, electrons."""

    def read_out(self, counts: Counts, sensor: SensorSettings, maps: Maps, rng: np.random.Generator) -> Counts:
        """Add the noise."""
        spread = np.float32(self.electrons / electrons_per_count(sensor))
        for line in counts:
            line += spread * rng.standard_normal(line.shape, dtype=np.float32)
        return counts


def poisson(mean: Float[np.ndarray, "*n"], rng: np.random.Generator) -> Float[np.ndarray, "*n"]:
    """Poisson numbers as float32: exact below `FEW_ELECTRONS`, else by `many_electrons`."""
    drawn = many_electrons(mean, rng.standard_normal(mean.shape, dtype=np.float32))
    few = mean < FEW_ELECTRONS
    drawn[few] = rng.poisson(mean[few])
    return drawn


def many_electrons(mean: Float[np.ndarray, "*n"], normal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Approximate Poisson numbers of a large mean from standard normal numbers z.

    Rounded Cornish-Fisher expansion ``mean + s z + (z^2 - 1) / 6``. Mean and variance are exact with
    ``s^2 = mean - 1/18 - 1/12``, where 1/18 is the variance of the square and 1/12 that of the rounding. For means of
    at least `FEW_ELECTRONS` the error of the cumulative distribution is at most 2e-4.
    """
    number = np.sqrt(np.maximum(mean - np.float32(5.0 / 36.0), 0.0, dtype=np.float32))
    # s z + (z^2 - 1) / 6 = (s + z / 6) z - 1 / 6, in place.
    number += normal / np.float32(6.0)
    number *= normal
    number += mean - np.float32(1.0 / 6.0)
    np.rint(number, out=number)
    return np.maximum(number, 0.0, out=number)


EFFECTS: tuple[type[Effect], ...] = (
    SpectralSmile,
    Saturation,
    TarpExposure,
    PhotonNoise,
    DarkPattern,
    ReadNoise,
    BadPixels,
)
"""The effects in the order in which they act."""
