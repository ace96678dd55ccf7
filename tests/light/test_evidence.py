"""What tells of shading, where the light does not change with the turn and only its profile is left."""

from dataclasses import replace

import numpy as np
import pytest
from light_on_a_ball import FACING, measured, turning_ball

from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.of_run import shading_evidence


def shaded_ball():
    """A ball whose lower elements see less of the sky, by up to 40 %."""
    ball = turning_ball()
    visible = (0.8 + 0.2 * ball.normals[:, 2]).astype(np.float32)
    weights = ball.transfer.open_weights * visible[:, None]
    return replace(ball, transfer=replace(ball.transfer, open_weights=weights)), visible


@pytest.mark.parametrize("shade", [True, False])
def test_the_profile_tells_of_light_that_does_not_change_with_the_turn(shade):
    ball, visible = shaded_ball()
    views, _, _ = measured(ball, lamp=0.0)
    # Three materials of like brightness all over the ball.
    kinds = np.array([[0.2, 0.5], [0.3, 0.3], [0.5, 0.2]])[np.arange(len(visible)) % 3]
    noise = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((len(views.element), 1))
    shown = kinds[views.element] * noise * (visible[views.element, None] if shade else 1.0)
    views = replace(views, reflectance=shown)
    found = shading_evidence(ball, views, fit_light(ball, views, FACING))
    assert found.profile == pytest.approx(1.0 if shade else 0.0, abs=0.1)
    assert found.shaded == shade


def test_a_lamp_shows_in_the_turn():
    ball = turning_ball()
    views, _, _ = measured(ball, lamp=0.3)
    found = shading_evidence(ball, views, fit_light(ball, views, FACING))
    assert found.turning == pytest.approx(1.0, abs=0.1)
    assert found.shaded
