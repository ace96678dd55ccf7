"""Precision, recall, F-score and distances of surfaces."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import norm

from hsi_sc_nerf.evaluation.spatial import (
    Surface,
    ThresholdCurves,
    best_threshold_m,
    distance_statistics,
    precision_recall_f_score,
    sample_surface,
    score_at,
    threshold_curves,
    threshold_for_m,
)

# A square of 10 cm in the plane z = 0, as a mesh of two triangles.
SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def plane(side: int = 41, spacing_m: float = 0.0025, z_m: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(side) * spacing_m, np.arange(side) * spacing_m)
    return np.stack([x.ravel(), y.ravel(), np.full(side * side, z_m)], -1)


GRID = plane(40)
HALF = GRID[GRID[:, 0] < 0.0499]
NOTHING = np.zeros((0, 3))


@pytest.mark.parametrize(
    ("cloud", "reference", "threshold_m", "precision", "recall"),
    [
        pytest.param(plane(z_m=0.001999), plane(), 0.002, 100, 100, id="just within along its normal"),
        pytest.param(plane(z_m=0.002001), plane(), 0.002, 0, 0, id="just beyond along its normal"),
        pytest.param(np.array([[0.0, 0, 0.5]]), np.zeros((1, 3)), 0.5, 100, 100, id="the threshold itself counts"),
        pytest.param(HALF, GRID, 0.002, 100, 50, id="a missing half costs recall only"),
        pytest.param(GRID, HALF, 0.002, 50, 100, id="a half too many costs precision only"),
        pytest.param(
            np.concatenate([GRID, plane(20, z_m=1)]), GRID, 0.002, 80, 100, id="outliers cost precision only"
        ),
        pytest.param(GRID + np.array([0.01, 0, 0]), GRID, 0.001, 90, 90, id="moved in itself it loses its rim"),
        pytest.param(NOTHING, plane(), 0.002, 0, 0, id="an empty cloud"),
        pytest.param(plane(), NOTHING, 0.002, 0, 0, id="an empty reference"),
    ],
)
def test_scores_of_planes(cloud, reference, threshold_m: float, precision: float, recall: float) -> None:
    score = precision_recall_f_score(cloud, reference, threshold_m)
    expected = 2 * precision * recall / (precision + recall) if precision + recall else 0
    assert (score.precision, score.recall, score.f_score) == pytest.approx((precision, recall, expected))


def test_samples_are_even_over_the_area_whatever_the_triangles() -> None:
    # The same square with one of its halves cut into 64 slivers.
    fan = np.linspace([0.1, 0.1, 0], [0, 0.1, 0], 65)
    vertices = np.concatenate([SQUARE, fan])
    triangles = np.array([[0, 1, 2], *([0, 4 + i, 5 + i] for i in range(64))])
    points = sample_surface(vertices, triangles, 40_000, seed=1)
    assert points.shape == (40_000, 3)
    assert not points[:, 2].any()
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=4, range=[[0, 0.1], [0, 0.1]])[0]
    np.testing.assert_allclose(counts, 2500, rtol=0.06)
    assert abs(np.sum(points[:, 1] > points[:, 0]) - 20_000) <= 1


def test_samples_repeat_with_the_seed() -> None:
    same = [sample_surface(SQUARE, TRIANGLES, 100, seed=5) for _ in range(2)]
    np.testing.assert_array_equal(*same)
    assert (sample_surface(SQUARE, TRIANGLES, 100, seed=6) != same[0]).any()


def test_a_mesh_without_area_is_refused() -> None:
    for triangles in (np.zeros((0, 3), int), np.array([[0, 0, 0]])):
        with pytest.raises(ValueError, match="no area"):
            sample_surface(SQUARE, triangles, 10)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), (4.5e5, 5.2e6, 120.0)], ids=["object", "survey grid"])
def test_distance_to_the_surface_not_to_its_vertices(origin_m: tuple[float, ...]) -> None:
    points = np.array([[0.05, 0.05, 0.003], [0.05, 0.05, -0.003], [0.05, 0.02, 0.0], [0.13, 0.05, 0.04]])
    distances = Surface(SQUARE + origin_m, SQUARE + origin_m, TRIANGLES).distances_m(points + origin_m)
    np.testing.assert_allclose(distances, [0.003, 0.003, 0.0, 0.05], atol=1e-8)


@pytest.mark.slow
def test_scores_need_no_open3d() -> None:
    program = "import sys, hsi_sc_nerf.evaluation.spatial as s; sys.exit('open3d' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def on_square(count: int, seed: int = 0) -> np.ndarray:
    positions = np.random.default_rng(seed).uniform(0.01, 0.09, (count, 3))
    positions[:, 2] = 0
    return positions


def test_noise_along_the_normal_is_within_a_threshold_as_the_normal_distribution_says() -> None:
    sigma_m, thresholds_m = 0.001, np.array([0.0005, 0.001, 0.002])
    noisy = on_square(40_000)
    noisy[:, 2] = np.random.default_rng(0).normal(0, sigma_m, len(noisy))
    to_surface = Surface(on_square(10), SQUARE, TRIANGLES).distances_m(noisy)
    curves = threshold_curves(to_surface, np.zeros(1), thresholds_m)
    assert curves.precision == pytest.approx(100 * (2 * norm.cdf(thresholds_m / sigma_m) - 1), abs=0.8)
    statistics = distance_statistics(to_surface)
    assert statistics["rms_m"] == pytest.approx(sigma_m, rel=0.01)
    assert statistics["mean_m"] == pytest.approx(sigma_m * np.sqrt(2 / np.pi), rel=0.01)
    assert statistics["median_m"] == pytest.approx(norm.ppf(0.75) * sigma_m, rel=0.02)
    assert statistics["percentile_95_m"] == pytest.approx(norm.ppf(0.975) * sigma_m, rel=0.02)


def exponential_knee(scale: float) -> float:
    """Where 1 - exp(-x / scale) over [0, 1] leaves its chord furthest: its slope is the chord's."""
    return -scale * np.log(scale * (1 - np.exp(-1 / scale)))


X = np.linspace(0, 1, 10_001)


@pytest.mark.parametrize(
    ("curve", "knee"),
    [
        pytest.param(np.interp(X, [0, 0.3, 1], [10, 90, 100]), 0.3, id="a broken line"),
        pytest.param(1 - np.exp(-X / 0.2), exponential_knee(0.2), id="an exponential rise"),
        pytest.param(np.full(len(X), 100.0), 0.0, id="a flat curve"),
    ],
)
def test_the_knee_of_a_curve(curve: np.ndarray, knee: float) -> None:
    assert best_threshold_m(ThresholdCurves(X, curve, curve, curve)) == pytest.approx(knee, abs=1e-4)


def test_the_threshold_that_reaches_a_score_does_and_the_next_smaller_one_does_not() -> None:
    rng = np.random.default_rng(4)
    forth, back = rng.exponential(0.001, 500), rng.exponential(0.002, 400)
    for percent in (50, 90, 100):
        threshold = threshold_for_m(forth, back, percent)
        assert score_at(forth, back, threshold).f_score >= percent - 1e-9
        assert score_at(forth, back, threshold * (1 - 1e-9)).f_score < percent
    assert threshold_for_m(forth, back, 100) == max(forth.max(), back.max())
