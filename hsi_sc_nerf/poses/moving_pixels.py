"""Pixels that show what turns with the object: structure from motion must not see the static chamber.

A turning object before a fixed camera gives the images of a camera that orbits a fixed object only where the
background carries no features. Otherwise structure from motion finds a camera that stands still.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf.morphology import dilate, ellipse_close_open, touching

# Standard deviation of the Gaussian that lowers the images' noise, pixels.
_SMOOTHING_PX = 1.0
# A pixel moves if its brightness varies over the frames by more than so many times the noise, and by more than this
# standard deviation, gray levels: rounding to 8 bits alone makes less.
_NOISE_FACTOR = 3.0
_LEAST_CHANGE = 1.0
# Gaps up to this fraction of the image's shorter side are closed: even skin between its patterns.
_CLOSING_FRACTION = 0.04
# The moving region is widened by this fraction of the shorter side; little, for the background begins right there.
_MARGIN_FRACTION = 0.002
# Moving specks below this fraction of the image's area are left out, such as the jagged rim of an even disc.
_LEAST_AREA_FRACTION = 0.0005
# Brightness classes of equal size in which the noise is measured: photon noise grows with the light.
_BRIGHTNESS_CLASSES = 16
# At least this fraction of a class stands still; otherwise a brighter class gives its noise.
_STILL_FRACTION = 0.1


def moving_pixels(images: Sequence[UInt8[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"]:
    """Pixels that show something that turns in some of the frames.

    The lamps' drift, one factor per frame, is removed first. Only what changes the image is found: an even disc and
    the outline of a body of revolution do not.

    Args:
        images: one 8-bit gray image per frame, all of one size, linear in reflectance.
    """
    stack = np.stack([cv2.GaussianBlur(i.astype(np.float32), (0, 0), _SMOOTHING_PX) for i in images])
    middle = np.median(stack, axis=0)
    for image in stack:
        image /= lamp_factor(image, middle)
    mean, spread = stack.mean(axis=0), stack.std(axis=0)
    moving = spread > np.maximum(_LEAST_CHANGE, _NOISE_FACTOR * noise_spread(mean, spread))
    side = min(moving.shape)
    # Opening first drops single pixels that noise alone lifts above the threshold, before closing joins them.
    moving = ellipse_close_open(moving, close_px=0, open_px=2)
    moving = ellipse_close_open(moving, close_px=_odd(_CLOSING_FRACTION * side), open_px=3)
    moving = touching(moving, moving, min_area_px=round(_LEAST_AREA_FRACTION * moving.size))
    return dilate(moving, _odd(2 * _MARGIN_FRACTION * side))


def lamp_factor(image: Float[np.ndarray, "h w"], middle: Float[np.ndarray, "h w"]) -> float:
    """Brightness of the image over that of the median image: the median over the pixels that are not dark."""
    bright = middle >= np.median(middle)
    return float(np.median(image[bright] / np.maximum(middle[bright], 1.0)))


def noise_spread(mean: Float[np.ndarray, "h w"], spread: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Standard deviation over the frames due to noise alone, at each pixel by its brightness.

    Noise does not fall with brightness, so a class in which too little stands still takes that of a brighter one.
    """
    edges = np.quantile(mean, np.linspace(0.0, 1.0, _BRIGHTNESS_CLASSES + 1)[1:-1])
    brightness_class = np.searchsorted(edges, mean)
    lower = np.full(_BRIGHTNESS_CLASSES, np.inf)
    for k in np.unique(brightness_class):
        lower[k] = np.quantile(spread[brightness_class == k], _STILL_FRACTION)
    return np.minimum.accumulate(lower[::-1])[::-1][brightness_class]


def _odd(size: float) -> int:
    return 2 * round(size / 2) + 1
