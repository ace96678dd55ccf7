"""Boundaries of masks, against SciPy and by hand."""

import numpy as np
import pytest
from scipy import ndimage

from hsi_sc_nerf.morphology import beside, ellipse_close_open


@pytest.fixture
def mask():
    """Two discs, one of which the image's edge cuts."""
    line, sample = np.mgrid[:20, :30]
    return (np.hypot(line - 9, sample - 8) < 5) | (np.hypot(line - 12, sample - 29) < 4)


def test_pixels_beside_a_mask_share_a_side_with_it(mask):
    np.testing.assert_array_equal(beside(mask, 1), ndimage.binary_dilation(mask) & ~mask)
    np.testing.assert_array_equal(beside(~mask, 1), ndimage.binary_dilation(~mask) & mask)


def test_pixels_beside_a_mask_are_within_the_width(mask):
    away_px = ndimage.distance_transform_edt(~mask)
    found = beside(mask, 3)
    assert found[(away_px > 0) & (away_px <= 2)].all()
    assert not found[(away_px == 0) | (away_px > 3.2)].any()


def test_nothing_is_beside_an_empty_or_a_full_mask(mask):
    assert not beside(np.zeros_like(mask), 2).any()
    assert not beside(np.ones_like(mask), 2).any()


@pytest.mark.parametrize("size", range(2, 12))
def test_closing_adds_and_opening_takes_away(size):
    mask = np.random.default_rng(size).random((60, 70)) > 0.5
    assert ellipse_close_open(mask, close_px=size, open_px=0)[mask].all()
    assert mask[ellipse_close_open(mask, close_px=0, open_px=size)].all()
