"""Uncertainty where measurements share errors, against the spread over many draws."""

import numpy as np
import pytest

from hsi_sc_nerf.light.shared_errors import SharedErrors

GROUPS, EACH = 60, 40
GROUP = np.repeat(np.arange(GROUPS), EACH)
SLOPES = np.array([1.5, -0.7])


def draw(rng, shared_std):
    """Jacobian and measurements of two slopes; groups share errors beside single ones of standard deviation 1."""
    jacobian = np.repeat(rng.standard_normal((GROUPS, 2)), EACH, axis=0) + 0.5 * rng.standard_normal((len(GROUP), 2))
    errors = rng.standard_normal(len(GROUP)) + shared_std * rng.standard_normal(GROUPS)[GROUP]
    return jacobian, jacobian @ SLOPES + errors


@pytest.mark.parametrize("shared_std", [1.0, 3.0])
def test_the_stated_uncertainty_is_the_spread_over_draws(shared_std):
    rng = np.random.default_rng(0)
    sigmas = []
    for _ in range(100):
        jacobian, measured = draw(rng, shared_std)
        plain = np.linalg.lstsq(jacobian, measured)[0]
        rest = measured - jacobian @ plain
        information, step = SharedErrors(GROUP).information(rest, jacobian, np.ones(len(rest)))
        found = plain + np.linalg.solve(information, step)
        sigmas.append((found - SLOPES) / np.sqrt(np.diag(np.linalg.inv(information))))
    assert 0.58 < (np.abs(sigmas) < 1.0).mean() < 0.82


def test_one_group_of_large_errors_calls_for_nothing():
    rng = np.random.default_rng(1)
    column, noise = np.abs(rng.standard_normal((len(GROUP), 1))), rng.standard_normal(len(GROUP))
    errors = [noise + 30.0 * (GROUP == 7), noise + 0.5, noise - 0.5]
    alike = np.ones(len(GROUP))
    one, every, opposite = (SharedErrors(GROUP).significance(error, column, alike)[0] for error in errors)
    assert one < 2.0
    assert every > 25.0
    assert opposite == 0.0


def test_two_ways_of_grouping_count_each_measurement_once():
    jacobian, measured = draw(np.random.default_rng(2), 0.0)
    by_other = np.random.default_rng(3).permutation(GROUP)
    found = []
    for errors in (SharedErrors(GROUP), SharedErrors(GROUP, by_other)):
        information, step = errors.information(measured, jacobian, np.ones(len(measured)))
        found.append(np.linalg.solve(information, step))
    np.testing.assert_allclose(*found)
