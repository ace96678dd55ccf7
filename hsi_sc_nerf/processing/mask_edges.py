"""The edge of a mask: parts of the object in shade, and mixed pixels, which count if half of them is the object.

Light scales foreground score and brightness alike, so their ratio tells the material in any light. The score of a
mixed pixel is its fraction of object times the score of the object beside it, whatever the background is.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, binary_erosion

from hsi_sc_nerf.morphology import dilate, fill_holes, touching

NEARBY_PX = 2.0
"""Standard deviation of the Gaussian weights with which what is next to a pixel is averaged."""
HALF_COVERED = 0.5
"""Score of a pixel that is half object, relative to the object beside it."""
GROWTH_PX = 2
"""Pixels by which the edge may move outwards: gaps between the global threshold and half of a low local score."""
# Fractions of the object's median brightness: a background brighter than the first makes all mixed pixels bright;
# darker pixels than the second have noisy ratios.
_BRIGHT_BACKGROUND = 0.9
_MIN_BRIGHTNESS = 0.1
_FACES = np.ones((3, 3), bool)


def shaded_parts(
    body: Bool[np.ndarray, "h w"],
    score: Float[np.ndarray, "h w"],
    brightness: Float[np.ndarray, "h w"],
    *,
    region: Bool[np.ndarray, "h w"] | None = None,
    fraction: float = 0.5,
) -> Bool[np.ndarray, "h w"]:
    """Pixels next to ``body`` that belong to it but get less light than most of it.

    In front of a bright background the ratio of score and brightness of a mixed pixel is at most its fraction of
    object times the object's ratio. In front of a dark one even a small fraction of object has the object's ratio.

    Args:
        body: the object's mask so far.
        score: of one frame.
        brightness: of one frame.
        region: pixels that may be the object's; all if not given.
        fraction: of the object's median ratio of score and brightness, from which a pixel belongs to it.

    Returns:
        The pixels to add, none where the background, of the frame and beside the pixel, is dark.
    """
    if not body.any() or body.all():
        return np.zeros_like(body)
    typical = float(np.median(brightness[body]))
    relative = score / np.maximum(brightness, _MIN_BRIGHTNESS * typical)
    shaded = (relative > fraction * np.median(relative[body])) & (brightness < typical) & ~body
    if region is not None:
        shaded &= region
    shaded &= _bright_behind(brightness, body, ~(body | shaded))
    return touching(shaded, dilate(body, 3), min_area_px=1)


def at_half_coverage(
    mask: Bool[np.ndarray, "h w"],
    score: Float[np.ndarray, "h w"],
    brightness: Float[np.ndarray, "h w"],
    may_grow: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """The mask with its edge where pixels are half object, judged by the score of the object beside them.

    Args:
        mask: of one frame.
        score: of one frame.
        brightness: of one frame. A pixel in shade is kept: its score is low because it is dark.
        may_grow: pixels that may be added.

    Returns:
        The mask, at most `GROWTH_PX` larger and one pixel smaller. Parts too thin to have an inside keep their edge.
    """
    if not mask.any():
        return mask
    for _ in range(GROWTH_PX):
        inside = _nearby(score, binary_erosion(mask, _FACES))
        rim = binary_dilation(mask, _FACES) & ~mask & may_grow
        mask = fill_holes(mask | (rim & (inside > 0.0) & (score > HALF_COVERED * inside)))
    core = binary_erosion(mask, _FACES)
    relative = score / np.maximum(brightness, 1e-3)
    in_shade = (relative >= HALF_COVERED * _nearby(relative, core)) & _bright_behind(brightness, mask, ~mask)
    too_little = (score < HALF_COVERED * _nearby(score, core)) & ~in_shade & ~core
    return fill_holes(mask & ~too_little)


def _bright_behind(
    brightness: Float[np.ndarray, "h w"], body: Bool[np.ndarray, "h w"], background: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that a mixture with the background beside them would not make darker; all before a bright background."""
    if background.any() and np.median(brightness[~body]) >= _BRIGHT_BACKGROUND * np.median(brightness[body]):
        return np.ones_like(body)
    return _nearby(brightness, background) >= brightness


def _nearby(image: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Weighted mean over the chosen pixels near each pixel; 0 where none is near."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), NEARBY_PX)
    total = cv2.GaussianBlur(np.where(where, image, 0.0).astype(np.float32), (0, 0), NEARBY_PX)
    return np.where(weight > 1e-4, total / np.maximum(weight, 1e-4), 0.0)
