import numpy as np
import pytest

from hsi_sc_nerf.models.band_weights import inverse_variance_weights


def test_weights_are_those_of_least_squares():
    sigma = np.array([0.0, 0.01, 0.03])
    weights = inverse_variance_weights(sigma, model_error=0.01)
    np.testing.assert_allclose(weights / weights[0], [1.0, 0.5, 0.1])
    assert weights.mean() == pytest.approx(1.0)


def test_the_weighted_mean_of_noisy_bands_is_the_best_one():
    """Of all weighted means of independent readings, the inverse variances' scatters least."""
    rng = np.random.default_rng(0)
    sigma = np.array([0.01, 0.02, 0.05, 0.2])
    readings = 0.4 + rng.normal(size=(20_000, 4)) * sigma
    best = inverse_variance_weights(sigma, model_error=1e-9)
    scatter = np.std(readings @ best / best.sum())
    assert scatter == pytest.approx((1 / sigma**2).sum() ** -0.5, rel=0.03)
    assert scatter < 0.25 * np.std(readings.mean(axis=1))


def test_bands_without_a_measurement_weigh_nothing():
    weights = inverse_variance_weights(np.array([0.01, np.nan, np.inf, 0.01]))
    np.testing.assert_allclose(weights, [2.0, 0.0, 0.0, 2.0])


@pytest.mark.parametrize(("sigma", "error"), [([np.nan], 0.01), ([0.1], 0.0)])
def test_what_gives_no_weights_is_refused(sigma, error):
    with pytest.raises(ValueError, match=r"standard deviation|greater than 0"):
        inverse_variance_weights(np.array(sigma), error)
