"""The noise of a reading, against simulated and drawn exposures whose noise is known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.calibration.noise import (
    QUANTISATION_VARIANCE,
    NoiseModel,
    measure_noise,
    photon_transfer_slope,
    read_noise,
)
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.simulate import frames
from hsi_sc_nerf.simulate.effects import read_effects
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

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


@pytest.mark.slow
def test_simulated_session_within_three_percent():
    scene = override(load_scene("sphere"), size_px=128, bands=204, frames=1)
    effects = read_effects(["illumination_falloff", "photon_noise", "dark_pattern", "read_noise"], "test")
    simulation = Simulation(dataclasses.replace(scene, effects=effects))
    white = simulation.white()
    edge = round(frames.TARP_MARGIN * 128)
    region = np.pad(np.ones((128 - 2 * edge, 128 - 2 * edge), bool), edge)
    noise = measure_noise(white.counts, region, white.dark, saturation_counts=4095)
    counts_per_electron = 4095 / scene.sensor.full_well_electrons
    assert noise.photon_noise_measured
    assert noise.read_noise_measured
    assert noise.counts_per_electron == pytest.approx(counts_per_electron, rel=0.03)
    expected = np.sqrt((40.0 * counts_per_electron) ** 2 + QUANTISATION_VARIANCE)
    np.testing.assert_allclose(noise.read_noise, expected, rtol=0.03)


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


@pytest.mark.parametrize("tarp", [weave, flicker, gradient, dirt])
def test_slope_despite_an_uneven_tarp(tarp):
    white, dark = exposures(tarp())
    noise = measure_noise(white, REGION, dark, saturation_counts=4095)
    assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)


def test_edges_outside_the_region_do_not_count():
    light = np.where(REGION, 1.0, 0.1)[..., None]
    white, dark = exposures(light)
    assert measure_noise(white, REGION, dark).counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)


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
    _, dark = exposures()
    dark[::2, :3] += 80
    np.testing.assert_allclose(read_noise(dark), np.hypot(READ_NOISE, np.sqrt(QUANTISATION_VARIANCE)), rtol=0.05)


@pytest.mark.parametrize("dark", [None, np.full((1, SAMPLES, BANDS), 100), np.full((64, SAMPLES, BANDS), 100)])
def test_rounding_is_all_that_is_sure_of_a_dark_without_noise(dark):
    white, _ = exposures(read=0.0)
    noise = measure_noise(white, REGION, dark)
    assert not noise.read_noise_measured
    np.testing.assert_array_equal(noise.read_noise, np.sqrt(QUANTISATION_VARIANCE))
    if dark is not None:
        assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)


def test_no_photon_noise_gives_slope_zero():
    white, dark = exposures(slope=0.0)
    noise = measure_noise(white, REGION, dark)
    assert noise.photon_noise_measured
    assert noise.counts_per_electron == pytest.approx(0.0, abs=1e-3)


def test_a_tarp_that_tells_nothing():
    white, dark = exposures()
    level = dark.mean(axis=0)
    assert photon_transfer_slope(white, np.zeros_like(REGION), level, np.ones(BANDS)) is None
    full = np.full_like(white, 4095)
    assert photon_transfer_slope(full, REGION, level, np.ones(BANDS), saturation_counts=4095) is None
    noise = measure_noise(full, REGION, dark, saturation_counts=4095)
    assert noise.counts_per_electron == 0.0
    assert not noise.photon_noise_measured


def test_dark_cube_of_another_width():
    white, dark = exposures()
    noise = measure_noise(white, REGION, dark[:, :20], dead=np.zeros((SAMPLES, BANDS), bool))
    assert noise.counts_per_electron == pytest.approx(COUNTS_PER_ELECTRON, rel=0.03)


def test_real_white_reference_follows_the_line():
    folder = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
    white, dark = (open_cube(folder / f"{name}_reference_crop.hdr").read() for name in ("white", "dark"))
    noise = measure_noise(white, np.ones(white.shape[:2], bool), dark)
    mean = white.mean(axis=(0, 1)) - dark.mean(axis=(0, 1))
    seen = np.square(np.diff(white.astype(float), 2, axis=0)).mean(axis=(0, 1)) / 6.0
    assert mean.max() > 20.0 * mean.min()
    assert np.median(np.abs(seen / noise.variance(mean) - 1.0)) < 0.1


def test_variance_of_a_reading():
    noise = NoiseModel(np.array([3.0, 4.0]), 0.5, True, True)
    np.testing.assert_allclose(noise.variance(np.array([[10.0, 20.0], [-5.0, 0.0]])), [[14.0, 26.0], [9.0, 16.0]])
