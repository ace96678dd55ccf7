"""Spectra in the order of their wavelengths, and mirrored by a header that lists them in reverse."""

from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.processing.appearance_checks import check_band_order
from hsi_sc_nerf.simulate.materials import MATERIALS, endmembers

NM = np.linspace(397.0, 1003.0, 204)
MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
SKINS = ("pear_skin", "apple_skin", "apple_blush", "kernel_yellow", "tomato_red", "tomato_green", "husk")


@pytest.mark.parametrize("name", MATERIALS)
def test_no_material_looks_reversed(name):
    assert check_band_order(endmembers([name], NM)[0], NM) == []


@pytest.mark.parametrize("name", SKINS)
def test_reversed_wavelengths_of_plants(name):
    (finding,) = check_band_order(endmembers([name], NM)[0], NM[::-1])
    assert (finding.name, finding.level) == ("band-order", "red")
    assert finding.values["blue_over_infrared"] > 2.0


def test_grey_and_dark_things_and_other_ranges_tell_nothing():
    assert check_band_order(np.full(204, 0.5), NM[::-1]) == []
    assert check_band_order(np.linspace(0.09, 0.001, 204), NM) == []
    assert check_band_order(endmembers(["pear_skin"], NM)[0], NM[::-1] + 600.0) == []


def test_a_real_maize_kernel():
    counts, white, dark = (
        open_cube(MAIZE / f"{name}.hdr").read().astype(float)
        for name in ("4-22-22_right_same_B73_top_00", "white_reference_crop", "dark_reference_crop")
    )
    level = dark.mean(axis=(0, 1))
    reflectance = (counts[10:20, 15:30].mean(axis=(0, 1)) - level) / (white.mean(axis=(0, 1)) - level)
    nm = open_cube(MAIZE / "white_reference_crop.hdr").wavelengths_nm
    assert check_band_order(reflectance, nm) == []
    assert check_band_order(reflectance, nm[::-1])[0].level in ("amber", "red")
