"""Effects on the image: of time, lamps, surroundings and lens: closed forms, and what they leave alone."""

import functools

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.effects import image
from hsi_sc_nerf.simulate.effects.detector import white_signal
from hsi_sc_nerf.simulate.effects.image import OpticalBlur, distort, undistort
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.materials import MATERIALS, PlantTissue, endmembers
from hsi_sc_nerf.simulate.scene import load_scene, override

SMALL = {"frames": 4, "size_px": 40, "bands": 10}


def scene(*names, name="cylinder", **values):
    return override(load_scene(name), **{**SMALL, **values}, effects=names)


@functools.cache
def plain(size_px):
    """The scene without effects, simulated once for all tests."""
    return Simulation(scene(size_px=size_px))


def signal(simulation, capture):
    """Counts above dark."""
    return capture.counts.astype(float) - simulation.scene.sensor.dark_level


def white(simulation):
    return white_signal(simulation.scene.sensor, simulation.wavelengths_nm)


# Ageing


def test_drying_takes_away_the_absorbance_of_the_lost_water():
    simulation = Simulation(scene("{drying: {water_loss: 0.4}}", name="apple", bands=204))
    nm = simulation.wavelengths_nm
    frame = simulation.frame(2)
    log_ratio = np.log10(frame.light.spectra / simulation.endmembers)
    elapsed = simulation.plan.elapsed[2]
    # The bands as gaussians, written out.
    shape = sum(
        height * np.exp(-((nm - centre) ** 2) / (2.0 * width**2))
        for height, centre, width in ((1.0, 970.0, 24.0), (0.3, 1010.0, 40.0), (0.06, 835.0, 18.0))
    )
    for i, name in enumerate(simulation.materials):
        of_object = name in simulation.object_part.materials
        water = MATERIALS[name].water if of_object else 0.0
        np.testing.assert_allclose(log_ratio[i], 0.4 * elapsed * water * shape, atol=1e-12)
    assert log_ratio[0].max() > 0.015
    # In the counts, to rounding.
    expected = frame.material_weights.astype(float) @ (frame.light.spectra * white(simulation))
    assert np.abs(signal(simulation, frame) - expected).max() <= 0.501
    # The first frame has not dried yet.
    np.testing.assert_array_equal(simulation.frame(0).light.spectra, simulation.endmembers)


def test_bone_dry_tissue_reflects_what_tissue_without_water_does():
    nm = np.linspace(397.0, 1003.0, 60)
    wet = {"wet": PlantTissue(1.0, chlorophyll=0.3, water=2.0), "flat": MATERIALS["paper"]}
    dry = {"wet": PlantTissue(1.0, chlorophyll=0.3), "flat": MATERIALS["paper"]}
    dried = image.Drying(1.0).spectra(endmembers(wet, nm, wet), list(wet.values()), nm, 1.0)
    np.testing.assert_allclose(dried, endmembers(dry, nm, dry), atol=1e-12)
    assert dried.max() <= 1.0
    # A table a sample, as for a detector's smile, is as many tables.
    samples_nm = nm + np.array([[0.0], [3.0]])
    tables = np.moveaxis(endmembers(wet, samples_nm, wet), 0, -2)
    both = image.Drying(0.5).spectra(tables, list(wet.values()), samples_nm, 0.6)
    for table, one, at_nm in zip(tables, both, samples_nm, strict=True):
        np.testing.assert_array_equal(one, image.Drying(0.5).spectra(table, list(wet.values()), at_nm, 0.6))


# Illumination


def recovered(simulation, frame):
    """The illumination: counts divided by what the pixel would give under the lamps at the start."""
    without = frame.material_weights.astype(float) @ (simulation.endmembers * white(simulation))
    return signal(simulation, frame) / without, 0.501 / without


def planck_ratio(nm, kelvin):
    """Light of a black body over that of one at 3000 K: what is left of Planck's law in any unit."""
    hc_over_k_nm = 1.438776877e7
    return np.expm1(hc_over_k_nm / (nm * 3000.0)) / np.expm1(hc_over_k_nm / (nm * kelvin))


def test_drift_is_what_is_left_after_dividing_truth_out():
    simulation = Simulation(scene("{lamp_drift: {percent: -12, temperature_change_k: -150, settling: 0.4}}"))
    nm = simulation.wavelengths_nm
    for i, elapsed in enumerate(simulation.plan.elapsed):
        done = (1.0 - np.exp(-elapsed / 0.4)) / (1.0 - np.exp(-1.0 / 0.4))
        colour = planck_ratio(nm, 3000.0 - 150.0 * done) / planck_ratio(700.0, 3000.0 - 150.0 * done)
        expected = (1.0 - 0.12 * done) * colour
        found, rounding = recovered(simulation, simulation.frame(i))
        assert (np.abs(found - expected) <= rounding + 1e-5).all()
    assert expected[0] < 0.80 < 0.92 < expected[-1]
    # The tarp was taken before.
    even = plain(SMALL["size_px"])
    np.testing.assert_array_equal(simulation.white().counts, even.white().counts)
    np.testing.assert_array_equal(simulation.frame(0).counts, even.frame(0).counts)


def test_falloff_is_what_is_left_after_dividing_truth_out():
    simulation = Simulation(scene("{illumination_falloff: {edge_loss: 0.3}}"))
    size = SMALL["size_px"]
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    # A light that falls on a plane under an angle loses cos^4 of it; the corner's angle makes the given loss.
    corner_angle = np.arccos(0.7**0.25)
    angle = np.arctan(np.hypot(y, x) / np.hypot(size / 2, size / 2) * np.tan(corner_angle))
    expected = np.cos(angle)[..., None] ** 4
    for i in (0, 3):
        frame = simulation.frame(i)
        found, rounding = recovered(simulation, frame)
        assert (np.abs(found - expected) <= rounding + 1e-5).all()
        # Tarp and object lose the same: divided by the tarp in its place, a frame is the true reflectance.
        tarp = simulation.white()
        on_tarp = tarp.light.weights[..., 0] == 1.0
        ratio = (signal(simulation, frame) / signal(simulation, tarp))[on_tarp]
        truth = (frame.material_weights.astype(float) @ simulation.endmembers)[on_tarp]
        assert (np.abs(ratio - truth) <= 0.501 * (1.0 + truth) / signal(simulation, tarp)[on_tarp] + 1e-5).all()
    factor = image.IlluminationFalloff(0.3).factor(1001, np.array([700.0]), 3000.0, 0.0)
    assert factor[500, 500, 0] == 1.0
    assert factor[0, 0, 0] == pytest.approx(0.7, abs=1e-3)


# Surroundings


def test_the_background_stands_still_and_nothing_else_changes():
    simulation, even = Simulation(scene("textured_background", size_px=64)), plain(64)
    frames, bare = ([s.frame(i) for i in range(4)] for s in (simulation, even))
    same = [simulation.materials.index(name) for name in even.materials]
    wall = np.logical_and.reduce([frame.material_weights[..., -1] == 1.0 for frame in bare])
    assert wall.mean() > 0.3
    for frame, without in zip(frames, bare, strict=True):
        np.testing.assert_array_equal(frame.material_weights.sum(axis=-1), 1.0)
        np.testing.assert_array_equal(frame.counts[wall], frames[0].counts[wall])
        np.testing.assert_array_equal(frame.coverage, without.coverage)
        full = without.material_weights[..., -1] == 0.0
        np.testing.assert_array_equal(frame.material_weights[full][:, same], without.material_weights[full])
    # All three materials are there, and the wall's own is gone.
    fractions = frames[0].material_weights[wall].mean(axis=0)
    for name in image.TexturedBackground.materials:
        assert fractions[simulation.materials.index(name)] > 0.05
    assert fractions[-1] == 0.0
    half = Simulation(scene("{textured_background: {contrast: 0.5}}", size_px=64)).frame(0)
    np.testing.assert_allclose(half.material_weights[wall][:, -1], 0.5, atol=1e-3)
    # A larger image shows the same wall.
    large = Simulation(scene("textured_background", size_px=128)).frame(0).material_weights
    pooled = large.reshape(64, 2, 64, 2, -1).mean(axis=(1, 3))
    assert np.abs(pooled - frames[0].material_weights)[wall].mean() < 0.02


# Optics


@pytest.mark.parametrize("sigma_px", [0.2, 0.6, 1.7])
def test_blur_keeps_the_light_and_spreads_it_by_sigma(sigma_px):
    blur = OpticalBlur(sigma_px)
    point = np.zeros((61, 61, 1))
    point[30, 30] = 1.0
    image = blur.image(point)[..., 0]
    assert image.sum() == pytest.approx(1.0, abs=1e-12)
    assert (image >= 0.0).all()
    offset = np.arange(61) - 30.0
    assert (image.sum(axis=0) * offset**2).sum() == pytest.approx(sigma_px**2, rel=1e-8)
    assert (image.sum(axis=1) * offset**2).sum() == pytest.approx(sigma_px**2, rel=1e-8)


def test_blur_loses_nothing_at_the_border_and_twice_is_once_wider():
    light = np.random.default_rng(0).random((12, 17, 3))
    image = OpticalBlur(2.0).image(light)
    np.testing.assert_allclose(image.sum(axis=(0, 1)), light.sum(axis=(0, 1)), rtol=1e-12)
    np.testing.assert_allclose(OpticalBlur(1.2).image(OpticalBlur(1.6).image(light)), image, atol=1e-12)
    np.testing.assert_allclose(OpticalBlur(3.0).image(np.ones((9, 9, 1))), 1.0, rtol=1e-12)


def test_distortion_comes_undone():
    coefficients = (-0.35, 0.2, 0.004, -0.006)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 2))
    np.testing.assert_allclose(undistort(distort(points, coefficients), coefficients), points, atol=1e-9)


def test_a_lens_that_folds_the_image_is_refused():
    with pytest.raises(InputError, match=r"lens_distortion.*fold the image"):
        Simulation(scene("{lens_distortion: {k1: -2, k2: -2}}")).frame(0)
