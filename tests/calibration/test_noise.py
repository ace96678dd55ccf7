"""The noise of a reading and of a reflectance, against exposures whose noise is known."""

from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.calibration.noise import (
    QUANTISATION_VARIANCE,
    NoiseModel,
    measure_noise,
    photon_transfer,
    read_noise,
    reflectance_uncertainty,
)
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.simulate.effects.detector import PhotonNoise, ReadNoise, SensorSettings

LINES, SAMPLES, BANDS = 72, 60, 40
COUNTS_PER_ELECTRON, READ_NOISE = 0.15, 4.0
SIGNAL = np.linspace(100.0, 3000.0, BANDS)
REGION = np.pad(np.ones((LINES - 8, SAMPLES - 8), bool), 4)


def digitised(mean, rng, slope=COUNTS_PER_ELECTRON, read=READ_NOISE):
    drawn = rng.poisson(mean / slope) * slope if slope else mean
    return np.rint(100.0 + drawn + read * rng.standard_normal(mean.shape)).clip(0, 4095).astype(np.uint16)


def exposures(light=1.0, **noise):
    """A tarp under ``light`` (lines, samples, bands or less) and its dark cube."""
    rng = np.random.default_rng(5)
    white = digitised(np.broadcast_to(light * SIGNAL, (LINES, SAMPLES, BANDS)), rng, **noise)
    return white, digitised(np.zeros((64, SAMPLES, BANDS)), rng, **noise)


def weave():
    return 1.0 + 0.03 * np.random.default_rng(1).standard_normal((LINES, SAMPLES, 1))


def flicker():
    return 1.0 + 0.02 * np.random.default_rng(2).standard_normal((LINES, 1, 1))


def gradient():
    return np.linspace(0.6, 1.2, LINES)[:, None, None] * np.linspace(1.1, 0.9, SAMPLES)[None, :, None]


def dirt():
    light = np.ones((LINES, SAMPLES, BANDS))
    spots = np.random.default_rng(3).random((LINES, SAMPLES)) < 0.02
    light[spots, : BANDS // 2] = 0.6
    return light


def edges():
    return np.where(REGION, 1.0, 0.1)[..., None]


@pytest.mark.parametrize("tarp", [weave, flicker, gradient, dirt, edges])
def test_slope_despite_an_uneven_tarp(tarp):
    white, dark = exposures(tarp())
    noise = measure_noise(white, REGION, dark, saturation_counts=4095)
    assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)


def test_numbers_on_another_scale_than_counts_have_the_noise_of_that_scale():
    white, dark = exposures()
    expected = measure_noise(white, REGION, dark)
    for lines in (64, 1):
        found = measure_noise(white.astype(np.float32) * 1e-4, REGION, 1e-4 * dark[:lines])
        assert found.counts_per_electron == pytest.approx(1e-4 * expected.counts_per_electron, rel=0.02)
        np.testing.assert_allclose(found.read_noise, 1e-4 * expected.read_noise, rtol=0.1)


def test_saturated_readings_and_dead_elements_are_left_out():
    white, dark = exposures(1.25)
    stuck = np.random.default_rng(4).random((SAMPLES, BANDS)) < 0.1
    white[:, stuck] = np.random.default_rng(6).integers(0, 4000, (LINES, stuck.sum()))
    dark[:, stuck] = 100
    white = white.clip(max=3200)
    noise = measure_noise(white, REGION, dark, saturation_counts=3200, dead=stuck)
    assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)
    np.testing.assert_allclose(noise.read_noise, np.hypot(READ_NOISE, np.sqrt(QUANTISATION_VARIANCE)), rtol=0.05)
    # Without the knowledge of it, either goes wrong.
    assert measure_noise(white, REGION, dark).counts_per_electron != pytest.approx(COUNTS_PER_ELECTRON, rel=0.1)


def test_flickering_elements_do_not_count_for_the_read_noise():
    white, dark = exposures()
    # A dark cube of another width is not matched by sample.
    narrow = measure_noise(white, REGION, dark[:, :20], dead=np.zeros((SAMPLES, BANDS), bool))
    assert narrow.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)
    dark[::2, :3] += 80
    np.testing.assert_allclose(read_noise(dark), np.hypot(READ_NOISE, np.sqrt(QUANTISATION_VARIANCE)), rtol=0.05)


@pytest.mark.parametrize("dark_lines", [1, 64])
@pytest.mark.parametrize("read", [0.0, READ_NOISE, 12.0])
def test_the_white_tells_the_read_noise_where_the_dark_does_not(dark_lines, read):
    white, _ = exposures(weave(), read=read)
    noise = measure_noise(white, REGION, np.full((dark_lines, SAMPLES, BANDS), 100))
    assert noise.read_noise_measured
    assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)
    np.testing.assert_allclose(noise.read_noise, np.hypot(read, np.sqrt(QUANTISATION_VARIANCE)), rtol=0.1, atol=0.4)


def test_a_white_as_bright_in_all_bands_does_not_tell_it():
    rng = np.random.default_rng(8)
    white = digitised(np.full((LINES, SAMPLES, BANDS), 2000.0), rng)
    noise = measure_noise(white, REGION, np.full((1, SAMPLES, BANDS), 100))
    assert not noise.read_noise_measured
    np.testing.assert_array_equal(noise.read_noise, np.sqrt(QUANTISATION_VARIANCE))
    # What it cannot tell apart counts as photon noise.
    whole = COUNTS_PER_ELECTRON + READ_NOISE**2 / 2000.0
    assert noise.counts_per_electron == pytest.approx(whole, rel=0.03)


def test_without_a_dark_level_rounding_is_all_that_is_sure():
    white, _ = exposures()
    noise = measure_noise(white, REGION, None)
    assert not noise.read_noise_measured
    np.testing.assert_array_equal(noise.read_noise, np.sqrt(QUANTISATION_VARIANCE))


def test_no_photon_noise_gives_slope_zero():
    white, dark = exposures(slope=0.0)
    noise = measure_noise(white, REGION, dark)
    assert noise.photon_noise_measured
    assert noise.counts_per_electron == pytest.approx(0.0, abs=1e-3)


def test_a_tarp_that_tells_nothing():
    white, dark = exposures()
    level = dark.mean(axis=0)
    assert photon_transfer(white, np.zeros_like(REGION), level, np.ones(BANDS)) is None
    full = np.full_like(white, 4095)
    assert photon_transfer(full, REGION, level, np.ones(BANDS), saturation_counts=4095) is None
    noise = measure_noise(full, REGION, dark, saturation_counts=4095)
    assert noise.counts_per_electron == 0.0
    assert not noise.photon_noise_measured


def test_real_white_reference_follows_the_line():
    folder = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
    white, dark = (open_cube(folder / f"{name}_reference_crop.hdr").read() for name in ("white", "dark"))
    noise = measure_noise(white, np.ones(white.shape[:2], bool), dark)
    mean = white.mean(axis=(0, 1)) - dark.mean(axis=(0, 1))
    seen = np.square(np.diff(white.astype(float), 2, axis=0)).mean(axis=(0, 1)) / 6.0
    assert mean.max() > 20.0 * mean.min()
    assert np.median(np.abs(seen / noise.variance(mean) - 1.0)) < 0.1


# The uncertainty of a reflectance, against exposures drawn again and again with the simulator's noise.

DARK_LEVEL, ELECTRONS_PER_COUNT, READ_ELECTRONS = 120.0, 7.3, 40.0
FEW_BANDS = 12
WHITE = np.linspace(400.0, 3300.0, FEW_BANDS)
LEVELS = (0.03, 0.4, 0.95)
EXPOSURES, PIXELS = 250, 40


def read_out(signal, rng):
    sensor = SensorSettings(dark_level=DARK_LEVEL, full_well_electrons=4095 * ELECTRONS_PER_COUNT)
    counts = (signal + DARK_LEVEL).astype(np.float32)
    for effect in (PhotonNoise(), ReadNoise(electrons=READ_ELECTRONS)):
        counts = effect.read_out(counts, sensor, {}, rng)
    return np.rint(counts).astype(np.float64)


def moving_average(spectrum, width):
    reach = width // 2
    return np.stack([spectrum[..., b - r : b + r + 1].mean(axis=-1) for b, r in enumerate(reach)], axis=-1)


# The white averaged over many pixels, and over so few that its part of the noise shows; many dark lines, and few.
@pytest.mark.slow
@pytest.mark.parametrize(("white_lines", "columns", "dark_lines"), [(20, 20, 16), (1, 3, 2)])
def test_agrees_with_repeated_exposures(white_lines, columns, dark_lines):
    rng = np.random.default_rng(8)
    panel, white_time_over_sample_time = np.linspace(0.95, 0.85, FEW_BANDS), 0.6
    width = np.array([1, 3, *[5] * (FEW_BANDS - 4), 3, 1])
    sample_signal = np.array(LEVELS)[:, None, None] / panel * WHITE / white_time_over_sample_time
    reflectance = []
    for _ in range(EXPOSURES):
        white = read_out(np.broadcast_to(WHITE, (white_lines, columns, FEW_BANDS)), rng)
        white_dark = read_out(np.zeros((dark_lines, columns, FEW_BANDS)), rng).mean(axis=0)
        level = moving_average((white - white_dark).mean(axis=(0, 1)), width)
        # A pixel a column, so that each has its own dark.
        sample = read_out(np.broadcast_to(sample_signal, (len(LEVELS), PIXELS, FEW_BANDS)), rng)
        sample_dark = read_out(np.zeros((dark_lines, PIXELS, FEW_BANDS)), rng).mean(axis=0)
        reflectance.append(panel * white_time_over_sample_time * (sample - sample_dark) / level)
    spread = np.sqrt(np.var(reflectance, axis=0, ddof=1).mean(axis=1))
    noise = NoiseModel(
        np.full(FEW_BANDS, np.hypot(READ_ELECTRONS / ELECTRONS_PER_COUNT, np.sqrt(1 / 12))),
        1.0 / ELECTRONS_PER_COUNT,
        True,
        True,
    )
    uncertainty = reflectance_uncertainty(
        noise,
        WHITE,
        white_pixels=white_lines * columns,
        smoothing_bands=width,
        frame_dark_readings=dark_lines,
        white_dark_readings=dark_lines * columns,
        panel_reflectance=panel,
        integration_ratio=white_time_over_sample_time,
    )
    expected = uncertainty.standard_deviation(np.broadcast_to(np.array(LEVELS)[:, None], (len(LEVELS), FEW_BANDS)))
    # What the exposures have in common is known from these alone: their number limits how well.
    common = uncertainty.quadratic * np.array(LEVELS)[:, None] ** 2 / expected**2
    tolerance = 0.05 if white_lines > 1 else 0.12
    assert (common.max() > 0.3) == (white_lines == 1)
    np.testing.assert_allclose(spread, expected, rtol=tolerance)
    assert np.abs(np.log(spread / expected)).mean() < 0.05


def test_without_dark_there_is_no_noise_of_it():
    noise = NoiseModel(np.full(3, 2.0), 0.0, True, False)
    white = np.full(3, 100.0)
    known = {"white_pixels": 10, "smoothing_bands": np.ones(3, int)}
    none = reflectance_uncertainty(noise, white, frame_dark_readings=0, white_dark_readings=0, **known)
    np.testing.assert_allclose(none.constant, 4e-4)
    np.testing.assert_allclose(none.quadratic, 0.4e-4)
    single = reflectance_uncertainty(noise, white, frame_dark_readings=1, white_dark_readings=10, **known)
    np.testing.assert_allclose(single.constant, 8e-4)
    np.testing.assert_allclose(single.quadratic, 0.8e-4)
