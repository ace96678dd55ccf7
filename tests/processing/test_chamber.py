"""The spectrum of a known chamber, and a picture of it against that spectrum."""

import numpy as np
import pytest

from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.processing.chamber import border_spectrum, gain_of_background_image

FRAMES, PIXELS, COLOURS = 12, 800, 3
TEXTURE, NOISE = 0.05, 0.02


def chamber(still=0.0, moving=0.0, stem=0.0, seed=0):
    """Spectra of pixels with a texture that stands still, one that moves, and a few that show a stem."""
    rng = np.random.default_rng(seed)
    spectra = 0.8 + still * rng.choice([-1.0, 1.0], (1, PIXELS, 1)) + moving * rng.normal(size=(FRAMES, PIXELS, 1))
    spectra = spectra + NOISE * rng.normal(size=(FRAMES, PIXELS, COLOURS))
    spectra[:, :8] -= stem
    return spectra, rng.random((FRAMES, PIXELS)) < 0.7


def test_a_texture_that_stands_still_is_measured():
    found = gain_of_background_image(*chamber(still=TEXTURE))
    assert found.rms == pytest.approx(TEXTURE, rel=0.1)
    assert 3.0 * found.noise < found.rms


@pytest.mark.parametrize("departure", [{}, {"moving": TEXTURE}, {"stem": 0.5}])
def test_an_even_or_moving_chamber_needs_no_picture(departure):
    found = gain_of_background_image(*chamber(**departure))
    assert found.rms < 0.005
    assert found.noise < 0.02


def test_a_chamber_that_is_hardly_seen_tells_nothing():
    spectra, free = chamber()
    assert gain_of_background_image(spectra, free & (np.arange(PIXELS) < 10)) is None
    free[2:] = False
    assert gain_of_background_image(spectra, free) is None


def test_border_spectrum_of_measured_values(tmp_path):
    rng = np.random.default_rng(2)
    reflectance = rng.random((12, 12, 6))
    reflectance[rng.random(reflectance.shape) < 0.4] = np.nan
    reflectance[..., 5] = np.nan
    write_packed_cube(tmp_path / "c.hdr", pack(reflectance), np.linspace(450.0, 900.0, 6))
    foreground = np.zeros((12, 12), bool)
    foreground[:5, :] = True
    border = ~foreground
    border[1:-1, 1:-1] = False
    expected = np.append(np.nanmedian(reflectance[border][:, :5], axis=0), np.nan)
    np.testing.assert_allclose(border_spectrum(tmp_path / "c.hdr", foreground), expected, atol=1e-5)
    assert np.isnan(border_spectrum(tmp_path / "c.hdr", np.ones((12, 12), bool))).all()
