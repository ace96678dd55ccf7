"""Median spectrum along a frame's border, and the median it rests on."""

import numpy as np

from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.processing.region_spectra import border_spectrum

WAVELENGTHS_NM = np.linspace(450.0, 900.0, 6)


def test_border_spectrum_is_the_background(tmp_path):
    reflectance = np.full((64, 64, 6), 0.5)
    background = [0.6, 0.7, 0.8, 0.9, 0.4, 0.3]
    reflectance[:2] = reflectance[-2:] = reflectance[:, :2] = reflectance[:, -2:] = background
    foreground = np.zeros((64, 64), bool)
    foreground[:40, 10:50] = True
    reflectance[foreground] = 0.1
    write_packed_cube(tmp_path / "c.hdr", pack(reflectance), WAVELENGTHS_NM)
    np.testing.assert_allclose(border_spectrum(tmp_path / "c.hdr", foreground), background, atol=1e-4)
    assert np.isnan(border_spectrum(tmp_path / "c.hdr", np.ones((64, 64), bool))).all()


def test_border_spectrum_of_measured_values(tmp_path):
    rng = np.random.default_rng(2)
    reflectance = rng.random((12, 12, 6))
    reflectance[rng.random(reflectance.shape) < 0.4] = np.nan
    reflectance[..., 5] = np.nan
    write_packed_cube(tmp_path / "c.hdr", pack(reflectance), WAVELENGTHS_NM)
    foreground = np.zeros((12, 12), bool)
    foreground[:5, :] = True
    border = ~foreground
    border[1:-1, 1:-1] = False
    expected = np.append(np.nanmedian(reflectance[border][:, :5], axis=0), np.nan)
    np.testing.assert_allclose(border_spectrum(tmp_path / "c.hdr", foreground), expected, atol=1e-5)
