from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.surface.outline_opacity import (
    HALF,
    OUTLINE_PX,
    PLAUSIBLE_OPACITY,
    PURE_PX,
    half_coverage_opacity,
    outline_pixels,
    pixel_coverage,
    rim_brightness,
)

SIDE, BANDS, RADIUS_PX = 64, 12, 20.0
CENTRES_PX = ((32.0, 32.0), (30.3, 33.6), (33.1, 30.4), (31.7, 32.2), (32.4, 29.9))
FRUIT, WALL = np.linspace(0.1, 0.5, BANDS), np.full(BANDS, 0.9)


def coverage_of_a_disc(centre_px, supersampling=16):
    ticks = (np.arange(SIDE * supersampling) + 0.5) / supersampling
    inside = np.hypot(ticks[:, None] - centre_px[0], ticks[None] - centre_px[1]) < RADIUS_PX
    return inside.reshape(SIDE, supersampling, SIDE, supersampling).mean(axis=(1, 3))


COVERAGE = np.stack([coverage_of_a_disc(centre) for centre in CENTRES_PX])


def sampler(fruit=FRUIT, flagged=(), gloss=0.0):
    """Reads pictures of a disc, darker at the top than at the bottom, whose rim mirrors the wall."""
    light = np.linspace(0.7, 1.0, SIDE)[:, None, None]
    pixels = np.indices((SIDE, SIDE)) + 0.5
    from_centre = np.stack([np.hypot(*(pixels - np.array(centre)[:, None, None])) for centre in CENTRES_PX])
    mirrored = gloss * (np.minimum(from_centre / RADIUS_PX, 1.0) ** 8)[..., None]
    rim = (1.0 - mirrored) * fruit + mirrored * WALL
    spectra = (COVERAGE[..., None] * rim + (1.0 - COVERAGE[..., None]) * WALL) * light

    def at(pixels):
        batch = {"spectral": spectra[tuple(pixels.T)].astype(np.float32)}
        if flagged:
            batch["valid"] = np.ones(batch["spectral"].shape, bool)
            batch["valid"][:, list(flagged)] = False
            batch["spectral"][:, list(flagged)] = 0.0
        return batch

    return SimpleNamespace(masks=COVERAGE >= 0.5, at=at)


def everywhere(frame):
    return np.ones((SIDE, SIDE), bool)


@pytest.mark.parametrize("flagged", [(), (3, 7)])
def test_coverage_is_that_of_the_area(flagged):
    pixels = outline_pixels(COVERAGE >= 0.5, everywhere, OUTLINE_PX, PURE_PX)
    assert len(pixels[0]) > 1000
    found = pixel_coverage(sampler(flagged=flagged), *pixels)
    np.testing.assert_allclose(found, COVERAGE[tuple(pixels[0].T)], atol=0.06)
    assert abs(np.mean(found - COVERAGE[tuple(pixels[0].T)])) < 0.01


def test_pixels_beside_the_outline_are_pure_and_before_the_chamber():
    upper = everywhere(0)
    upper[32:] = False
    on, inside, outside = outline_pixels(COVERAGE >= 0.5, lambda frame: upper, OUTLINE_PX, PURE_PX)
    assert (COVERAGE[tuple(inside.T)] == 1.0).all()
    assert (COVERAGE[tuple(outside.T)] == 0.0).all()
    assert (on[:, 1] < 32).all()
    assert (outside[:, 1] < 32).all()
    assert set(on[:, 0]) == set(range(len(CENTRES_PX)))


@pytest.mark.parametrize("masks", [np.zeros((2, 8, 8), bool), np.ones((1, 8, 8), bool)])
def test_masks_without_an_outline_give_no_pixels(masks):
    for part in outline_pixels(masks, lambda frame: ~masks[0] | True, OUTLINE_PX, PURE_PX):
        assert part.shape == (0, 3)


def test_an_object_like_the_wall_tells_no_coverage():
    pixels = outline_pixels(COVERAGE >= 0.5, everywhere, OUTLINE_PX, PURE_PX)
    assert np.isnan(pixel_coverage(sampler(fruit=WALL - 0.01), *pixels)).all()


@pytest.mark.parametrize("power", [0.5, 0.74, 1.0])
def test_the_opacity_at_half_a_coverage_is_measured(power):
    found = half_coverage_opacity(sampler(), everywhere, lambda pixels: COVERAGE[tuple(pixels.T)] ** power)
    assert found == pytest.approx(0.5**power, abs=0.03)


def test_half_is_taken_where_nothing_tells_the_coverage():
    found = half_coverage_opacity(sampler(fruit=WALL), everywhere, lambda pixels: np.ones(len(pixels)))
    assert found == HALF


@pytest.mark.parametrize("gloss", [-0.3, 0.3])
def test_half_is_taken_where_the_rim_mirrors_the_chamber_or_is_in_the_shade(gloss):
    found = half_coverage_opacity(sampler(gloss=gloss), everywhere, lambda pixels: COVERAGE[tuple(pixels.T)] ** 0.5)
    assert found == HALF


def test_an_implausible_opacity_is_bounded():
    found = half_coverage_opacity(sampler(), everywhere, lambda pixels: np.ones(len(pixels)))
    assert found == PLAUSIBLE_OPACITY[1]


def test_saturated_values_inside_do_not_make_the_rim_brighter():
    def at(pixels):
        valid = np.ones((len(pixels), 10), bool)
        valid[:, 0] = pixels[:, 0] == 0  # saturated inside
        return {"spectral": 0.8 * valid, "valid": valid}

    rim, deep = np.zeros((60, 3), int), np.ones((60, 3), int)
    assert rim_brightness(SimpleNamespace(at=at), rim, deep) == pytest.approx(1.0)
