"""The robust standard deviation and weights: those of normal values, whatever almost half of the values are."""

import numpy as np
import pytest

from hsi_sc_nerf.robust_scatter import TUKEY, robust_std, tukey_weights


def test_normal_values_and_wild_ones():
    values = np.random.default_rng(0).normal(0.0, 3.0, (20_000, 2))
    assert robust_std(values) == pytest.approx(3.0, rel=0.02)
    values[:2000, 0], values[2000:3000, 0] = 1e9, np.nan
    found = robust_std(values, axis=0)
    # A tenth of wild values moves the median from the 50th to the 56th percentile of the others.
    assert found[0] == pytest.approx(3.0, rel=0.2)
    assert found[1] == pytest.approx(3.0, rel=0.02)


def test_values_without_scatter_have_the_least():
    assert robust_std(np.zeros(5), least=0.01) == 0.01
    assert robust_std(np.zeros(5)) == 0.0


def test_weights_fall_from_one_to_zero_at_the_cut_off():
    std = np.array([1.0, 0.5])
    deviation = np.array([[0.0, 0.0], [-TUKEY / 2.0, TUKEY / 4.0], [1.001 * TUKEY, -TUKEY], [np.nan, 1e9]])
    found = tukey_weights(deviation, std)
    np.testing.assert_allclose(found, [[1.0, 1.0], [0.5625, 0.5625], [0.0, 0.0], [0.0, 0.0]])
