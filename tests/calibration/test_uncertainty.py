"""The uncertainty of a reflectance, against exposures drawn again and again with the simulator's noise."""

from __future__ import annotations

import numpy as np
import pytest

from hsi_sc_nerf.calibration.noise import NoiseModel, reflectance_uncertainty
from hsi_sc_nerf.calibration.report import draw_uncertainty
from hsi_sc_nerf.packed.cube import ReflectanceUncertainty
from hsi_sc_nerf.simulate.effects.detector import PhotonNoise, ReadNoise, ReadoutContext

DARK_LEVEL, ELECTRONS_PER_COUNT, READ_ELECTRONS = 120.0, 7.3, 40.0
BANDS = 12
WHITE = np.linspace(400.0, 3300.0, BANDS)
LEVELS = (0.03, 0.4, 0.95)
EXPOSURES, PIXELS = 250, 40


def expose(signal, rng):
    context = ReadoutContext(4095, DARK_LEVEL, ELECTRONS_PER_COUNT, {}, rng)
    counts = (signal + DARK_LEVEL).astype(np.float32)
    for effect in (PhotonNoise(), ReadNoise(electrons=READ_ELECTRONS)):
        counts = effect.read_out(counts, context)
    return np.rint(counts).astype(np.float64)


def moving_average(spectrum, width):
    reach = width // 2
    return np.stack([spectrum[..., b - r : b + r + 1].mean(axis=-1) for b, r in enumerate(reach)], axis=-1)


# The white averaged over many pixels, and over so few that its share shows; many dark lines, and few.
@pytest.mark.slow
@pytest.mark.parametrize(("white_lines", "columns", "dark_lines"), [(20, 20, 16), (1, 3, 2)])
def test_agrees_with_repeated_exposures(white_lines, columns, dark_lines):
    rng = np.random.default_rng(8)
    panel, white_time_over_sample_time = np.linspace(0.95, 0.85, BANDS), 0.6
    width = np.array([1, 3, *[5] * (BANDS - 4), 3, 1])
    sample_signal = np.array(LEVELS)[:, None, None] / panel * WHITE / white_time_over_sample_time
    reflectance = []
    for _ in range(EXPOSURES):
        white = expose(np.broadcast_to(WHITE, (white_lines, columns, BANDS)), rng)
        white_dark = expose(np.zeros((dark_lines, columns, BANDS)), rng).mean(axis=0)
        level = moving_average((white - white_dark).mean(axis=(0, 1)), width)
        # A pixel a column, so that each has its own dark.
        sample = expose(np.broadcast_to(sample_signal, (len(LEVELS), PIXELS, BANDS)), rng)
        sample_dark = expose(np.zeros((dark_lines, PIXELS, BANDS)), rng).mean(axis=0)
        reflectance.append(panel * white_time_over_sample_time * (sample - sample_dark) / level)
    spread = np.sqrt(np.var(reflectance, axis=0, ddof=1).mean(axis=1))
    noise = NoiseModel(
        np.full(BANDS, np.hypot(READ_ELECTRONS / ELECTRONS_PER_COUNT, np.sqrt(1 / 12))),
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
    expected = uncertainty.standard_deviation(np.broadcast_to(np.array(LEVELS)[:, None], (len(LEVELS), BANDS)))
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


def test_standard_deviation_is_the_root_of_a_parabola():
    uncertainty = ReflectanceUncertainty(np.array([1e-4]), np.array([2e-4]), np.array([3e-4]))
    reflectance = np.array([[-0.2], [0.0], [1.0]])
    np.testing.assert_allclose(uncertainty.standard_deviation(reflectance)[:, 0] ** 2, [1e-4, 1e-4, 6e-4])
    np.testing.assert_allclose(uncertainty.standard_deviation(np.array([0.5])), np.sqrt(2.75e-4))


def test_picture(tmp_path):
    uncertainty = ReflectanceUncertainty(*(np.full(5, value) for value in (1e-5, 2e-5, 1e-9)))
    draw_uncertainty(tmp_path / "uncertainty.png", uncertainty, np.linspace(400.0, 1000.0, 5))
    assert (tmp_path / "uncertainty.png").stat().st_size > 5000
