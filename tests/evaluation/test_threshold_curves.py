from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from hsi_sc_nerf.evaluation.spatial import (
    Surface,
    ThresholdCurves,
    best_threshold_m,
    distance_statistics,
    f_score,
    precision_recall_f_score,
    score_at,
    threshold_curves,
    threshold_for_m,
)

SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def on_square(count: int, seed: int = 0) -> np.ndarray:
    places = np.random.default_rng(seed).uniform(0.01, 0.09, (count, 3))
    places[:, 2] = 0
    return places


def distances(cloud: Surface, reference: Surface) -> tuple[np.ndarray, np.ndarray]:
    return reference.distances_m(cloud.points_m), cloud.distances_m(reference.points_m)


def test_curves_are_the_papers_formulas_at_each_threshold() -> None:
    rng = np.random.default_rng(2)
    cloud, reference = Surface(rng.random((300, 3))), Surface(rng.random((200, 3)))
    thresholds = np.array([0.0, 0.02, 0.1, 0.3])
    curves = threshold_curves(*distances(cloud, reference), thresholds)
    for i, threshold in enumerate(thresholds):
        score = precision_recall_f_score(cloud.points_m, reference.points_m, threshold)
        assert (curves.precision[i], curves.recall[i]) == pytest.approx((score.precision, score.recall))
        assert curves.f_score[i] == pytest.approx(score.f_score)
        at = score_at(*distances(cloud, reference), threshold)
        assert (at.precision, at.recall, at.f_score) == pytest.approx((score.precision, score.recall, score.f_score))


def test_the_threshold_itself_counts() -> None:
    curves = threshold_curves(np.array([0.001, 0.002]), np.array([0.002]), np.array([0.001, 0.002]))
    np.testing.assert_array_equal(curves.precision, [50, 100])
    np.testing.assert_array_equal(curves.recall, [0, 100])


def test_a_tenth_of_outliers_leaves_nine_tenths_of_precision() -> None:
    good = on_square(9000)
    far = on_square(1000) + np.array([0, 0, 0.05])
    forth, back = distances(Surface(np.concatenate([good, far])), Surface(on_square(5000, 1), SQUARE, TRIANGLES))
    score = score_at(forth, back, 0.002)
    assert (score.precision, score.recall) == pytest.approx((90, 100), abs=0.05)
    assert score.f_score == pytest.approx(2 * 90 * 100 / 190, abs=0.05)


def test_a_missing_half_halves_recall() -> None:
    reference = on_square(20_000)
    forth, back = distances(Surface(reference[reference[:, 0] < 0.05]), Surface(reference))
    # The points within the threshold of the cut, 2 mm of 80 mm, still count.
    score = score_at(forth, back, 0.002)
    assert (score.precision, score.recall) == pytest.approx((100, 52.5), abs=0.8)


@pytest.mark.parametrize("threshold_m", [0.0005, 0.001, 0.002])
def test_noise_along_the_normal_is_within_a_threshold_as_the_normal_distribution_says(threshold_m: float) -> None:
    sigma_m = 0.001
    noisy = on_square(40_000)
    noisy[:, 2] = np.random.default_rng(0).normal(0, sigma_m, len(noisy))
    to_surface = Surface(on_square(10), SQUARE, TRIANGLES).distances_m(noisy)
    curves = threshold_curves(to_surface, np.zeros(1), np.array([threshold_m]))
    assert curves.precision[0] == pytest.approx(100 * (2 * norm.cdf(threshold_m / sigma_m) - 1), abs=0.8)
    statistics = distance_statistics(to_surface)
    assert statistics.rms_m == pytest.approx(sigma_m, rel=0.01)
    assert statistics.mean_m == pytest.approx(sigma_m * np.sqrt(2 / np.pi), rel=0.01)
    assert statistics.median_m == pytest.approx(norm.ppf(0.75) * sigma_m, rel=0.02)
    assert statistics.percentile_95_m == pytest.approx(norm.ppf(0.975) * sigma_m, rel=0.02)


def test_points_overstate_the_distance_to_a_surface() -> None:
    above = np.array([[0.05, 0.05, 0.003]])
    sampled = np.array([[0.05, 0.054, 0.0]])
    assert Surface(sampled, SQUARE, TRIANGLES).distances_m(above) == pytest.approx(0.003)
    assert Surface(sampled).distances_m(above) == pytest.approx(0.005)


def test_the_knee_is_where_a_broken_line_breaks() -> None:
    thresholds = np.linspace(0, 0.01, 101)
    rising = np.interp(thresholds, [0, 0.003, 0.01], [10, 90, 100])
    curves = ThresholdCurves(thresholds, rising, rising, rising)
    assert best_threshold_m(curves) == pytest.approx(0.003)


def test_the_knee_of_an_exponential_rise() -> None:
    # 1 - exp(-x / s) over [0, 1] leaves its chord furthest where its slope is the chord's.
    thresholds, scale = np.linspace(0, 1, 10_001), 0.2
    curve = 1 - np.exp(-thresholds / scale)
    knee = -scale * np.log(scale * (1 - np.exp(-1 / scale)))
    assert best_threshold_m(ThresholdCurves(thresholds, curve, curve, curve)) == pytest.approx(knee, abs=1e-4)


def test_a_flat_curve_has_its_knee_at_the_start() -> None:
    flat = np.full(5, 100.0)
    assert best_threshold_m(ThresholdCurves(np.linspace(0, 1, 5), flat, flat, flat)) == 0


def test_the_threshold_that_reaches_a_score_does_and_the_next_smaller_one_does_not() -> None:
    rng = np.random.default_rng(4)
    forth, back = rng.exponential(0.001, 500), rng.exponential(0.002, 400)
    for percent in (50, 90, 100):
        threshold = threshold_for_m(forth, back, percent)
        assert score_at(forth, back, threshold).f_score >= percent - 1e-9
        assert score_at(forth, back, threshold * (1 - 1e-9)).f_score < percent
    assert threshold_for_m(forth, back, 100) == max(forth.max(), back.max())


def test_f_score_of_nothing_is_nothing() -> None:
    np.testing.assert_array_equal(f_score([0, 0, 50, 100], [0, 100, 100, 100]), [0, 0, 100 * 2 / 3, 100])


def test_an_empty_side_is_refused() -> None:
    with pytest.raises(ValueError, match="one point each"):
        threshold_curves(np.zeros(0), np.zeros(3), np.array([0.1]))
