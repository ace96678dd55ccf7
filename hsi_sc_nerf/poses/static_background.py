"""What moves in a session: structure from motion must not see the chamber, which stands still with the camera.

Turning the object before a fixed camera gives the images of a camera that orbits a fixed object only where the
background carries no features. Where it does, structure from motion believes the background, and finds a camera that
stands still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf.morphology import dilate, ellipse_close_open, touching

# Brightness classes of equal size in which the noise is measured: photon noise grows with the light.
_BRIGHTNESS_CLASSES = 16
# Of a class at least this share of pixels stands still, or else a brighter class tells its noise.
_STILL_SHARE = 0.1


@dataclass(frozen=True)
class StaticBackgroundConfig:
    """How pixels that move are told from pixels that stand still."""

    smoothing_px: float = 1.0
    """Standard deviation of the Gaussian that quiets the images' noise, pixels."""
    noise_factor: float = 3.0
    """A pixel moves if its brightness varies over the frames by more than so many times the noise's spread."""
    least_change: float = 1.0
    """And by more than this standard deviation, gray levels: rounding to 8 bits alone makes less."""
    closing_share: float = 0.04
    """Gaps in what moves up to this share of the image's shorter side are closed: even skin between its patterns."""
    margin_share: float = 0.002
    """What moves is widened by this share of the image's shorter side. Little, for the wall begins right there."""
    least_area_share: float = 0.0005
    """Moving specks below this share of the image's area are left out: the jagged rim of an even disc."""


def moving_pixels(
    images: Sequence[UInt8[np.ndarray, "h w"]], config: StaticBackgroundConfig | None = None
) -> Bool[np.ndarray, "h w"]:
    """Pixels that show something that turns in some of the frames.

    The lamps' drift, one factor a frame, is taken out first. Of what turns only what changes the picture is found: an
    even disc stands still, and so does the outline of a body of revolution.

    Args:
        images: one gray image a frame, all of one size, linear in reflectance.
        config: thresholds; the defaults suit 8-bit images of a calibrated session.
    """
    config = config or StaticBackgroundConfig()
    stack = np.stack([cv2.GaussianBlur(i.astype(np.float32), (0, 0), config.smoothing_px) for i in images])
    middle = np.median(stack, axis=0)
    for image in stack:
        image /= lamp_factor(image, middle)
    mean, spread = stack.mean(axis=0), stack.std(axis=0)
    moving = spread > np.maximum(config.least_change, config.noise_factor * noise_spread(mean, spread))
    side = min(moving.shape)
    # Opening first drops single pixels that noise alone lifts above the threshold, before closing joins them.
    moving = ellipse_close_open(moving, close_px=0, open_px=2)
    moving = ellipse_close_open(moving, close_px=_odd(config.closing_share * side), open_px=3)
    moving = touching(moving, moving, min_area_px=round(config.least_area_share * moving.size))
    return dilate(moving, _odd(2 * config.margin_share * side))


def lamp_factor(image: Float[np.ndarray, "h w"], middle: Float[np.ndarray, "h w"]) -> float:
    """By what factor the image is brighter than the middle one: the median over the pixels that are not dark."""
    bright = middle >= np.median(middle)
    return float(np.median(image[bright] / np.maximum(middle[bright], 1.0)))


def noise_spread(mean: Float[np.ndarray, "h w"], spread: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Standard deviation over the frames that noise alone makes at each pixel, by its brightness.

    Noise does not fall with brightness, so a class in which too little stands still takes that of a brighter one.
    """
    edges = np.quantile(mean, np.linspace(0.0, 1.0, _BRIGHTNESS_CLASSES + 1)[1:-1])
    brightness_class = np.searchsorted(edges, mean)
    lower = np.full(_BRIGHTNESS_CLASSES, np.inf)
    for k in np.unique(brightness_class):
        lower[k] = np.quantile(spread[brightness_class == k], _STILL_SHARE)
    return np.minimum.accumulate(lower[::-1])[::-1][brightness_class]


def _odd(size: float) -> int:
    return 2 * round(size / 2) + 1
