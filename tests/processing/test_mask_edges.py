"""The edge of masks, on drawn pictures of half-covered and shaded pixels."""

import numpy as np
import pytest
from scipy import ndimage

from hsi_sc_nerf.processing.mask_edges import at_half_coverage, shaded_parts
from hsi_sc_nerf.processing.masks import foreground_mask

SUPERSAMPLING = 16


def shaded_ball(background: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bins of a red ball whose lower half gets ever less light, on a gray background; where it is and its light."""
    y, x = np.mgrid[:60, :60]
    ball = np.hypot(x - 30, y - 30) < 20
    light = np.where(y > 30, np.clip(1.0 - (y - 30) / 22.0, 0.0, 1.0), 1.0)
    spectrum = np.linspace(0.1, 0.7, 24)[:, None, None]
    wall = np.full((24, 1, 1), background)
    bins = np.where(ball, spectrum * light, wall * np.where(y > 50, 0.1, 1.0))
    return bins.astype(np.float32), ball, light


def test_shaded_parts_are_told_by_spread_relative_to_brightness():
    bins, ball, light = shaded_ball(background=0.9)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = foreground_mask(score, 0.1)
    assert (ball & ~body).sum() > 60  # what the score alone misses
    shaded = shaded_parts(body, score, bright)
    rim = ball & ~ndimage.binary_erosion(ball)
    assert not (ball & (light > 0.15) & ~body & ~shaded & ~rim).any()
    assert (shaded & ~ball).sum() <= 4
    assert not shaded_parts(body, score, bright, fraction=1.5).any()
    upper = np.zeros_like(ball)
    upper[:40] = True
    assert not shaded_parts(body, score, bright, region=upper)[40:].any()


def test_before_a_dark_background_only_what_is_darker_still_is_a_shaded_part():
    bins, ball, light = shaded_ball(background=0.1)
    bins += np.random.default_rng(0).normal(0.0, 0.02, bins.shape).astype(np.float32)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = foreground_mask(score, 0.1)
    shaded = shaded_parts(body, score, bright, region=score > 0.04)
    assert not (shaded & ~(ball & (light < 0.3))).any()
    assert not shaded_parts(np.zeros_like(body), score, bright).any()
    assert not shaded_parts(np.ones_like(body), score, bright).any()


def test_shaded_parts_before_a_dark_wall_are_found_beside_a_brighter_lid():
    bins, ball, light = shaded_ball(background=0.1)
    below = np.mgrid[:60, :60][0] > 42
    bins = np.where(below & ~ball, 0.9, bins)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = foreground_mask(score, 0.1)
    shaded = shaded_parts(body, score, bright)
    assert (ball & below & (light > 0.15) & ~body & ~shaded).sum() < 0.1 * (ball & below & ~body).sum()
    assert not (shaded & ~ball).any()


def disc(radius: float) -> np.ndarray:
    """Fraction of each pixel that a disc covers."""
    ticks = (np.arange(40 * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    inside = np.hypot(ticks[:, None] - 20.3, ticks - 19.8) < radius
    return inside.reshape(40, SUPERSAMPLING, 40, SUPERSAMPLING).mean(axis=(1, 3))


@pytest.mark.parametrize("dark_half", [1.0, 0.6])
@pytest.mark.parametrize("wall", [0.05, 0.9])
@pytest.mark.parametrize("offset_px", [-1.0, 0.0, 0.7])
def test_the_edge_is_where_pixels_are_half_covered(dark_half, wall, offset_px):
    coverage = disc(12.0)
    albedo = np.where(np.arange(40) < 20, 1.0, dark_half) * 0.4
    score, bright = 0.3 * albedo * coverage, albedo * coverage + wall * (1.0 - coverage)
    refined = at_half_coverage(disc(12.0 + offset_px) > 0.5, score, bright, score > 0.005)
    assert not (refined & (coverage < 0.4)).any()
    assert not (~refined & (coverage > 0.7)).any()


def test_thin_parts_keep_their_edge():
    score = np.zeros((40, 40))
    score[:, 19:21] = 0.1
    score[20:, 20] = 0.03
    mask = score > 0
    np.testing.assert_array_equal(at_half_coverage(mask, score, np.full((40, 40), 0.4), mask), mask)
