from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsi_sc_nerf.data.calibration.config import CalibrationConfig
from hsi_sc_nerf.data.calibration.reflectance import calibrate, dark_counts, normalise
from hsi_sc_nerf.data.calibration.white_reference import (
    deviation_map,
    find_coarse_roi,
    smooth_spectrum,
    white_mask,
    white_reference,
)
from hsi_sc_nerf.data.envi import open_cube, write_cube
from hsi_sc_nerf.data.pseudo_rgb import gray_image, nearest_bands, pseudo_rgb
from hsi_sc_nerf.data.report import white_reference_picture
from hsi_sc_nerf.data.session import Capture
from hsi_sc_nerf.errors import InputError

MAIZE = Path(__file__).parent / "data" / "maize_kernel"
WAVELENGTHS_NM = np.linspace(400.0, 1000.0, 7)
LAMP = np.array([100.0, 400.0, 900.0, 1600.0, 1200.0, 800.0, 300.0])
CONFIG = CalibrationConfig()


def capture(folder: Path, name: str, counts: np.ndarray, dark: np.ndarray | None = None) -> Capture:
    cubes = []
    for stem, cube in ((name, counts), (f"DARKREF_{name}", dark)):
        if cube is not None:
            write_cube(folder / f"{stem}.hdr", cube, wavelengths_nm=WAVELENGTHS_NM)
        cubes.append(None if cube is None else open_cube(folder / f"{stem}.hdr"))
    return Capture(name, cubes[0], cubes[1])


def tarp_scene(level: float = 10.0) -> np.ndarray:
    """A tarp in the middle of a dark image, brighter by the lamp's spectrum, with a fold and a bright speck."""
    counts = np.full((40, 60, 7), level)
    counts[8:32, 10:50] += LAMP
    counts[8:32, 10:16] -= 0.3 * LAMP
    counts[20, 30] += 0.5 * LAMP
    return counts


def test_roi_is_the_largest_bright_region():
    brightness = np.zeros((40, 60))
    brightness[8:32, 10:50] = 1.0
    brightness[36:39, 2:5] = 1.0
    assert find_coarse_roi(brightness) == (10, 8, 50, 32)
    assert find_coarse_roi(np.ones((4, 5))) == (0, 0, 5, 4)
    assert find_coarse_roi(np.zeros((4, 5))) is None


def test_deviation_is_the_mean_of_ratios():
    rng = np.random.default_rng(0)
    white = rng.uniform(0.5, 1.5, (4, 5, 7)) * LAMP
    mean = np.array([np.mean(white[..., band]) for band in range(7)])
    slow = np.zeros((4, 5))
    for y in range(4):
        for x in range(5):
            slow[y, x] = sum(abs(white[y, x, b] - mean[b]) / mean[b] for b in range(7)) / 7
    np.testing.assert_allclose(deviation_map(white), slow, rtol=1e-12)
    ratio_of_means = np.abs(white - mean).mean(-1) / mean.mean()
    assert np.abs(slow - ratio_of_means).max() > 0.01


def test_deviation_leaves_bands_without_counts_out():
    white = np.stack([np.full((3, 3), 2.0), np.zeros((3, 3))], axis=-1)
    white[0, 0, 0] = 11.0
    np.testing.assert_allclose(deviation_map(white)[0, 0], 11.0 / 3.0 - 1.0)
    assert np.isinf(deviation_map(np.zeros((3, 3, 2)))).all()


def test_mask_keeps_the_percentile_and_its_largest_part():
    deviation = np.full((20, 40), 0.5)
    deviation[:, :24] = 0.01
    deviation[:, 32:] = 0.01
    deviation[10, 10] = 0.5
    mask = white_mask(deviation, percentile=70.0, kernel_px=5)
    expected = np.zeros((20, 40), bool)
    expected[:, :24] = True
    np.testing.assert_array_equal(mask, expected)


@given(st.integers(1, 60), st.floats(-5.0, 5.0), st.floats(-100.0, 100.0), st.sampled_from([1, 3, 5, 9]))
def test_smoothing_leaves_lines_alone_in_every_band(bands, slope, offset, window):
    line = offset + slope * np.arange(bands)
    np.testing.assert_allclose(smooth_spectrum(line, 3.0 * np.arange(bands), window, 1e3), line, atol=1e-10)


def test_smoothing_averages_inside():
    spectrum = np.array([0.0, 0, 0, 5, 0, 0, 0])
    bands_nm = 700.0 - 3.0 * np.arange(7)
    np.testing.assert_allclose(smooth_spectrum(spectrum, bands_nm, 5, 12.0), [0, 0, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(smooth_spectrum(spectrum, bands_nm, 1, 12.0), spectrum)


def test_smoothing_never_spans_more_than_it_may():
    spectrum = np.array([0.0, 0, 0, 6, 0, 0, 0])
    narrow = 3.0 * np.arange(7)
    np.testing.assert_allclose(smooth_spectrum(spectrum, narrow, 5, 11.9), [0, 0, 2, 2, 2, 0, 0])
    # Broad bands are left alone, and so is each band of a camera whose bands lie apart on one side only.
    np.testing.assert_array_equal(smooth_spectrum(spectrum, 10 * narrow, 5, 15.0), spectrum)
    uneven = np.array([0.0, 3, 6, 9, 40, 71, 102])
    np.testing.assert_allclose(smooth_spectrum(spectrum, uneven, 5, 15.0), [0, 0, 2, 6, 0, 0, 0])


def test_a_camera_with_few_broad_bands_keeps_its_lamps_spectrum(tmp_path):
    """Five bands of seven would smooth the lamp away, and with it the reflectance."""
    white = white_reference(capture(tmp_path, "white", tarp_scene(0.0)), CONFIG)
    np.testing.assert_array_equal(white.spectrum, white.measured)
    smoothed = white_reference(capture(tmp_path, "white", tarp_scene(0.0)), CalibrationConfig(smoothing_max_nm=1e3))
    np.testing.assert_allclose(smoothed.spectrum, smooth_spectrum(white.measured, WAVELENGTHS_NM, 5, 1e3))


def test_dark_counts_by_sample_or_by_band():
    dark = np.arange(2 * 3 * 4).reshape(2, 3, 4)
    np.testing.assert_allclose(dark_counts(dark, 3), dark.mean(0, keepdims=True))
    np.testing.assert_allclose(dark_counts(dark, 9), dark.mean((0, 1), keepdims=True))
    assert dark_counts(None, 3) is None


@settings(deadline=None)
@given(st.integers(0, 2**31))
def test_normalisation_inverts_the_exposure(seed):
    rng = np.random.default_rng(seed)
    reflectance = rng.uniform(0.0, 1.0, (3, 4, 7))
    dark = rng.uniform(0.0, 50.0, (1, 4, 7))
    counts = reflectance * LAMP + dark
    np.testing.assert_allclose(normalise(counts, dark.astype(np.float32), LAMP), reflectance, atol=2e-6)


def test_normalisation_clips_and_keeps_its_input():
    counts = np.array([[[0.0] * 7, [500.0] * 7, [5000.0] * 7]], dtype=np.float32)
    before = counts.copy()
    result = normalise(counts, np.full((1, 1, 7), 100.0, np.float32), np.full(7, 1000.0))
    np.testing.assert_allclose(result[0, :, 0], [0.0, 0.4, 1.0])
    np.testing.assert_array_equal(counts, before)
    np.testing.assert_allclose(normalise(counts, None, np.full(7, 1000.0), (0.0, 2.0))[0, 2], 2.0)


def test_white_reference_of_a_folded_tarp(tmp_path):
    dark = np.full((3, 60, 7), 10.0)
    white = white_reference(capture(tmp_path, "white", tarp_scene(), dark), CONFIG)
    assert white.roi == (10, 8, 50, 32)
    assert not white.mask[:, :5].any()
    assert white.mask[:, 7:].all()
    # The speck, which closing takes in, weighs half a pixel among the mask's.
    np.testing.assert_allclose(white.measured, LAMP, rtol=2e-3)


def test_given_roi(tmp_path):
    tarp = capture(tmp_path, "white", tarp_scene(0.0))
    white = white_reference(tarp, CalibrationConfig(roi=(20, 10, 29, 30)))
    assert white.deviation.shape == (20, 9)
    np.testing.assert_allclose(white.measured, LAMP)
    with pytest.raises(InputError, match=r"white\.hdr.*not inside its 60 x 40 pixels"):
        white_reference(tarp, CalibrationConfig(roi=(20, 10, 61, 30)))


@pytest.mark.parametrize("counts", [np.zeros((20, 20, 7)), np.random.default_rng(1).gamma(0.2, 1.0, (20, 20, 7))])
def test_tarp_with_no_usable_region(tmp_path, counts):
    with pytest.raises(InputError, match=r"white\.hdr: the tarp has no usable region"):
        white_reference(capture(tmp_path, "white", counts), CONFIG)


def test_white_spectrum_that_is_zero_in_a_band(tmp_path):
    counts = tarp_scene(0.0)
    counts[..., 3] = 0.0
    with pytest.raises(InputError, match=r"white\.hdr: the white spectrum is zero at 700\.00 nm \(1 such"):
        white_reference(capture(tmp_path, "white", counts), CONFIG)


def test_white_spectrum_not_above_dark(tmp_path):
    counts = tarp_scene()
    counts[..., 6] = 10.0
    with pytest.raises(InputError, match=r"not above the dark counts at 1000\.00 nm"):
        white_reference(capture(tmp_path, "white", counts, np.full((2, 60, 7), 10.0)), CONFIG)


def test_real_maize_kernel():
    kernel, dark, white = (
        open_cube(MAIZE / f"{name}.hdr")
        for name in ("4-22-22_right_same_B73_top_00", "dark_reference_crop", "white_reference_crop")
    )
    reference = white_reference(Capture("white", white, dark), CONFIG)
    reflectance = calibrate(Capture("kernel", kernel, dark), reference.spectrum, CONFIG)
    assert reflectance.dtype == np.float32
    assert reflectance.min() >= 0.0
    assert reflectance.max() <= 1.0
    centre = reflectance[13:18, 19:24].mean(axis=(0, 1))
    bands = nearest_bands(kernel.wavelengths_nm, [550.0, 700.0, 750.0, 800.0, 900.0])
    np.testing.assert_allclose(centre[bands], [0.54, 0.83, 0.85, 0.85, 0.85], atol=0.025)


def test_pictures_of_bands():
    reflectance = np.zeros((2, 2, 7), np.float32)
    reflectance[0, 0] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.5]
    image = pseudo_rgb(reflectance, WAVELENGTHS_NM, (790.0, 500.0, 1200.0))
    assert image[0, 0].tolist() == [round(0.5 * 255), round(0.2 * 255), 255]
    assert gray_image(reflectance, WAVELENGTHS_NM, (450.0, 700.0))[0, 0] == round(0.3 * 255)
    assert gray_image(reflectance[..., :6], WAVELENGTHS_NM[:6], (2000.0, 2500.0))[0, 0] == round(0.35 * 255)


def test_white_reference_picture(tmp_path):
    tarp = capture(tmp_path, "white", tarp_scene())
    path = tmp_path / "report" / "white_reference.png"
    white_reference_picture(path, tarp.cube, white_reference(tarp, CONFIG), (598.0, 548.0, 449.0))
    picture = cv2.imread(str(path))
    assert picture.shape[0] > 300
    assert picture.std() > 10.0
    assert [p.name for p in path.parent.iterdir()] == ["white_reference.png"]
