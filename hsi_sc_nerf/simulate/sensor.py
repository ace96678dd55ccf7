"""The sensor: band centres, signal of the white tarp, quantum efficiency and digitisation."""

from __future__ import annotations

from importlib import resources

import numpy as np
from jaxtyping import Float, UInt16

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.light import lamp_photons
from hsi_sc_nerf.simulate.scene import SensorSettings


def band_centres_nm(bands: int) -> Float[np.ndarray, "bands"]:
    """The 204 band centres of a SPECIM IQ as it exports them, or ``bands`` centres interpolated between them."""
    text = resources.files(__package__).joinpath("specim_iq_band_centres_nm.csv").read_text(encoding="utf-8")
    centres = np.array(text.split()[1:], float)
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
    signal = _electrons_of_white(sensor, wavelengths_nm)
    # The peak is that of the header's bands, also under a spectral smile.
    peak = _electrons_of_white(sensor, band_centres_nm(sensor.bands)).max()
    return signal / peak * (white - sensor.dark_level)


def _electrons_of_white(
    sensor: SensorSettings, wavelengths_nm: Float[np.ndarray, "*samples bands"]
) -> Float[np.ndarray, "*samples bands"]:
    """Electrons of the white tarp in arbitrary units."""
    return lamp_photons(wavelengths_nm, sensor.lamp_temperature_k) * quantum_efficiency(wavelengths_nm)


def largest_count(sensor: SensorSettings) -> int:
    """Largest count of the digitiser."""
    return 2**sensor.bit_depth - 1


def digitise(counts: Float[np.ndarray, "*n"], sensor: SensorSettings) -> UInt16[np.ndarray, "*n"]:
    """Integer counts from 0 to the largest; overwrites ``counts``."""
    np.rint(counts, out=counts)
    return np.clip(counts, 0, largest_count(sensor), out=counts).astype(np.uint16)
