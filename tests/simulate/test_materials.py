"""Spectra carry the features they are named for; the sensor's counts follow its definition."""

import numpy as np
import pytest

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.effects.detector import (
    band_centres_nm,
    digitise,
    lamp_photons,
    quantum_efficiency,
    white_signal,
)
from hsi_sc_nerf.simulate.materials import MATERIALS, endmembers
from hsi_sc_nerf.simulate.scene import SensorSettings

WAVELENGTHS_NM = band_centres_nm(204)


def at(name: str, *wavelengths_nm: float) -> np.ndarray:
    return endmembers([name], np.array(wavelengths_nm))[0]


def test_band_centres_are_the_instruments():
    assert len(WAVELENGTHS_NM) == paper.BANDS
    assert (WAVELENGTHS_NM[0], WAVELENGTHS_NM[-1]) == paper.WAVELENGTH_RANGE_NM
    assert (np.diff(WAVELENGTHS_NM) > 0).all()
    fewer = band_centres_nm(16)
    assert (fewer[0], fewer[-1]) == paper.WAVELENGTH_RANGE_NM
    assert (np.diff(fewer) > 0).all()


@pytest.mark.parametrize("name", MATERIALS)
def test_reflectance_is_within_zero_and_one_and_smooth(name):
    spectrum = endmembers([name], WAVELENGTHS_NM)[0]
    assert spectrum.min() > 0.0
    assert spectrum.max() <= 1.0
    assert np.abs(np.diff(spectrum)).max() < 0.06


@pytest.mark.parametrize("name", ["pear_skin", "pear_blush", "apple_skin", "apple_blush", "husk"])
def test_green_tissue_has_chlorophyll_and_a_red_edge(name):
    red, infrared = at(name, 677.0, 800.0)
    assert (infrared - red) / (infrared + red) > 0.25
    edge_nm = np.arange(660.0, 760.0)
    assert 682.0 < edge_nm[np.gradient(at(name, *edge_nm)).argmax()] < 725.0
    assert at(name, 640.0)[0] > red


@pytest.mark.parametrize("name", ["pear_skin", "apple_skin", "bruise", "kernel_yellow", "husk"])
def test_wet_tissue_dips_at_970_nm(name):
    left, dip, right = at(name, 900.0, 970.0, 1003.0)
    assert dip < 0.97 * left
    assert dip < right


def test_blush_absorbs_green_and_a_bruise_is_dark_in_the_infrared():
    assert at("apple_blush", 550.0)[0] < 0.4 * at("apple_skin", 550.0)[0]
    assert at("bruise", 850.0)[0] < 0.8 * at("apple_skin", 850.0)[0]


def test_lamp_is_plancks_law():
    # Wien's displacement law for photons: the peak is at 3669.7 um K / T.
    nm = np.arange(300.0, 3000.0)
    assert nm[lamp_photons(nm, 3000.0).argmax()] == pytest.approx(3669.7e3 / 3000.0, abs=1.0)


def test_white_peaks_at_its_level_and_dark_at_its():
    sensor = SensorSettings()
    signal = white_signal(sensor, WAVELENGTHS_NM)
    white = digitise(signal + sensor.dark_level, sensor)
    assert white.dtype == np.uint16
    assert white.max() == round(0.82 * 4095)
    # Each band has signal enough to calibrate with.
    assert white.min() > sensor.dark_level + 90
    assert (quantum_efficiency(WAVELENGTHS_NM) < 1.0).all()


def test_a_dark_level_without_room_for_light_is_refused():
    with pytest.raises(InputError, match=r"sensor\.dark_level is 250.* more than 209.1"):
        white_signal(SensorSettings(bit_depth=8, dark_level=250), WAVELENGTHS_NM)


def test_counts_are_whole_and_stop_at_both_ends():
    counts = digitise(np.array([-3.0, 0.4, 0.6, 4094.4, 4096.0, 1e9]), SensorSettings())
    assert counts.dtype == np.uint16
    assert counts.tolist() == [0, 0, 1, 4094, 4095, 4095]
