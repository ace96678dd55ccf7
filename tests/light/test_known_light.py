"""Light of a round body that serves another: against a closed form, and in files."""

import json

import numpy as np
import pytest
from light_on_a_ball import FACING, TO_LAMP, measured, turning_ball, upright_post

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.known_light import KnownLight, read_light
from hsi_sc_nerf.light.material_fit import materials_under
from hsi_sc_nerf.light.stationary_light import TERMS, StationaryLight, even_chamber

BANDS_NM = np.array([500.0, 700.0])
NEAR = StationaryLight(np.eye(TERMS)[0], np.array([0.5]), TO_LAMP[None], 1.0 / 0.6, np.ones(2), np.ones(2))


def known(light, centre_m=(0.0, 0.0, -0.5)):
    lamps = len(light.lamps)
    return KnownLight(light, np.eye(TERMS + 3 * lamps + (lamps > 0)), np.array(centre_m), BANDS_NM)


@pytest.fixture(scope="module")
def of_ball():
    ball = turning_ball()
    return fit_light(ball, measured(ball, 0.4)[0], FACING)


@pytest.mark.slow
def test_a_post_does_not_show_how_high_a_lamp_stands_and_takes_the_light_of_a_ball(of_ball):
    post = upright_post()
    views, irradiance, material = measured(post, 0.4, seed=5)
    seen = np.unique(views.element)

    def error(found):
        return abs(np.median((found.material / material)[seen]) - 1.0)

    alone, taken = fit_light(post, views, FACING), materials_under(of_ball.light, of_ball.covariance, post, views)
    assert error(taken) < 0.015 < 0.05 < error(alone)
    np.testing.assert_allclose(taken.irradiance, irradiance, atol=0.03)
    # How high the lamp stands decides what the white reference gets of it.
    assert alone.relative_std.min() > 0.02


def test_a_near_lamp_is_referred_to_another_point():
    moved = known(NEAR).at(np.array([0.02, 0.05, -0.45]), BANDS_NM).light
    lamp_m = np.array([0.0, 0.0, -0.5]) + 0.6 * TO_LAMP
    to_lamp = lamp_m - [0.02, 0.05, -0.45]
    distance_m = np.linalg.norm(to_lamp)
    np.testing.assert_allclose(moved.to_lamps, [to_lamp / distance_m])
    assert moved.nearness == pytest.approx(1.0 / distance_m)
    assert moved.lamps == pytest.approx(0.5 * (0.6 / distance_m) ** 2)


def test_lamps_far_away_are_the_same_everywhere():
    far = StationaryLight(NEAR.chamber, NEAR.lamps, NEAR.to_lamps, 0.0, NEAR.chamber_colour, NEAR.lamp_colour)
    moved = known(far).at(np.array([0.3, 0.0, 0.0]), BANDS_NM).light
    np.testing.assert_allclose(moved.to_lamps, far.to_lamps)
    assert (moved.nearness, moved.lamps[0]) == (0.0, 0.5)


def test_a_lamp_within_the_object_is_refused():
    with pytest.raises(InputError, match="inside the object"):
        known(NEAR).at(np.array([0.0, 0.0, -0.5]) + 0.6 * TO_LAMP, BANDS_NM)


def test_some_of_the_bands_can_be_taken_and_no_others():
    light = StationaryLight(NEAR.chamber, NEAR.lamps, NEAR.to_lamps, 0.0, np.array([0.9, 1.1]), np.array([1.2, 0.8]))
    one = known(light).at(np.zeros(3), np.array([700.0])).light
    assert (one.chamber_colour, one.lamp_colour) == (1.1, 0.8)
    with pytest.raises(InputError, match="other bands"):
        known(light).at(np.zeros(3), np.array([600.0]))


@pytest.mark.parametrize("light", [NEAR, even_chamber(2)])
def test_a_file_keeps_all_of_it(tmp_path, light):
    path = tmp_path / "cloud-material.json"
    path.write_text(json.dumps({"light": known(light).values()}))
    read = read_light(path)
    for name in ("chamber", "lamps", "to_lamps", "chamber_colour", "lamp_colour"):
        np.testing.assert_array_equal(getattr(read.light, name), getattr(light, name))
    assert read.light.nearness == pytest.approx(light.nearness)
    for name in ("covariance", "centre_m", "wavelengths_nm"):
        np.testing.assert_array_equal(getattr(read, name), getattr(known(light), name))


@pytest.mark.parametrize(
    "damage",
    [
        {"covariance": None},  # as in files of an older version
        {"covariance": [[1.0]]},
        {"lamps": [0.5, 0.2]},
        {"centre_m": [0.0, float("nan"), 0.0]},
        {"to_lamps": "up"},
        {"to_lamps": [[0.0, 0.0, 0.0]]},
        {"lamps": [0.0]},
        {"lamps_distance_m": 0.0},
        {"wavelengths_nm": []},
        {"wavelengths_nm": [], "chamber_colour": [], "lamp_colour": []},
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, damage):
    path = tmp_path / "cloud-material.json"
    values = {name: value for name, value in (known(NEAR).values() | damage).items() if value is not None}
    path.write_text(json.dumps({"light": values}))
    with pytest.raises(InputError, match=r"cloud-material\.json: holds no light.* of this version"):
        read_light(path)
