import numpy as np
import pytest

from hsi_sc_nerf.calibration.detector import Readings, find_defects
from hsi_sc_nerf.calibration.flat_field import fit_surface, flat_field, relative_brightness
from hsi_sc_nerf.calibration.white_reference import white_reference
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import Capture
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.effects.image import IlluminationFalloff

SIZE, BANDS, DARK = 96, 6, 120.0
NM = np.linspace(500.0, 800.0, BANDS)
LAMP = np.array([900.0, 1500.0, 2400.0, 2900.0, 2000.0, 700.0])
# 30 000 electrons for 4095 counts.
COUNTS_PER_ELECTRON = 4095.0 / 30_000.0


def light(edge_loss: float, gradient: float) -> np.ndarray:
    """cos^4 falloff towards the corners, and a lamp that stands to one side."""
    falloff = IlluminationFalloff(edge_loss).factor(SIZE, NM, 3000.0, 0.0)[..., 0].astype(float)
    return falloff * (1.0 + gradient * np.linspace(-1.0, 1.0, SIZE))


def exposed(image: np.ndarray, reflectance: np.ndarray, seed: int) -> np.ndarray:
    """Counts with photon and read noise."""
    rng = np.random.default_rng(seed)
    signal = image[..., None] * reflectance * LAMP
    counts = rng.normal(signal, np.sqrt(signal * COUNTS_PER_ELECTRON + 30.0)) + DARK
    return np.rint(np.clip(counts, 0.0, 4095.0)).astype(np.uint16)


def tarp_reflectance(dirty: bool) -> np.ndarray:
    """A tarp that leaves a margin free; with a fold across it and specks of dirt."""
    reflectance = np.full((SIZE, SIZE, 1), 0.1)
    reflectance[8:-8, 8:-8] = 1.0
    if dirty:
        reflectance[25:33, 8:60] *= 0.75
        reflectance[60:64, 70:75] *= 0.3
    return reflectance


def tarp_capture(folder, counts: np.ndarray) -> Capture:
    dark = np.full((4, SIZE, BANDS), DARK, np.uint16)
    for name, cube in (("tarp", counts), ("dark", dark)):
        write_cube(folder / f"{name}.hdr", cube, wavelengths_nm=NM)
    return Capture("tarp", open_cube(folder / "tarp.hdr"), open_cube(folder / "dark.hdr"))


@pytest.mark.slow
@pytest.mark.parametrize("gradient", [0.0, 0.15])
@pytest.mark.parametrize("dirty", [False, True], ids=["clean", "folded"])
def test_reflectance_is_right_to_1_percent_over_the_whole_image(tmp_path, gradient, dirty):
    true_light = light(0.2, gradient)
    tarp = tarp_capture(tmp_path, exposed(true_light, tarp_reflectance(dirty), 0))
    white = white_reference(tarp)
    flat = flat_field(tarp, white, (SIZE, SIZE))
    if not dirty:
        x0, y0, x1, y1 = white.roi
        assert flat[y0:y1, x0:x1][white.mask].mean() == pytest.approx(1.0, abs=1e-4)
    # Noise-free light of a surface of reflectance 0.5, taken for counts.
    without = 0.5 * true_light[..., None] * LAMP / white.spectrum[0]
    error, error_without = without / flat[..., None] / 0.5 - 1.0, without / 0.5 - 1.0
    assert error_without.std() > 0.04
    # What the mask takes in of the fold lowers the white's spectrum; the flat field makes up for that as well.
    assert np.sqrt((error**2).mean()) < 0.003
    assert np.abs(error).max() < 0.02


def test_strong_falloff_and_bad_pixels(tmp_path):
    true_light = light(0.4, 0.1)
    counts = exposed(true_light, tarp_reflectance(False), 1)
    counts[:, 30, 2] = counts[:, 50, 4] = DARK
    counts[:, 31, 1] = 4095
    counts[..., 5] = DARK
    tarp = tarp_capture(tmp_path, counts)
    defects = find_defects(Readings(counts[10:-10], tarp.dark.read()))
    assert (defects.dead.sum(), defects.bad_bands.sum()) == (3, 1)
    flat = flat_field(tarp, white_reference(tarp, defects=defects), (SIZE, SIZE), defects)
    error = true_light / flat
    assert error.std() / error.mean() < 0.008


def test_surface_is_exact_for_polynomials_and_ignores_a_third_of_dirt():
    y, x = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 50), indexing="ij")
    true = 2.0 + x - 0.5 * y + 0.3 * x * y - 0.6 * x**2 * y**2
    region = np.zeros(true.shape, bool)
    region[4:36, 5:45] = True
    spoilt = true.copy()
    rng = np.random.default_rng(0)
    dirt = region & (rng.random(true.shape) < 0.3)
    spoilt[dirt] *= rng.uniform(0.2, 0.9, np.count_nonzero(dirt))
    spoilt[~region] = 0.0
    np.testing.assert_allclose(fit_surface(spoilt, region, 4)[region], true[region], rtol=1e-4)
    # Beyond, it goes on where the reach allows.
    np.testing.assert_allclose(fit_surface(true, region, 4)[2:38, 3:47], true[2:38, 3:47], rtol=1e-6)


def test_surface_stays_near_what_the_tarp_saw():
    y, x = np.meshgrid(np.arange(100.0), np.arange(100.0), indexing="ij")
    steep = 1.0 + ((x - 50.0) / 10.0) ** 4 + 0.0 * y
    region = np.zeros(steep.shape, bool)
    region[40:61, 40:61] = True
    surface = fit_surface(steep, region, 4)
    np.testing.assert_allclose(surface[region], steep[region], rtol=1e-6)
    assert surface.min() >= 0.5
    assert surface.max() <= 2.5 + 1e-6
    # Level from a quarter of its half width on.
    np.testing.assert_array_equal(surface[:, 70:], np.repeat(surface[:, 69:70], 30, axis=1))


def test_brightness_is_of_the_elements_in_use():
    rng = np.random.default_rng(0)
    true = rng.uniform(0.5, 1.5, (7, 5))
    dark = rng.uniform(0.0, 20.0, (5, BANDS))
    counts = true[..., None] * LAMP + dark
    use = rng.random((5, BANDS)) < 0.6
    use[3] = False
    counts[:, ~use] = 1e6
    brightness = relative_brightness(counts, dark, LAMP, use)
    np.testing.assert_allclose(brightness[:, use.any(axis=1)], true[:, use.any(axis=1)])
    np.testing.assert_array_equal(brightness[:, 3], 0.0)


def test_tarp_that_cannot_tell(tmp_path):
    tarp = tarp_capture(tmp_path, exposed(light(0.2, 0.0), tarp_reflectance(False), 0))
    white = white_reference(tarp)
    with pytest.raises(InputError, match=r"tarp\.hdr: its \(96, 96\) .* \(48, 96\)"):
        flat_field(tarp, white, (48, 96))
    small = white_reference(tarp, (40, 40, 52, 52))
    with pytest.raises(InputError, match=r"tarp\.hdr: the tarp is too small"):
        flat_field(tarp, small, (SIZE, SIZE))
