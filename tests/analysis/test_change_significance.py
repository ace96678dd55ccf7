"""Tests of patches: against closed forms, and false alarms under errors that are smooth over centimetres."""

import numpy as np
import pytest
from scipy import stats

from hsi_sc_nerf.analysis.change_significance import (
    FALSE_DISCOVERIES,
    hotelling_p,
    significance,
    surface_patches,
)
from hsi_sc_nerf.simulate.materials import smooth_noise


def ball_patches(count=700, radius_m=0.035):
    step = np.arange(count) + 0.5
    z, azimuth = 1.0 - 2.0 * step / count, np.pi * (1.0 + 5.0**0.5) * step
    flat = np.sqrt(1.0 - z**2)
    return radius_m * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=-1)


def outcome(change, centres_m, **other):
    plain = {"misplaced": np.zeros_like(change), "session_sd": np.zeros(change.shape[1])}
    return significance(change, centres_m, **(plain | other))


@pytest.mark.slow
@pytest.mark.parametrize("dimensions", [1, 3])
@pytest.mark.parametrize("smooth_over_m", [0.01, 0.02, 0.04])
def test_smooth_errors_are_seldom_taken_for_a_change(smooth_over_m, dimensions):
    """Even where the errors of a whole side of the fruit are alike."""
    centres_m, alarms = ball_patches(), 0
    for seed in range(30):
        random = np.random.default_rng(seed)
        change = np.stack([smooth_noise(centres_m, smooth_over_m, random) for _ in range(dimensions)], axis=1)
        alarms += (outcome(change, centres_m).p < FALSE_DISCOVERIES).any()
    assert alarms <= 2


@pytest.mark.parametrize("smooth_over_m", [0.01, 0.02])
def test_a_spot_that_stands_out_of_smooth_errors_is_found_and_nothing_else(smooth_over_m):
    centres_m = ball_patches()
    spot = np.linalg.norm(centres_m - centres_m[300], axis=1) < 0.012
    for seed in range(10):
        change = smooth_noise(centres_m, smooth_over_m, np.random.default_rng(seed))[:, None]
        change[spot] += 15.0
        found = outcome(change, centres_m).p < FALSE_DISCOVERIES
        assert found[spot].all()
        assert found[~spot].sum() <= 1


def errors_of_a_capture(centres_m, seed, at_base=1.0):
    """Smooth errors, larger by a factor at the base."""
    low = centres_m[:, 2] < -0.75 * np.abs(centres_m).max()
    return smooth_noise(centres_m, 0.01, np.random.default_rng(seed))[:, None] * np.where(low, at_base, 1.0)[:, None]


@pytest.mark.slow
def test_errors_that_are_larger_at_the_base_are_no_change_where_a_second_capture_shows_them():
    centres_m, alone, told = ball_patches(), 0, 0
    spot = np.linalg.norm(centres_m - centres_m[300], axis=1) < 0.012
    for seed in range(20):
        first, again, later = (errors_of_a_capture(centres_m, 3 * seed + day, 6.0) for day in range(3))
        alone += (outcome(later - first, centres_m).p < FALSE_DISCOVERIES).any()
        told += (outcome(later - first, centres_m, repeat=again - first).p < FALSE_DISCOVERIES).any()
        bruised = later - first + 15.0 * spot[:, None]
        found = outcome(bruised, centres_m, repeat=again - first).p < FALSE_DISCOVERIES
        assert found[spot].all()
    assert alone > 10
    assert told <= 1


def test_with_a_second_capture_what_did_not_change_itself_is_no_change():
    """Where most of the surface changed, the rest stands out from it."""
    centres_m, rng = ball_patches(), np.random.default_rng(0)
    change, repeat = rng.normal(size=(2, len(centres_m), 1))
    kept = centres_m[:, 0] > 0.025
    change[~kept] += 30.0
    assert (outcome(change, centres_m).p[kept] < FALSE_DISCOVERIES).all()
    assert not (outcome(change, centres_m, repeat=repeat).p < FALSE_DISCOVERIES).any()


def test_what_two_captures_of_a_day_share_is_no_change_of_the_whole_surface():
    centres_m, rng = ball_patches(), np.random.default_rng(0)
    change, repeat = rng.normal(3.0, 1.0, size=(2, len(centres_m), 1))
    assert outcome(change, centres_m).whole_p < 1e-6
    assert outcome(change, centres_m, repeat=repeat).whole_p > 0.1
    assert outcome(change + 20.0, centres_m, repeat=repeat).whole_p < 1e-6


def test_at_the_rim_errors_anywhere_at_the_rim_count():
    """An object that is set down anew leans to another side."""
    centres_m, rng = ball_patches(), np.random.default_rng(0)
    change, repeat = rng.normal(size=(2, len(centres_m), 1))
    rim = centres_m[:, 2] < -0.03
    change[np.argmin(np.where(rim, centres_m[:, 0], 1.0))] = 14.0
    repeat[np.argmax(np.where(rim, centres_m[:, 0], -1.0))] = -12.0
    assert (outcome(change, centres_m, repeat=repeat).p < FALSE_DISCOVERIES).sum() == 1
    assert not (outcome(change, centres_m, repeat=repeat, rim=rim).p < FALSE_DISCOVERIES).any()
    spot = np.argmax(centres_m[:, 2])
    change[spot] = 14.0
    found = outcome(change, centres_m, repeat=repeat, rim=rim).p < FALSE_DISCOVERIES
    assert np.flatnonzero(found).tolist() == [spot]


def test_a_second_capture_that_does_not_see_a_part_says_nothing_of_it():
    centres_m, rng = ball_patches(), np.random.default_rng(0)
    change, repeat = rng.normal(size=(2, len(centres_m), 1))
    hidden = centres_m[:, 0] > 0.0
    repeat[hidden] = np.nan
    change[np.argmax(centres_m[:, 0])] += 12.0
    found = outcome(change, centres_m, repeat=repeat)
    assert np.flatnonzero(found.p < FALSE_DISCOVERIES).tolist() == [np.argmax(centres_m[:, 0])]


def test_white_errors_are_tested_as_students_test_does():
    random = np.random.default_rng(0)
    centres_m = random.random((1200, 3))
    change = random.normal(size=(1200, 1))
    change[0] = 7.0
    found = outcome(change, centres_m)
    assert found.noise[0] == pytest.approx(1.0, rel=0.05)
    assert found.independent > 1000
    assert found.p[0] < 1e-4
    assert (found.p[1:] > 0.5).all()
    expected = stats.norm.sf(abs(found.whole[0] / found.whole_sd[0])) * 2
    assert found.whole_p == pytest.approx(expected, abs=0.01)


def test_a_change_of_the_whole_surface_is_no_change_of_a_patch_but_has_its_own_p_value():
    random = np.random.default_rng(0)
    change = random.normal(1.0, 1.0, (900, 1))
    found = outcome(change, random.random((900, 3)))
    assert (found.p > FALSE_DISCOVERIES).all()
    assert found.whole_p < 1e-6
    assert found.whole[0] == pytest.approx(1.0, abs=4 * found.whole_sd[0])
    assert outcome(change, random.random((900, 3)), session_sd=np.ones(1)).whole_p > 0.1


def test_patches_that_are_misplaced_or_unknown_do_not_count_as_changed():
    random = np.random.default_rng(0)
    change, centres_m = random.normal(size=(500, 1)), random.random((500, 3))
    change[0] = 8.0
    assert outcome(change, centres_m).p[0] < FALSE_DISCOVERIES
    misplaced = np.zeros((500, 1))
    misplaced[0] = 5.0
    assert outcome(change, centres_m, misplaced=misplaced).p[0] > FALSE_DISCOVERIES
    change[0] = np.nan
    assert outcome(change, centres_m).p[0] == 1.0


def test_errors_of_a_trained_run_are_no_change_where_they_are_as_large_as_their_conditions_say():
    """At the base, which cameras see at grazing angles, and which no second capture tells of."""
    centres_m, alone, told = ball_patches(), 0, 0
    steep = np.degrees(np.arccos(np.clip(centres_m[:, 2] / -0.035, 0.0, 1.0)))[:, None]
    spot = np.linalg.norm(centres_m - centres_m[300], axis=1) < 0.012
    for seed in range(6):
        change = errors_of_a_capture(centres_m, 2 * seed, 6.0) - errors_of_a_capture(centres_m, 2 * seed + 1, 6.0)
        alone += (outcome(change, centres_m).p < FALSE_DISCOVERIES).any()
        told += (outcome(change, centres_m, conditions=-steep).p < FALSE_DISCOVERIES).any()
        found = outcome(change + 15.0 * spot[:, None], centres_m, conditions=-steep).p < FALSE_DISCOVERIES
        assert found[spot].all()
    assert alone > 3
    assert told <= 1


def test_patches_hold_the_seen_area_and_the_means_of_their_vertices():
    points, areas_m2 = ball_patches(20_000), np.full(20_000, 4 * np.pi * 0.035**2 / 20_000)
    seen = points[:, 2] > -0.02
    patches = surface_patches(points, areas_m2, seen)
    assert patches.areas_m2.sum() == pytest.approx(areas_m2[seen].sum())
    assert np.median(patches.areas_m2) == pytest.approx(2.5e-5, rel=0.4)
    assert (patches.of_vertex[~seen] == -1).all()
    np.testing.assert_allclose(patches.means(points, areas_m2), patches.centres_m, atol=1e-12)


def test_with_few_independent_parts_the_p_value_is_students_and_that_of_components_hotellings():
    assert hotelling_p(np.array(9.0), 1, 15.0) == pytest.approx(2.0 * stats.t.sf(3.0, 14.0))
    assert hotelling_p(np.array(9.0), 3, 1e7) == pytest.approx(stats.chi2.sf(9.0, 3), rel=1e-4)
    random = np.random.default_rng(0)
    squares = []
    for _ in range(4000):
        sample = random.normal(size=(12, 2))
        apart = random.normal(size=2)
        squares.append(apart @ np.linalg.solve(np.cov(sample, rowvar=False), apart))
    assert (hotelling_p(np.array(squares), 2, 12.0) < 0.05).mean() == pytest.approx(0.05, abs=0.012)


def test_the_mean_of_smooth_errors_is_no_change_of_the_whole_surface():
    centres_m = ball_patches()
    fields = (smooth_noise(centres_m, 0.02, np.random.default_rng(seed))[:, None] for seed in range(40))
    assert np.mean([outcome(field, centres_m).whole_p < 0.05 for field in fields]) <= 0.15


def test_rounding_of_equal_clouds_is_no_change():
    rng = np.random.default_rng(0)
    change = 1e-9 * rng.normal(size=(400, 1))
    change[:20] = 7e-6
    found = significance(change, rng.random((400, 3)), np.zeros((400, 1)), np.zeros(1))
    assert found.p.min() > FALSE_DISCOVERIES
