"""Drift of the lamps, against simulated sessions whose drift is known and against its closed forms."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from scipy import stats

from hsi_sc_nerf.calibration.lamp_drift import (
    FLOOR,
    LampDriftEstimate,
    NotMeasurable,
    correction,
    drift_p_value,
    fit_over_wavelength,
    measure_lamp_drift,
    survey_lines,
)
from hsi_sc_nerf.calibration.noise import NoiseModel
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override, read_effects

NOISE = ("photon_noise", "read_noise", "dark_pattern")
DRIFT = {"lamp_drift": {"percent": -7.0, "temperature_change_k": -100.0}}


def simulated(*effects, name="pear", bands=40, frames=8, **camera):
    """Whether the drift of a simulated session can be measured, what it is, and what it should be."""
    scene = override(load_scene(name), size_px=128, bands=bands, frames=frames)
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, supersampling=2, **camera))
    scene = dataclasses.replace(scene, effects=read_effects(effects, "test"))
    simulation = Simulation(scene)
    captures = [simulation.frame(number) for number in range(frames)]
    slope = 4095 / scene.sensor.full_well_electrons if NOISE[0] in effects else 0.0
    read = 40.0 * 4095 / scene.sensor.full_well_electrons if NOISE[1] in effects else 0.0
    noise = NoiseModel(np.full(bands, np.sqrt(read**2 + 1 / 12)), slope, True, True)
    lines = survey_lines(128, 128)
    drift = measure_lamp_drift(
        lambda number: captures[number].counts[lines],
        frames,
        [capture.dark.mean(axis=0) for capture in captures],
        noise,
        simulation.wavelengths_nm,
        saturation_counts=4095,
    )
    lamps = [effect for effect in scene.effects if effect.name == "lamp_drift"]
    true = np.ones((frames, bands))
    for lamp in lamps:
        kelvin = scene.sensor.lamp_temperature_k
        factors = [lamp.factor(128, simulation.wavelengths_nm, kelvin, t) for t in simulation.plan.elapsed]
        true = np.stack(factors)[:, 0, 0]
    return drift, true / true[0], np.stack([capture.coverage for capture in captures])[:, lines]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "name"),
    [
        ((), "pear"),
        (("textured_background", "optical_blur", "drying", "off_centre"), "apple"),
        (("bad_pixels", "illumination_falloff", "spectral_smile", "image_rotation", "lamp"), "maize"),
    ],
)
def test_drift_of_a_noisy_session_within_a_third_of_a_percent(effects, name):
    drift, true, coverage = simulated(*NOISE, *effects, DRIFT, name=name)
    assert isinstance(drift, LampDriftEstimate)
    assert drift.significant
    assert np.sqrt(np.mean((drift.factor / true - 1.0) ** 2)) < 0.003
    assert true.min() < 0.8
    # The errors are as large as they are said to be.
    off = (drift.factor - true)[1:] / drift.standard_error[1:]
    assert np.sqrt((off**2).mean()) < 2.5
    assert np.nanstd((drift.measured - true)[-1]) > np.std((drift.factor - true)[-1])
    # The object stands on few of the pixels, and only where it looks the same from all sides.
    assert (drift.static & (coverage.max(axis=0) > 0.5)).sum() < 0.1 * drift.static.sum()
    assert drift.static.mean() > 0.5
    np.testing.assert_array_equal(correction(drift, "auto"), drift.factor)


@pytest.mark.slow
@pytest.mark.parametrize("effects", [(), NOISE, (*NOISE, "textured_background", "wobble", "drying")])
def test_session_without_drift_stays_as_it_is(effects):
    drift, _, _ = simulated(*effects)
    assert isinstance(drift, LampDriftEstimate)
    assert not drift.significant
    assert np.abs(drift.factor - 1.0).max() < 0.004
    assert correction(drift, "auto") is None


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "name"), [((), "pear"), ((*NOISE, DRIFT), "maize"), ((*NOISE, "lamp"), "apple")])
def test_not_measurable_where_the_object_fills_the_frame(effects, name):
    drift, _, _ = simulated(*effects, name=name, bands=20, frames=5, field_of_view_deg=4.0, aim_height_m=0.11)
    assert isinstance(drift, NotMeasurable)
    assert "% of the surveyed pixels" in drift.reason
    assert correction(drift, "always") is None


# Drawn sessions: a still background beside a moving thing.

FRAMES, LINES, SAMPLES, BANDS = 6, 10, 64, 24
WAVELENGTHS_NM = np.linspace(400.0, 1000.0, BANDS)
# 5 % in the red, 10 % in the blue.
TRUE = 1.0 - 0.05 * np.linspace(0.0, 1.0, FRAMES)[:, None] * (700.0 / WAVELENGTHS_NM) ** 1.2
QUIET = NoiseModel(np.full(BANDS, 2.0), 0.1, True, True)


def drawn(true=TRUE, moving=0.4, *, shape=(LINES, SAMPLES), scatter=0.0, fireflies=0.0, reflected=0.0):
    """Counts of ``shape``. Scatter and fireflies are common to all bands; reflected light turns with the object."""
    rng = np.random.default_rng(11)
    across = int(moving * shape[1])
    scene = np.repeat(rng.uniform(500.0, 2500.0, (1, *shape, BANDS)), FRAMES, axis=0)
    scene[:, :, :across] = rng.uniform(500.0, 2500.0, (FRAMES, shape[0], across, BANDS))
    turn = np.linspace(0.0, 1.0, shape[1])[:, None] + np.arange(FRAMES)[:, None, None, None] / FRAMES
    scene *= 1.0 + reflected * np.sin(2.0 * np.pi * turn) * WAVELENGTHS_NM / 700.0
    of_pixel = scene.shape[:3]
    scene *= np.exp(scatter * rng.standard_normal(of_pixel))[..., None]
    scene *= np.where(rng.random(of_pixel) < fireflies, rng.uniform(1.5, 10.0, of_pixel), 1.0)[..., None]
    light = scene * true[:, None, None]
    noisy = light + np.sqrt(QUIET.variance(light)) * rng.standard_normal(light.shape)
    return np.rint(noisy + 100.0).clip(0, 65535).astype(np.uint16)


def measure(counts, dark=100.0, **masks):
    level = [np.full((1, BANDS), dark)] if np.isscalar(dark) else dark
    return measure_lamp_drift(counts.__getitem__, FRAMES, level, QUIET, WAVELENGTHS_NM, **masks)


LARGE = (60, 128)
slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("scatter", "fireflies", "moving"),
    [slow(0.01, 0.0, 0.6), slow(0.05, 0.0, 0.0), slow(0.06, 0.0, 0.3), (0.05, 0.05, 0.3)],
)
def test_scatter_of_the_pixels_averages_out(scatter, fireflies, moving):
    drift = measure(drawn(moving=moving, shape=LARGE, scatter=scatter, fireflies=fireflies))
    assert not drift.static[:, : int(moving * LARGE[1])].any()
    assert drift.static[:, int(moving * LARGE[1]) :].mean() > 0.6
    error = drift.factor / TRUE - 1.0
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.003
    # The errors are as large as they are said to be.
    assert np.abs(error[1:] / drift.standard_error[1:]).max() < 3.0
    assert drift.standard_error.max() < 0.003
    assert drift.significant
    assert drift.scatter == pytest.approx(scatter, rel=0.25)


@pytest.mark.parametrize("shape", [(8, 40), (16, 64)])
def test_few_scattering_pixels_have_large_errors(shape):
    drift = measure(drawn(shape=shape, scatter=0.05))
    error = drift.factor - TRUE
    assert np.abs(error[1:] / drift.standard_error[1:]).max() < 3.0
    assert drift.standard_error[1:].min() > 0.04 / np.sqrt(shape[0] * shape[1])


@pytest.mark.parametrize("reflected", [0.0, 0.01])
@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_scatter_and_reflections_of_the_turning_object_are_no_drift(scatter, reflected):
    drift = measure(drawn(np.ones_like(TRUE), shape=(32, 64), scatter=scatter, reflected=reflected))
    assert not drift.significant
    assert correction(drift, "auto") is None


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_nothing_is_measured_without_a_wall(scatter):
    moving = measure(drawn(moving=1.0, scatter=scatter, shape=(32, 64)))
    assert isinstance(moving, NotMeasurable)
    assert "follow one course" in moving.reason


def test_static_pixels_are_found_and_their_sum_is_the_drift():
    counts = drawn()
    drift = measure(counts)
    assert not drift.static[:, : int(0.4 * SAMPLES)].any()
    assert drift.static[:, int(0.4 * SAMPLES) :].mean() > 0.98
    np.testing.assert_allclose(drift.factor, TRUE, atol=1e-3)
    light = counts[:, drift.static].sum(axis=1) - 100.0 * drift.static.sum()
    np.testing.assert_allclose(drift.measured, light / light[0], rtol=5e-4)
    np.testing.assert_array_equal(drift.factor[0], 1.0)
    np.testing.assert_array_equal(drift.standard_error[0], 0.0)


def test_dark_of_each_frame():
    level = np.random.default_rng(3).uniform(0.0, 300.0, (FRAMES, SAMPLES, BANDS)).round()
    counts = (drawn() + level[:, None] - 100.0).astype(np.uint16)
    np.testing.assert_allclose(measure(counts, list(level)).factor, measure(drawn()).factor, atol=1e-6)
    assert isinstance(measure(counts), NotMeasurable)


def test_saturated_and_dead_elements_and_no_data_are_left_out():
    counts, dead = drawn(), np.zeros((SAMPLES, BANDS), bool)
    dead[::5, ::3] = True
    counts[:, :, dead] = np.random.default_rng(2).choice([100, 4095], (FRAMES, LINES, dead.sum()))
    drift = measure(counts, saturation_counts=4095, dead=dead)
    assert drift.static[:, int(0.4 * SAMPLES) :].mean() > 0.98
    np.testing.assert_allclose(drift.factor, TRUE, atol=1e-3)
    limit = 1900
    drift = measure(counts.clip(max=limit), saturation_counts=limit, dead=dead)
    np.testing.assert_allclose(drift.factor, TRUE, atol=2e-3)
    gaps = np.random.default_rng(5).random(counts.shape) < 1e-3
    drift = measure(np.where(gaps, np.nan, drawn()), saturation_counts=4095)
    np.testing.assert_allclose(drift.factor, TRUE, atol=1e-3)
    assert np.isfinite(drift.measured).all()
    # Unknown ones take their samples out of what stands still.
    assert not measure(counts).static[:, ::5].any()


def test_what_cannot_be_measured_says_why():
    darkness = measure(np.full((FRAMES, LINES, SAMPLES, BANDS), 100, np.uint16))
    assert isinstance(darkness, NotMeasurable)
    few = measure_lamp_drift(drawn()[..., :2].__getitem__, FRAMES, [np.zeros((1, 2))], QUIET, WAVELENGTHS_NM[:2])
    assert "2 bands are too few" in few.reason
    single = measure_lamp_drift(drawn().__getitem__, 1, [np.zeros((1, BANDS))], QUIET, WAVELENGTHS_NM)
    assert single == NotMeasurable("there is a single frame")


def test_correction_is_the_users_choice():
    drifting, steady = measure(drawn()), measure(drawn(np.ones_like(TRUE)))
    assert drifting.significant
    assert not steady.significant
    for correct, of_drifting, of_steady in (("auto", True, False), ("always", True, True), ("never", False, False)):
        assert (correction(drifting, correct) is not None) == of_drifting
        assert (correction(steady, correct) is not None) == of_steady


@pytest.mark.parametrize(("percent", "significant"), [(0.05, False), (1.0, True)])
def test_a_change_within_the_floor_is_no_drift(percent, significant):
    true = np.broadcast_to(1.0 - 0.01 * percent * np.linspace(0.0, 1.0, FRAMES)[:, None], TRUE.shape)
    assert measure(drawn(true)).significant == significant


def test_false_alarms_are_as_rare_as_said():
    rng, frames, terms = np.random.default_rng(9), 12, 3
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, 50), terms - 1)
    covariance = np.diag([1.0, 2.0, 4.0]) * 1e-8
    spread = np.sqrt(np.diag(covariance) + FLOOR**2 / terms / np.square(basis).mean(axis=0))
    p_values = []
    for _ in range(2000):
        coefficients = spread * rng.standard_normal((frames, terms))
        p_values.append(drift_p_value(coefficients - coefficients.mean(axis=0), covariance, basis))
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


def test_fits_scatter_as_their_covariance_says():
    basis, shape = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, BANDS), 2), [-0.1, 0.3, 0.05]
    rng = np.random.default_rng(4)
    variance = np.linspace(1e-6, 1e-4, BANDS)
    light = np.outer([0.0, 1.0], basis @ shape)
    noisy = [light + np.sqrt(variance) * rng.standard_normal(light.shape) for _ in range(800)]
    repeats = np.array([fit_over_wavelength(one, variance, basis, 0.0)[0] for one in noisy])
    change = repeats[:, 1] - repeats[:, 0]
    np.testing.assert_allclose(change.mean(axis=0), shape, atol=1e-3)
    _, covariance = fit_over_wavelength(np.zeros(light.shape), variance, basis, 0.0)
    np.testing.assert_allclose(np.var(change, axis=0), 2.0 * np.diag(covariance), rtol=0.2)


def test_scatter_beyond_the_noise_makes_the_errors_larger():
    variance, basis = np.full(BANDS, 1e-6), np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, BANDS), 2)
    scatter = 3e-3 * np.random.default_rng(7).standard_normal((20, BANDS))
    calm = fit_over_wavelength(np.zeros((20, BANDS)), variance, basis, 0.0)[1]
    scattered = fit_over_wavelength(scatter, variance, basis, 0.0)[1]
    assert scattered / calm == pytest.approx(np.full((3, 3), 9.0), rel=0.2)


@pytest.mark.parametrize(
    ("lines", "samples", "count"),
    [(512, 512, 32), (512, 64, 256), (1000, 512, 60), (128, 128, 128), (10, 512, 10), (2, 9, 2), (1, 1, 1)],
)
def test_survey_lines(lines, samples, count):
    chosen = survey_lines(lines, samples)
    assert chosen[0] == 0
    assert chosen[-1] == lines - 1
    assert (np.diff(chosen) > 0).all()
    assert len(chosen) <= count
    np.testing.assert_allclose(chosen, (lines - 1 - chosen)[::-1], atol=1.0)
    if lines > 4 * count:
        steps = np.diff(chosen)
        assert len(chosen) == count
        assert steps[0] < steps[count // 2]
