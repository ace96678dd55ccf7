"""Defects against the truth of simulated sessions, and against what looks like one and is none."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from hsi_sc_nerf.calibration.detector import (
    Readings,
    dark_columns,
    elements_without_response,
    find_defects,
    pooled_darks,
    saturation_counts,
    unlit_bands,
)
from hsi_sc_nerf.calibration.white_reference import bright_region
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override, read_effects

NOISE = {"photon_noise": {}, "read_noise": {}}


@functools.cache
def base_scene(name, size_px, bands):
    return override(load_scene(name), size_px=size_px, bands=bands, frames=3)


def session(name="pear", size_px=64, bands=204, seed=0, bit_depth=12, **effects):
    scene = base_scene(name, size_px, bands)
    sensor = dataclasses.replace(scene.sensor, bit_depth=bit_depth, dark_level=min(120, 2**bit_depth // 20))
    named = read_effects([{name: strengths} for name, strengths in effects.items()], "test")
    return Simulation(dataclasses.replace(scene, effects=named, seed=seed, sensor=sensor))


def readings(simulation, lines_of_frames=8):
    """Lines across the tarp, and a few of each frame."""
    white = simulation.white()
    on_tarp = bright_region(white.counts.mean(axis=-1)).any(axis=1)
    frames = [simulation.frame(number) for number in range(3)]
    step = len(white.counts) // lines_of_frames
    return (
        Readings(white.counts[on_tarp], white.dark),
        [Readings(frame.counts[step // 2 :: step], frame.dark) for frame in frames],
    )


def truth_of(simulation):
    maps = simulation.detector_maps["bad_pixels"]
    return maps["dead"] | maps["hot"]


HARD = {
    "default": {"bad_pixels": {}},
    "dark pattern, smile, falloff, lamp": {
        "bad_pixels": {"dead_fraction": 0.002, "hot_fraction": 0.002},
        "dark_pattern": {"spread": 30.0},
        "spectral_smile": {"shift_nm": 6.0},
        "illumination_falloff": {},
        "lamp": {},
    },
    "rotated, saturated, textured": {
        "bad_pixels": {},
        "image_rotation": {},
        "saturation": {},
        "textured_background": {},
    },
    "one in fifty": {
        "bad_pixels": {"dead_fraction": 0.01, "hot_fraction": 0.01, "dead_bands": 3},
        "dark_pattern": {},
    },
    "noisy": {"bad_pixels": {"dead_bands": 1}, "read_noise": {"electrons": 120.0}},
}


@pytest.mark.slow
@pytest.mark.parametrize("effects", HARD.values(), ids=HARD)
def test_all_bad_elements_are_found_and_no_others(effects):
    """With photon and read noise; together there are 65 000 elements, of which about 600 are bad."""
    simulation = session(**{**NOISE, **effects})
    defects = find_defects(*readings(simulation))
    truth = truth_of(simulation)
    dead_bands = simulation.detector_maps["bad_pixels"]["dead"].all(axis=0)
    np.testing.assert_array_equal(defects.bad_bands, dead_bands)
    np.testing.assert_array_equal(defects.dead, truth & ~dead_bands)
    assert (defects.saturation_counts == 4095.0) == ("saturation" in effects)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [{}, NOISE], ids=["quiet", "noisy"])
@pytest.mark.parametrize(
    ("effects", "bands", "bit_depth"),
    [
        ({}, 3, 8),
        ({}, 60, 12),
        ({"illumination_falloff": {}}, 60, 8),
        ({"lamp": {}, "gloss": {}}, 12, 12),
        ({"tarp_exposure": {"exposure_factor": 0.4}}, 3, 16),
    ],
)
def test_nothing_is_found_where_nothing_is(effects, bands, bit_depth, noise):
    """Not even where an even background gives the largest count to most pixels of a band."""
    simulation = session("sphere", size_px=48, bands=bands, bit_depth=bit_depth, **effects, **noise)
    defects = find_defects(*readings(simulation))
    assert defects.saturation_counts is None
    assert not defects.dead.any()
    assert not defects.bad_bands.any()


@pytest.mark.slow
@pytest.mark.parametrize("noise", [{}, NOISE], ids=["quiet", "noisy"])
@pytest.mark.parametrize("bit_depth", [8, 10, 16])
def test_saturation_is_where_the_digitiser_stops(bit_depth, noise):
    simulation = session(
        size_px=40, bands=24, bit_depth=bit_depth, saturation={}, bad_pixels={"hot_fraction": 0.01}, **noise
    )
    white, frames = readings(simulation)
    assert find_defects(white, frames).saturation_counts == 2**bit_depth - 1
    if bit_depth == 10:
        # As some cameras write 10 bits: in the upper bits of 16.
        shifted = [Readings(r.counts << 6, r.dark << 6) for r in (white, *frames)]
        assert find_defects(shifted[0], shifted[1:]).saturation_counts == 1023 << 6


@pytest.mark.slow
def test_readings_that_pile_up_at_an_unusual_count():
    white, frames = readings(session(size_px=40, bands=40, saturation={}, **NOISE))
    cubes = [np.minimum(r.counts, 3800) for r in (white, *frames)]
    live = np.ones((40, 40), bool)
    assert saturation_counts(cubes, live) == 3800.0
    assert saturation_counts([cube.astype(np.float32) / 3.0 for cube in cubes], live) == pytest.approx(3800.0 / 3.0)
    white, frames = readings(session(size_px=40, bands=40, **NOISE))
    assert saturation_counts([r.counts for r in (white, *frames)], live) is None


def test_the_flat_top_of_a_smooth_highlight_is_no_saturation():
    y, x = np.meshgrid(np.arange(60.0) - 30.0, np.arange(200.0) - 100.0, indexing="ij")
    dome = np.rint(3000.0 - 0.02 * (x**2 + y**2))[..., None].astype(np.uint16)
    live = np.ones((200, 1), bool)
    assert np.count_nonzero(dome == dome.max()) > 60
    assert saturation_counts([dome], live) is None
    assert saturation_counts([np.minimum(dome, 2990)], live) == 2990.0


def test_saturation_of_next_to_nothing():
    live = np.ones((30, 20), bool)
    counts = np.random.default_rng(0).normal(2000.0, 20.0, (10, 30, 20)).round().astype(np.uint16)
    assert saturation_counts([counts], live) is None
    counts[5, 5, 5:8] = 4095
    assert saturation_counts([counts], live) == 4095.0
    # One pixel, the brightest, is no saturation, whatever its count.
    counts[5, 5, 6:8] = 4000
    assert saturation_counts([counts], live) is None
    assert saturation_counts([counts], ~live) is None
    counts[5, 5, 5:8] = 4080
    assert saturation_counts([counts], live) is None


def light_of_a_tarp(samples=50, bands=20):
    rng = np.random.default_rng(0)
    spectrum = 1000.0 * np.sin(np.linspace(0.3, 2.8, bands))
    across = np.where(np.abs(np.arange(samples) - 25) < 20, 1.0, 0.2)
    return np.outer(across, spectrum) * rng.normal(1.0, 0.003, (samples, bands))


def test_warm_elements_live_and_slow_ones_do_not():
    true = light_of_a_tarp()
    light = true.copy()
    light[20, 5] *= 1.2
    light[21, 6] *= 0.7
    light[22, 7] *= 0.3
    light[23, 8] *= 2.6
    light[3, 9] = 0.0
    dead = elements_without_response([(light, 1.0)])
    np.testing.assert_array_equal(np.argwhere(dead), [[3, 9], [22, 7], [23, 8]])
    # A warm element has more dark counts, and the same response.
    counts, dark = np.full((4, 50, 20), 100.0) + true, np.full((2, 50, 20), 100.0)
    counts[:, 30, 4] += 1500.0
    dark[:, 30, 4] += 1500.0
    assert not find_defects(Readings(counts, dark)).dead.any()
    # One that has no room left for light is dead.
    counts[:, 30, 4] = dark[:, 30, 4] = 9999.0
    np.testing.assert_array_equal(np.argwhere(find_defects(Readings(counts, dark)).dead), [[30, 4]])


def test_an_element_that_follows_in_one_image_lives():
    light, other = light_of_a_tarp(), light_of_a_tarp()
    light[20, 5] = light[21, 6] = other[21, 6] = 0.0
    np.testing.assert_array_equal(np.argwhere(elements_without_response([(light, 1.0), (other, 1.0)])), [[21, 6]])


def test_clusters_and_the_ends_of_the_line():
    light = light_of_a_tarp()
    expected = np.zeros(light.shape, bool)
    for samples, band in (((0, 1, 2), 3), ((47, 48, 49), 4), ((24, 25, 26, 27), 10)):
        light[list(samples), band] = 0.0
        expected[list(samples), band] = True
    light[35] = 0.0
    expected[35] = True
    np.testing.assert_array_equal(elements_without_response([(light, 1.0)]), expected)


def test_bad_bands_are_listed_unlit_or_mostly_dead():
    light = light_of_a_tarp()
    light[:, 4] = 0.0
    light[:, 5] *= 5e-4
    light[::2, 6] = light[1:12, 6] = 0.0
    listed = np.arange(20) != 17
    defects = find_defects(Readings(light[None] + 100.0, np.full((1, 50, 20), 100.0)), good_bands=listed)
    np.testing.assert_array_equal(np.flatnonzero(defects.bad_bands), [4, 5, 6, 17])
    assert not defects.dead.any()
    np.testing.assert_array_equal(unlit_bands(np.array([[0.9, 0.0, np.nan, 1000.0]])), [1, 1, 1, 0])


def test_session_without_dark_cubes():
    simulation = session(size_px=40, bands=40, bad_pixels={"dead_fraction": 0.01, "hot_fraction": 0.0}, **NOISE)
    white, frames = readings(simulation)
    defects = find_defects(Readings(white.counts), [Readings(frame.counts) for frame in frames])
    # Where the light is weak, the dark counts hide it.
    assert not (defects.dead & ~truth_of(simulation)).any()
    assert (defects.dead & truth_of(simulation)).sum() > 0.7 * truth_of(simulation).sum()


def darks_of_frames(pattern_change: float, readings: int = 16) -> tuple[list[np.ndarray], np.ndarray]:
    """Darks of 12 frames, whose level drifts, with the noise of few lines; and the true ones."""
    rng = np.random.default_rng(2)
    level = np.linspace(90.0, 110.0, 12)[:, None, None]
    true = level + rng.normal(0.0, 5.0, (1, 40, 6)) + pattern_change * rng.standard_normal((12, 40, 6))
    return list(true + rng.normal(0.0, 4.0 / np.sqrt(readings), true.shape)), true


def test_pooled_darks_have_less_noise_and_each_frames_level():
    darks, true = darks_of_frames(0.0)
    pooled = np.stack(pooled_darks(darks, 16, np.full(6, 4.0)))
    assert np.std(pooled - true) < 0.4 * np.std(np.stack(darks) - true)
    np.testing.assert_allclose((pooled - true).mean(axis=1), 0.0, atol=0.6)


@pytest.mark.parametrize(("change_of_bands", "remaining"), [(0.0, 0.3), (1.0, 1.0)])
def test_an_offset_is_pooled_over_the_bands_and_levels_of_bands_are_kept(change_of_bands, remaining):
    rng, shape = np.random.default_rng(4), (12, 40, 60)
    true = np.linspace(90.0, 92.0, 12)[:, None, None] + rng.normal(0.0, 5.0, (1, *shape[1:]))
    true = true + change_of_bands * rng.standard_normal((12, 1, 60))
    darks = list(true + rng.normal(0.0, 4.0 / np.sqrt(16), shape))
    pooled = np.stack(pooled_darks(darks, 16, np.full(60, 4.0)))
    of_one_level = 4.0 / np.sqrt(16 * 40)
    assert np.std((pooled - true).mean(axis=1)) == pytest.approx(remaining * of_one_level, rel=0.15)


def test_darks_whose_pattern_changes_are_kept():
    darks, _ = darks_of_frames(2.0)
    np.testing.assert_array_equal(pooled_darks(darks, 16, np.full(6, 4.0)), darks)
    single = [np.zeros((1, 6)), np.ones((1, 6))]
    np.testing.assert_array_equal(pooled_darks(single, 16, np.full(6, 4.0)), single)


def test_dark_counts_without_data_are_left_out():
    """One missing reading of an element does not take the element, and no band."""
    dark = np.full((4, 3, 2), 100.0, np.float32)
    dark[1, 2, 0] = np.nan
    np.testing.assert_array_equal(dark_columns(dark, 3, 2), np.full((3, 2), 100.0))


def test_a_panel_that_fills_less_than_half_of_its_lines_lights_all_bands():
    counts = np.zeros((8, 48, 6), np.uint16)
    counts[:, 8:20] = 2000
    assert not find_defects(Readings(counts)).bad_bands.any()
