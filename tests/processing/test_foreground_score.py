"""The foreground score: what the background's spectra leave of a spectrum."""

import numpy as np
import pytest

from hsi_sc_nerf.processing.foreground_score import (
    background_subspace,
    foreground_score,
    otsu_threshold,
    smoothed_bins,
    spectral_bin_width,
)

FLAT = np.full((12, 1), 12**-0.5)
PLANT = np.linspace(0.1, 0.6, 12)


@pytest.mark.parametrize(("bands", "width"), [(204, 9), (12, 1), (24, 1), (25, 2)])
def test_bins_of_one_width(bands, width):
    assert spectral_bin_width(bands) == width


def test_before_a_flat_background_the_score_is_the_spread_over_bins():
    bins = np.random.default_rng(1).random((12, 5, 4), dtype=np.float32)
    np.testing.assert_allclose(foreground_score(bins, FLAT), bins.std(axis=0), atol=1e-6)
    assert (foreground_score(smoothed_bins(bins), FLAT) < foreground_score(bins, FLAT)).mean() > 0.9
    assert foreground_score(np.full((12, 4, 4), 0.4), FLAT).max() < 1e-6


def test_score_is_linear_in_the_fraction_of_a_mixed_pixel():
    fractions = np.array([0.0, 0.25, 0.5, 1.0])
    score = foreground_score((PLANT[:, None] * fractions + 0.8 * (1.0 - fractions))[..., None], FLAT)[:, 0]
    np.testing.assert_allclose(score, fractions * score[-1], atol=1e-6)


def coloured_wall(colours: int) -> tuple[np.ndarray, np.ndarray]:
    """Four frames of a plant before a wall whose pixels mix the given number of colours, and where it is."""
    rng = np.random.default_rng(5)
    wavelength = np.linspace(0.0, 1.0, 12)
    paints = np.stack([0.4 + 0.4 * np.cos(np.pi * (k + 1) * wavelength) for k in range(colours)])
    plant = 0.3 + 0.2 * np.sign(wavelength - 0.55)
    inside = np.zeros((40, 40), bool)
    inside[15:30, 12:28] = True
    fractions = rng.dirichlet(np.ones(colours), inside.shape)
    frames = np.where(inside[..., None], plant, fractions @ paints) + rng.normal(0.0, 0.003, (4, 40, 40, 12))
    return np.moveaxis(frames, -1, 1), inside


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("colours", [1, 2, 3])
def test_a_wall_of_several_colours_is_left_out(colours, given):
    bins, inside = coloured_wall(colours)
    regions = None
    if given:
        regions = np.zeros((4, 40, 40), bool)
        regions[:, 12:33, 9:31] = True
    background = background_subspace(bins, regions)
    np.testing.assert_allclose(background.T @ background, np.eye(background.shape[1]), atol=1e-9)
    assert background.shape[1] <= colours + 1
    scores = [foreground_score(image, background) for image in bins]
    threshold, _, separation = otsu_threshold(scores)
    assert separation > 6.0
    assert ((np.stack(scores) > threshold) == inside).all()


def test_otsu_separates_two_classes_and_says_how_far_they_are_apart():
    rng = np.random.default_rng(2)
    scores = [np.abs(rng.normal(0.02, 0.01, (50, 50))) for _ in range(3)]
    scores[1][:10, :20] = rng.normal(0.3, 0.03, (10, 20))
    threshold, contrast, separation = otsu_threshold(scores)
    assert 0.1 < threshold < 0.2
    assert contrast == pytest.approx(0.28, abs=0.01)
    assert separation == pytest.approx(28.0, rel=0.1)
    assert otsu_threshold([np.zeros((3, 3))]) == (0.0, 0.0, 0.0)
