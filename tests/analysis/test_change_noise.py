"""Noise of patches: as large as their conditions make it, and patches that changed do not count."""

import numpy as np
import pytest

from hsi_sc_nerf.analysis.change_noise import biweight_scale, correlation, noise_of_patches

COUNT = 900


def ratio_to_truth(change, conditions, true, misplaced=0.0):
    random = np.random.default_rng(9)
    off = np.full((len(change), 1), misplaced)
    return noise_of_patches(change[:, None], conditions, off, random.random((len(change), 3)))[:, 0] / true


def white(seed=0):
    return np.random.default_rng(seed).normal(size=COUNT)


def test_noise_rises_with_the_condition_that_makes_it_and_not_with_another():
    random = np.random.default_rng(1)
    incidence, views = random.permutation(COUNT) / COUNT, random.random(COUNT)
    true = np.where(incidence > 0.9, 6.0, 1.0) * np.exp(np.maximum(incidence - 0.5, 0.0))
    change = true * white()
    change[:60] += 50.0  # what changed is of all conditions
    ratio = ratio_to_truth(change, np.stack([incidence, views], axis=1), true)
    easy, hard = incidence < 0.5, incidence > 0.95
    assert np.median(ratio[easy]) == pytest.approx(1.0, abs=0.15)
    assert np.median(ratio[hard]) == pytest.approx(1.0, abs=0.35)
    few = np.median(ratio[easy & (views > 0.95)]) / np.median(ratio[easy & (views < 0.5)])
    assert few == pytest.approx(1.0, abs=0.2)


def test_what_changed_where_it_is_easy_to_see_does_not_make_noise():
    easy = np.arange(COUNT) / COUNT
    change = white()
    change[:120] += 40.0
    ratio = ratio_to_truth(change, easy[:, None], 1.0)
    assert ratio == pytest.approx(1.0, abs=0.2)


def test_noise_never_falls_with_a_condition_and_only_its_order_counts():
    random = np.random.default_rng(2)
    conditions = random.random((COUNT, 1))
    change = white() * np.where(conditions[:, 0] > 0.8, 0.2, 1.0)
    found = ratio_to_truth(change, conditions, 1.0)
    np.testing.assert_allclose(found, found[0], rtol=1e-3)
    change = white() * np.where(conditions[:, 0] > 0.8, 4.0, 1.0)
    found = ratio_to_truth(change, conditions, 1.0)
    assert (np.diff(found[np.argsort(conditions[:, 0])]) >= 0.0).all()
    np.testing.assert_allclose(ratio_to_truth(change, np.exp(9.0 * conditions), 1.0), found)


def test_without_conditions_it_is_the_biweight_scale_less_what_registration_makes():
    change = 3.0 * white()
    for nothing in (np.zeros((COUNT, 0)), np.ones((COUNT, 2))):
        np.testing.assert_allclose(ratio_to_truth(change, nothing, biweight_scale(change)), 1.0)
    assert ratio_to_truth(change, np.zeros((COUNT, 0)), 3.0, misplaced=3.0) == pytest.approx(0.71, abs=0.05)


def test_a_patch_of_unknown_change_has_the_noise_of_its_conditions():
    hard = np.arange(COUNT)[:, None] / COUNT
    change = white() * np.where(hard[:, 0] > 0.9, 5.0, 1.0)
    change[[10, -10]] = np.nan
    found = ratio_to_truth(change, hard, 1.0)
    assert found[-10] > 2.5 * found[10] > 0.0


def test_the_biweight_scale_is_the_standard_deviation_and_outliers_do_not_count():
    values = np.random.default_rng(0).normal(5.0, 2.0, 20_000)
    assert biweight_scale(values) == pytest.approx(2.0, rel=0.02)
    values[:2000] = 1000.0
    assert biweight_scale(values) == pytest.approx(2.0, rel=0.05)
    assert biweight_scale(np.ones(10)) > 0.0


def test_the_correlation_length_of_an_exponential_field_is_found():
    random = np.random.default_rng(0)
    centres_m = 0.1 * random.random((900, 3)) * [1, 1, 0]
    distance_m = np.linalg.norm(centres_m[:, None] - centres_m, axis=2)
    field = np.linalg.cholesky(np.exp(-distance_m / 0.008) + 1e-9 * np.eye(900)) @ random.normal(size=(900, 5))
    length_m, independent = correlation(field, centres_m)
    assert length_m == pytest.approx(0.008, rel=0.3)
    assert independent == pytest.approx(900**2 / np.exp(-distance_m / 0.008).sum(), rel=0.6)


@pytest.mark.parametrize("seed", range(20))
def test_few_scattered_patches_have_a_correlation_length_of_at_least_zero(seed):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(20, 3))
    centres_m = 0.05 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    length_m, independent = correlation(random.normal(size=(20, 1)), centres_m)
    assert length_m >= 0.0
    assert 1.0 <= independent <= 20.0 + 1e-9
