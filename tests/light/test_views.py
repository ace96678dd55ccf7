"""Irradiance of elements against sums over all directions and frames, one by one."""

import light_on_a_ball
import numpy as np
import pytest
import scipy.sparse
from light_on_a_ball import TO_LAMP, measured, turning_ball

from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.light.stationary_light import TERMS, StationaryLight, harmonics, lobes, relative_nearness, tangents
from hsi_sc_nerf.light.views import BOUNCES, Transfer, TurningElements

LAMPS = np.array([0.3, 0.1])
TO_LAMPS = np.stack([TO_LAMP, unit_vectors(np.array([0.5, 0.2, 0.6]))])


@pytest.fixture(scope="module")
def ball():
    """A ball whose elements also see a tenth of each other."""
    plain, rng = turning_ball(60), np.random.default_rng(0)
    factors = scipy.sparse.csr_array(0.1 * rng.dirichlet(np.ones(60), 60))
    transfer = Transfer(0.9 * plain.transfer.open_weights, factors)
    return TurningElements(
        plain.positions, plain.normals, plain.on_object, transfer, light_on_a_ball.DIRECTIONS, plain.rotations
    )


@pytest.fixture(scope="module")
def light():
    chamber = 0.5 * np.eye(TERMS)[0] + 0.05 * np.random.default_rng(1).normal(size=TERMS)
    return StationaryLight(chamber, LAMPS, TO_LAMPS, 0.8, np.array([1.0, 0.9]), np.array([0.8, 1.1]))


def direct_of_all_directions(ball, light, frame):
    rotation, weights = ball.rotations[frame], ball.transfer.open_weights.astype(float)
    to_lamps = light.to_lamps @ rotation.T
    chamber = weights @ harmonics(ball.directions @ rotation) @ light.chamber
    nearer = 1.0 + light.nearness * relative_nearness(ball.positions, ball.normals, to_lamps)
    lamps = (weights @ lobes(ball.directions, to_lamps) * nearer) @ light.lamps
    return np.outer(chamber, light.chamber_colour) + np.outer(lamps, light.lamp_colour)


@pytest.mark.parametrize("frame", [0, 5])
def test_irradiance_sums_over_all_directions(ball, light, frame):
    expected = direct_of_all_directions(ball, light, frame)
    np.testing.assert_allclose(ball.direct(light, frame), expected, atol=2e-5)


def test_reflections_of_some_frames_are_those_of_each(ball, light):
    material, frames = np.random.default_rng(2).uniform(0.2, 0.9, (60, 2)), np.array([1, 4, 7])
    found = ball.bounced(np.stack([ball.direct(light, frame) for frame in frames], axis=1), material)
    for column, frame in enumerate(frames):
        direct = direct_of_all_directions(ball, light, frame)
        arriving = np.zeros_like(direct)
        for _ in range(BOUNCES):
            arriving = ball.transfer.form_factors @ (material * (direct + arriving))
        np.testing.assert_allclose(found[:, column], arriving, atol=2e-5)
    assert np.abs(found[:, 0] - found[:, 1]).max() > 1e-3


def test_measurements_have_the_irradiance_of_their_element_and_frame(ball, light):
    views, _, _ = measured(ball, 0.4)
    chamber, lamps = ball.chamber_at(views) @ light.chamber, ball.lamps_at(views, TO_LAMPS)
    by_lamps = (lamps.irradiance + light.nearness * lamps.by_nearness) @ LAMPS
    found = np.outer(chamber, light.chamber_colour) + np.outer(by_lamps, light.lamp_colour)
    expected = np.stack([direct_of_all_directions(ball, light, frame) for frame in range(len(ball.rotations))])
    np.testing.assert_allclose(found, expected[views.frame, views.element], atol=2e-5)
    np.testing.assert_allclose(ball.by_each_lamp(views, TO_LAMPS), lamps.irradiance, atol=1e-5)
    # Turned a little along its tangents, a lamp gives what its derivatives say, but for the directions' spacing.
    step = 1e-3
    for tangent in (0, 1):
        turned = [unit_vectors(TO_LAMPS + sign * step * tangents(TO_LAMPS)[:, tangent]) for sign in (1.0, -1.0)]
        more, less = (ball.by_each_lamp(views, towards).astype(float) for towards in turned)
        np.testing.assert_allclose(lamps.by_direction[:, :, tangent], (more - less) / (2.0 * step), atol=0.06)
