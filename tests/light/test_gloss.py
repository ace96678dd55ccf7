"""What a glossy skin mirrors, from highlights of known size and on a ball of known material."""

from dataclasses import replace

import numpy as np
import pytest
from light_on_a_ball import FACING, measured, turning_ball

from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.gloss import REFLECTANCE_ERROR, find_gloss, mirrored_chamber
from hsi_sc_nerf.light.stationary_light import even_chamber

VIEW = np.array([0.0, 0.0, 1.0])
WIDTH = 0.12


def lamp_light(to_lamp, strength=0.4):
    return replace(even_chamber(2), lamps=np.array([strength]), to_lamps=unit_vectors(np.array([to_lamp])))


def highlight(normals, light, reflectance):
    """A Gaussian in x and y of the normal, whose integral over mirrored directions is that of the mirrored lamp."""
    middle = unit_vectors(light.to_lamps[0] + VIEW)
    square = ((normals - middle)[:, :2] ** 2).sum(axis=1)
    return reflectance * light.lamps[0] / (8.0 * WIDTH**2) * np.exp(-0.5 * square / WIDTH**2)


def normals_of(count, seed=0):
    normals = unit_vectors(np.random.default_rng(seed).normal(size=(count, 3)))
    normals[:, 2] = np.abs(normals[:, 2])
    return normals[normals[:, 2] > 0.35]


def found_in(normals, residuals, light, views=10):
    """The gloss of elements that were measured in some views each, in even light."""
    return find_gloss(np.arange(len(normals)) // views, normals, residuals, np.ones(len(normals)), light)


@pytest.mark.parametrize("to_lamp", [(0.0, 0.6, 0.8), (-0.3, 0.5, 0.8)])
@pytest.mark.parametrize("reflectance", [0.01, 0.045])
def test_highlights_tell_the_mirrored_fraction(to_lamp, reflectance):
    normals, light = normals_of(20_000), lamp_light(to_lamp)
    noise = np.random.default_rng(1).normal(0.0, 0.01, len(normals))
    found = found_in(normals, highlight(normals, light, reflectance) + noise, light)
    assert found.reflectance == pytest.approx(reflectance, rel=0.1, abs=0.002)
    assert abs(found.reflectance - reflectance) < found.std
    noise = np.sqrt(found.std**2 - (REFLECTANCE_ERROR * found.reflectance) ** 2)
    assert noise < 0.2 * reflectance
    error = found.highlight(normals) - highlight(normals, light, reflectance)
    assert np.sqrt((error**2).mean()) < 0.006


def test_materials_that_took_the_highlights_in_do_not_hide_them():
    middles, light, rng = normals_of(20_000), lamp_light((0.0, 0.6, 0.8)), np.random.default_rng(2)
    # Each element is seen in five views, and its material is their mean.
    normals = unit_vectors((middles[:, None] + rng.normal(0.0, 0.1, (len(middles), 5, 3))).reshape(-1, 3))
    shown = highlight(normals, light, 0.045).reshape(-1, 5)
    residuals = (shown - shown.mean(axis=1, keepdims=True)).ravel() + rng.normal(0.0, 0.01, len(normals))
    left = residuals[highlight(normals, light, 0.045) > 0.05]
    assert np.median(left) < 0.5 * np.median(shown[shown > 0.05])
    assert found_in(normals, residuals, light, views=5).reflectance == pytest.approx(0.045, rel=0.1)


def test_noise_or_light_without_lamps_is_no_gloss():
    normals, light = normals_of(20_000), lamp_light((0.0, 0.6, 0.8))
    noise = np.random.default_rng(1).normal(0.0, 0.02, len(normals))
    assert found_in(normals, noise, light) is None
    assert found_in(normals, noise + highlight(normals, light, 0.05), even_chamber(2)) is None
    assert found_in(normals[:3], noise[:3], light) is None
    assert found_in(normals, np.zeros(len(normals)), light) is None


def test_a_glossy_ball_gets_the_material_below_its_gloss():
    ball = turning_ball(1500)
    views, _, material = measured(ball, 0.5)
    matte = fit_light(ball, views, FACING)
    assert matte.gloss is None
    light, normals = matte.light, ball.normals_in_camera(views)
    added = highlight(normals, light, 0.06) + 0.06 * mirrored_chamber(light)
    glossy = replace(views, reflectance=views.reflectance + added[:, None])
    found = fit_light(ball, glossy, FACING)
    assert found.gloss.reflectance == pytest.approx(0.06, rel=0.2)
    seen = np.bincount(views.element, minlength=len(material)) >= 3
    with_gloss, without = (np.median((fit.material / material)[seen]) - 1.0 for fit in (found, matte))
    assert abs(with_gloss - without) < 0.02
    # Left in, the chamber's mirrored half of the light alone would add this much.
    assert 0.06 * 0.5 / np.median(material) > 0.05


def test_the_lamps_keep_their_colour_where_a_glossy_ball_is_dark():
    ball = turning_ball(1500)
    views, _, _ = measured(ball, 0.5)
    light = fit_light(ball, views, FACING).light
    # What is mirrored is brighter by 30 % than the chamber is on average.
    added = highlight(ball.normals_in_camera(views), light, 0.06) + 1.3 * 0.06 * mirrored_chamber(light)
    glossy = replace(views, reflectance=views.reflectance * np.array([0.15, 1.0]) + added[:, None])
    found = fit_light(ball, glossy, FACING)
    assert found.gloss is not None
    np.testing.assert_allclose(found.light.lamp_colour, 1.0, atol=0.05)
