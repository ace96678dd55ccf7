"""Light and materials against a closed form: a ball in even light with a lamp."""

from dataclasses import replace

import light_on_a_ball
import numpy as np
import pytest
import trimesh
from light_on_a_ball import FACING, TO_LAMP, measured, turning_ball
from scipy.optimize import lsq_linear

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light import fit as fit_module
from hsi_sc_nerf.light.elements import spread_elements, support_mesh
from hsi_sc_nerf.light.fit import fit_light, newton_step
from hsi_sc_nerf.light.material import turning_elements
from hsi_sc_nerf.light.stationary_light import even_chamber
from hsi_sc_nerf.light.views import ElementViews


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
    glossy = replace(views, reflectance=views.reflectance + 0.4 * shiny[:, None])
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


@pytest.mark.parametrize("to_lamp", [TO_LAMP, np.array([0.3, -0.7, 0.65])])
def test_no_lamp_is_searched_for_below_the_plane_of_the_disc(ball, monkeypatch, to_lamp):
    monkeypatch.setattr(light_on_a_ball, "TO_LAMP", to_lamp)
    views, *_ = measured(ball, 0.5)
    fitting = fit_module._LightFitting(ball, views, FACING, np.zeros(3))
    fitting.converge()
    assert fitting.add_lamp()
    up = ball.rotations[0, 2]
    assert (to_lamp @ up > 0.0) == (to_lamp is TO_LAMP)
    assert fitting.light.to_lamps[0] @ up > 0.0


@pytest.mark.slow
def test_a_near_lamp_is_found_to_be_near():
    centres_m = np.random.default_rng(3).uniform(-0.06, 0.06, (300, 3))
    parts = turning_ball(centres_m=centres_m)
    for distance_m in (3.0, 0.5):
        views, _, material = measured(parts, 0.5, noise=0.002, distance_m=distance_m)
        found = fit_light(parts, views, FACING)
        assert found.light.nearness == pytest.approx(1.0 / distance_m, abs=0.4)
        ratio = (found.material / material)[seen_rows(views, parts)]
        assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.05


@pytest.mark.parametrize("seed", range(6))
def test_a_step_within_bounds_is_the_least_there(seed):
    rng = np.random.default_rng(seed)
    jacobian, residual = rng.normal(size=(9, 4)), rng.normal(size=9)
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    unbounded = np.linalg.solve(hessian, gradient)
    for fraction in (0.5, 2.0):
        bound, free = fraction * abs(unbounded[-1]), np.full(3, np.inf)
        slow = lsq_linear(jacobian, residual, (np.append(-free, -bound), np.append(free, bound)), tol=1e-14)
        step = newton_step(hessian, gradient, (-bound, bound))
        np.testing.assert_allclose(step, slow.x, atol=1e-6)
        assert np.isclose(step[:-1], unbounded[:-1]).all() == (fraction > 1.0)


@pytest.mark.slow
def test_a_white_below_the_object_got_less_of_a_near_lamp():
    parts = turning_ball(centres_m=np.random.default_rng(3).uniform(-0.06, 0.06, (300, 3)))
    views, _, material = measured(parts, 0.5, noise=0.002, distance_m=0.6)
    place_m = np.array([0.0, -0.07, 0.0])
    to_lamp = 0.6 * TO_LAMP - place_m
    on_white = 0.5 + 0.5 * (FACING @ to_lamp) * 0.6**2 / np.linalg.norm(to_lamp) ** 3
    views = replace(views, reflectance=views.reflectance * (0.5 + 0.5 * TO_LAMP[2]) / on_white)
    seen = seen_rows(views, parts)
    errors = [
        np.median((fit_light(parts, views, FACING, place).material / material)[seen]) - 1.0
        for place in (place_m, None)
    ]
    assert abs(errors[0]) < 0.02 < 0.05 < errors[1]


@pytest.fixture(scope="module")
def post_on_lid():
    """A post before a lamp, and what views show of it and of the lid that it stands on."""
    post = trimesh.creation.cylinder(0.02, 0.1, sections=48).subdivide_to_size(0.004)
    mesh = Mesh(np.array(post.vertices), np.array(post.faces)).moved(np.array([0.0, 0.0, 0.09]))
    elements = spread_elements(mesh, support_mesh((0.1, 0.04), 0.06), 300, 300, smoothing_m=0.003)
    parts = turning_elements(elements, turning_ball(2).rotations, 0.003, 1e-4)
    light = replace(even_chamber(2), lamps=np.array([0.4]), to_lamps=TO_LAMP[None])
    light = replace(light, chamber=light.chamber * (1.0 - 0.4 * TO_LAMP[2]))
    rng = np.random.default_rng(0)
    material = rng.uniform(0.2, 0.8, (len(elements.positions), 2))
    sides = elements.on_object & (np.abs(elements.normals[:, 2]) < 0.1)
    rows = []
    for frame, rotation in enumerate(parts.rotations):
        direct = parts.direct(light, frame)[:, None]
        lit = (direct + parts.bounced(direct, material))[:, 0]
        facing_camera = sides & (elements.normals @ rotation[:, 2] > 0.35)
        seen = np.flatnonzero(facing_camera | (~elements.on_object & elements.shows_light))
        shown = (material * lit)[seen] * (1.0 + 0.005 * rng.standard_normal((len(seen), 1)))
        rows.append(
            (seen, np.full(len(seen), frame), shown, sides[seen], elements.shows_light[seen], np.zeros(len(seen)))
        )
    views = ElementViews(*(np.concatenate(column) for column in zip(*rows, strict=True)))
    assert (views.shows_light & ~views.on_object).any()
    return parts, views, material


@pytest.mark.slow
def test_the_shadow_of_a_post_shows_how_high_a_lamp_stands(post_on_lid):
    """Its sides are lit alike by lamps of any height; its shadow on the lid is not."""
    parts, views, material = post_on_lid

    def errors(used):
        found = fit_light(parts, used, FACING)
        seen = np.unique(used.element[used.on_object])
        off_deg = np.rad2deg(np.arccos(np.clip(found.light.to_lamps[0] @ TO_LAMP, -1.0, 1.0)))
        return off_deg, abs(np.median((found.material / material)[seen]) - 1.0)

    with_shadow, without = errors(views), errors(replace(views, shows_light=views.on_object))
    assert with_shadow[0] < 0.5 < 1.0 < without[0]
    assert with_shadow[1] < 0.002 < 0.005 < without[1]


@pytest.mark.slow
@pytest.mark.parametrize(("shadow", "least_deg", "most_deg"), [(True, 0.0, 10.0), (False, 15.0, 180.0)])
def test_a_lamp_is_searched_for_where_its_shadow_lies(post_on_lid, monkeypatch, shadow, least_deg, most_deg):
    """Candidates are 14 degrees apart; the fit may not find back from a distant one."""
    parts, views, _ = post_on_lid
    monkeypatch.setattr(fit_module, "STEPS", 1)
    monkeypatch.setattr(fit_module, "LARGEST_TURN_RAD", 0.0)
    used = views if shadow else replace(views, shows_light=views.on_object)
    to_lamp = fit_light(parts, used, FACING).light.to_lamps[0]
    assert least_deg < np.rad2deg(np.arccos(to_lamp @ TO_LAMP)) < most_deg


@pytest.mark.parametrize("lamp", [0.985, 1.0])
def test_a_dark_room_keeps_its_colours(ball, lamp):
    views, irradiance, material = measured(ball, lamp, lamp_colour=(0.9, 1.1))
    found = fit_light(ball, views, FACING)
    best = np.zeros(len(ball.positions))
    np.maximum.at(best, views.element, irradiance.mean(axis=1))
    lit = seen_rows(views, ball) & (best > 0.3)
    assert (found.light.chamber_colour >= 0.0).all()
    assert np.quantile(np.abs((found.material / material)[lit] - 1.0), 0.95) < 0.03
