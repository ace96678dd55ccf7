"""Light and materials against a closed form: a ball in even light with a lamp, which shades nothing but itself."""

import numpy as np
import pytest
import scipy.sparse

from hsi_sc_nerf.light.directions import even_directions
from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.transfer import Transfer
from hsi_sc_nerf.light.views import TurningElements, Views

DIRECTIONS = even_directions(2048)
TO_LAMP = np.array([-0.5, 0.55, 0.67]) / np.linalg.norm([-0.5, 0.55, 0.67])
FACING = np.array([0.0, 0.0, 1.0])
FRAMES, RADIUS_M, ELEVATION = 12, 0.04, 0.4


def turning_ball(count: int = 300, places_m: np.ndarray | float = 0.0) -> TurningElements:
    """Elements of a ball that sees no other, or of parts of such balls at some places, before a turning camera."""
    normals = even_directions(count)
    cosines = np.maximum(normals @ DIRECTIONS.T, 0.0)
    transfer = Transfer(
        (cosines / cosines.sum(axis=1, keepdims=True)).astype(np.float32), scipy.sparse.csr_array((count, count))
    )
    rotations = []
    for azimuth in 2.0 * np.pi * np.arange(FRAMES) / FRAMES:
        back = np.array([np.cos(ELEVATION) * np.cos(azimuth), np.cos(ELEVATION) * np.sin(azimuth), np.sin(ELEVATION)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotations.append(np.stack([right, np.cross(back, right), back], axis=1))
    return TurningElements(RADIUS_M * normals + places_m, normals, transfer, DIRECTIONS, np.array(rotations))


def measured(ball, lamp, seed=0, noise=0.005, lamp_colour=(1.0, 1.0), distance_m=None):
    """What views show, the true irradiance and the true materials; all relative to a white that faces the camera."""
    rng = np.random.default_rng(seed)
    normals = ball.normals
    material = rng.uniform(0.1, 0.8, (len(normals), 2))
    element, frame, irradiance = [], [], []
    for index, rotation in enumerate(ball.rotations):
        in_camera = normals @ rotation
        seen = np.flatnonzero(in_camera[:, 2] > 0.35)
        to_lamp, fall = TO_LAMP, 1.0
        if distance_m is not None:
            to_lamp = distance_m * TO_LAMP - ball.positions[seen] @ rotation
            fall = (distance_m / np.linalg.norm(to_lamp, axis=1)) ** 2
            to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
        cosines = np.maximum((in_camera[seen] * to_lamp).sum(axis=1), 0.0) * fall
        white = 1.0 - lamp + lamp * np.array(lamp_colour) * TO_LAMP[2]
        irradiance.append((1.0 - lamp + lamp * np.array(lamp_colour) * cosines[:, None]) / white)
        element.append(seen)
        frame.append(np.full(len(seen), index))
    element, irradiance = np.concatenate(element), np.concatenate(irradiance)
    shown = material[element] * irradiance * (1.0 + noise * rng.standard_normal((len(element), 1)))
    return Views(element, np.concatenate(frame), shown, np.ones(len(element), bool)), irradiance, material


@pytest.fixture(scope="module")
def ball():
    return turning_ball()


def seen_rows(views, ball):
    return np.bincount(views.element, minlength=len(ball.positions)) >= 3


def test_even_light_stays_as_it_is(ball):
    views, _, material = measured(ball, lamp=0.0)
    found = fit_light(ball, views, FACING)
    seen = seen_rows(views, ball)
    np.testing.assert_allclose(found.material[seen] / material[seen], 1.0, atol=0.025)
    np.testing.assert_allclose(found.irradiance, 1.0, atol=0.02)


@pytest.mark.parametrize("lamp", [0.2, 0.5])
def test_a_lamp_is_told_apart_from_the_material(ball, lamp):
    views, irradiance, material = measured(ball, lamp)
    found = fit_light(ball, views, FACING)
    seen = seen_rows(views, ball)
    ratio = (found.material / material)[seen].mean(axis=1)
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.quantile(np.abs(ratio - 1.0), 0.95) < 0.04
    assert np.quantile(np.abs(irradiance - 1.0), 0.95) > 4 * 0.04 * lamp


def test_gloss_in_a_few_views_does_not_matter(ball):
    views, _, material = measured(ball, 0.3)
    shiny = np.random.default_rng(1).random(len(views.element)) < 0.08
    glossy = Views(views.element, views.frame, views.reflectance + 0.4 * shiny[:, None], views.tells_light)
    found = fit_light(ball, glossy, FACING)
    seen = seen_rows(views, ball)
    assert np.quantile(np.abs((found.material / material)[seen] - 1.0), 0.9) < 0.05
    assert found.weights[shiny].mean() < 0.1
    assert found.weights[~shiny].mean() > 0.7


def test_a_lamp_has_its_own_colour(ball):
    views, _, material = measured(ball, 0.5, lamp_colour=(0.8, 1.2))
    found = fit_light(ball, views, FACING)
    assert found.light.lamp_colour[0] < 0.95
    assert found.light.lamp_colour[1] > 1.05
    seen = seen_rows(views, ball)
    ratio = (found.material / material)[seen]
    assert np.quantile(np.abs(ratio[:, 0] / ratio[:, 1] - 1.0), 0.9) < 0.03


def test_a_near_lamp_is_found_to_be_near():
    places_m = np.random.default_rng(3).uniform(-0.06, 0.06, (300, 3))
    parts = turning_ball(places_m=places_m)
    for distance_m in (3.0, 0.5):
        views, _, material = measured(parts, 0.5, noise=0.002, distance_m=distance_m)
        found = fit_light(parts, views, FACING)
        assert found.light.nearness == pytest.approx(1.0 / distance_m, abs=0.4)
        ratio = (found.material / material)[seen_rows(views, parts)]
        assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.05
