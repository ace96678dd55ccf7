"""Edges of foreground masks, decided locally: parts in shade, and mixed pixels that the object covers by half.

Light scales foreground score and brightness by the same factor, so their ratio depends on the material alone. The
score of a mixed pixel lies between those of the object and of the background beside it, by its fraction of object.
That of the background is not 0 where the object's light falls on it, as on the lid beside the base. That of the
object falls towards its edge where it is lit from the camera's side, or mirrors the chamber.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, binary_erosion

from hsi_sc_nerf.morphology import dilate, fill_holes, touching

NEARBY_PX, BESIDE_PX = 2.0, 1.0
"""Standard deviations of the Gaussian weights of averages over a pixel's neighbourhood, and over what is beside
shaded parts, where the light changes within few pixels."""
RING_PX, GLOSS_RINGS = 20, 6
"""Fewest pixels of a ring inside the edge that is measured, and the rings that tell gloss."""
LEAST_AT_EDGE, LEAST_GLOSSY = 0.5, 0.4
"""Smallest score at the edge, relative to the object near it: by shade, and by gloss."""
RING_VARIANCE = 1e-4
"""Added to the variance of the mirrored fraction over the rings: rings differ by 0.02 for other reasons, which would
pass for gloss on small objects, whose rings mirror hardly anything."""
MOST_LEFT = 0.8
"""A matte skin in shade before a bright chamber seems to keep 0.83 to 1 of its score; gloss leaves less."""
GLOSS_ROUNDS, GLOSS_CHANGE = 4, 0.03
"""Times that gloss is measured and the edges are moved; the change of what gloss leaves below which they stay."""
GROWTH_PX = 2
"""Pixels by which the edge may move outwards where the local score is low and the global threshold too high."""
# Fractions of the object's median brightness: a background brighter than the first makes all mixed pixels bright;
# darker pixels than the second have noisy ratios.
_BRIGHT_BACKGROUND = 0.9
_MIN_BRIGHTNESS = 0.1
# Pixels with more than this fraction of the object's median ratio of score and brightness are all object.
_SURE = 0.8
_FACES = np.ones((3, 3), bool)


class GrownMask(NamedTuple):
    """A frame's mask with parts in shade, whose edge is not yet decided: arguments of `at_half_coverage`."""

    mask: Bool[np.ndarray, "h w"]
    score: Float[np.ndarray, "h w"]
    brightness: Float[np.ndarray, "h w"]
    may_grow: Bool[np.ndarray, "h w"]


def half_covered_masks(frames: Sequence[GrownMask]) -> list[Bool[np.ndarray, "h w"]]:
    """The masks of all frames with their edges where pixels are half object.

    The skin has one gloss in all frames. Masks that end where it mirrors the chamber show it only in part, so it is
    measured again on the larger ones.
    """
    masks, gloss_leaves = [frame.mask for frame in frames], np.inf
    for _ in range(GLOSS_ROUNDS):
        found = [glossy_edge(mask, frame.score, frame.brightness) for mask, frame in zip(masks, frames, strict=True)]
        before, gloss_leaves = gloss_leaves, float(np.nanmedian(found)) if np.isfinite(found).any() else 1.0
        if gloss_leaves > MOST_LEFT:
            gloss_leaves = 1.0
        if abs(gloss_leaves - before) < GLOSS_CHANGE:
            break
        masks = [at_half_coverage(*frame, gloss_leaves) for frame in frames]
    return masks


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
        region: pixels that may be the object's; all if not given.
        fraction: of the way from the ratio of score and brightness beside a pixel, where nothing can be the object's,
            to the object's, from which a pixel belongs to it.

    Returns:
        The pixels to add, none where the background, of the frame and beside the pixel, is dark.
    """
    if not body.any() or body.all():
        return np.zeros_like(body)
    typical = float(np.median(brightness[body]))
    relative = score / np.maximum(brightness, _MIN_BRIGHTNESS * typical)
    median = np.median(relative[body])
    # Light from the object itself raises its ratio in its shade, and that of the lid close to it.
    inside = np.maximum(_nearby(relative, body | (relative > _SURE * median)), median)
    least = fraction * median
    for _ in range(2):
        outside = _nearby(relative, ~(body | (relative > least)), BESIDE_PX)
        least = fraction * inside + (1.0 - min(fraction, 1.0)) * outside
    shaded = (relative > least) & (brightness < typical) & ~body
    if region is not None:
        shaded &= region
    shaded &= _bright_behind(brightness, body, ~(body | shaded))
    return touching(shaded, dilate(body, 3), min_area_px=1)


def at_half_coverage(
    mask: Bool[np.ndarray, "h w"],
    score: Float[np.ndarray, "h w"],
    brightness: Float[np.ndarray, "h w"],
    may_grow: Bool[np.ndarray, "h w"],
    gloss_leaves: float = 1.0,
) -> Bool[np.ndarray, "h w"]:
    """The mask with its edge where pixels are half object, judged by the score of the object beside them.

    Args:
        brightness: brightness of one frame. A pixel in shade is kept: its score is low because it is dark.
        may_grow: pixels that may be added.
        gloss_leaves: fraction of the object's score that gloss leaves at its edge (`glossy_edge`).

    Returns:
        The mask, at most `GROWTH_PX` larger and one pixel smaller. Parts too thin to have an inside keep their edge.
    """
    if not mask.any():
        return mask
    for _ in range(GROWTH_PX):
        half = _half_covered(score, mask, gloss_leaves)
        rim = binary_dilation(mask, _FACES) & ~mask & may_grow
        mask = fill_holes(mask | (rim & (half > 0.0) & (score > half)))
    core = binary_erosion(mask, _FACES)
    relative = score / np.maximum(brightness, 1e-3)
    in_shade = (relative >= _half_covered(relative, mask, gloss_leaves)) & _bright_behind(brightness, mask, ~mask)
    edge = binary_dilation(core, _FACES) & ~core
    return fill_holes(mask & ~((score < _half_covered(score, mask, gloss_leaves)) & ~in_shade & edge))


def _half_covered(
    image: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], gloss_leaves: float
) -> Float[np.ndarray, "h w"]:
    """What pixels that are half object and half background would have, by those near them; 0 far from the object."""
    core = binary_erosion(mask, _FACES)
    inside = _nearby(image, core)
    shade_leaves = _shaded_edge(np.divide(image, inside, out=np.ones_like(inside), where=inside > 0.0), core)
    inside *= min(shade_leaves, gloss_leaves)
    outside = _nearby(image, ~binary_dilation(mask, _FACES))
    return (inside + np.minimum(outside, inside)) / 2.0


def _shaded_edge(relative: Float[np.ndarray, "h w"], core: Bool[np.ndarray, "h w"]) -> float:
    """The object's score at its edge, relative to that near it, by a parabola through the three outermost rings."""
    rings = []
    for _ in range(3):
        inner = binary_erosion(core, _FACES)
        rings.append(relative[core & ~inner])
        core = inner
    if min(map(len, rings)) < RING_PX:
        return 1.0
    first, second, third = map(np.median, rings)
    return float(np.clip(3.0 * first - 3.0 * second + third, LEAST_AT_EDGE, 1.0))


def glossy_edge(
    mask: Bool[np.ndarray, "h w"], score: Float[np.ndarray, "h w"], brightness: Float[np.ndarray, "h w"]
) -> float:
    """What gloss leaves of an object's score within half a pixel of its outline, relative to that near its edge.

    A clear coat mirrors the chamber, which has no score, the more, the flatter it is looked at (Schlick, An
    Inexpensive BRDF Model for Physically-based Rendering, 1994). So the score is taken as a linear function of the
    mirrored fraction, fitted to the rings of pixels inside and carried on to the outline, and so is its ratio to the
    brightness. Both fall by gloss. In shade the score alone falls, and beside what is bright, of which each pixel
    has a little, the ratio alone. The larger counts.

    Returns:
        Between `LEAST_GLOSSY` and 1; not a number for an object of less than three rings.
    """
    core = binary_erosion(mask, _FACES)
    depth_px = cv2.distanceTransform(core.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) + 0.5
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    radius_px = 2.0 * mask.sum() / max(1.0, sum(cv2.arcLength(outline, closed=True) for outline in outlines))
    rings = [core & (np.abs(depth_px - 1.5 - number) <= 0.5) for number in range(GLOSS_RINGS)]
    rings = list(takewhile(lambda ring: ring.sum() >= RING_PX, rings))
    if len(rings) < 3:
        return np.nan
    fractions = [_mirrored_fraction(depth_px[ring], radius_px) for ring in rings]
    at_outline = _mirrored_fraction(np.linspace(0.01, 0.5, 50), radius_px)
    left = []
    for image in (score, score / np.maximum(brightness, 1e-3)):
        near = max(float(np.median(_nearby(image, core)[mask & ~core])), 1e-9)
        medians = [float(np.median(image[ring])) / near for ring in rings]
        slope = np.cov(fractions, medians, bias=True)[0, 1] / (np.var(fractions) + RING_VARIANCE)
        left.append(np.mean(medians) + slope * (at_outline - np.mean(fractions)))
    return float(np.clip(max(left), LEAST_GLOSSY, 1.0))


def _mirrored_fraction(depth_px: Float[np.ndarray, "n"], radius_px: float) -> float:
    """Mean of Schlick's (1 - cos)^5 on a ball, so many pixels inside of its outline."""
    return float(np.mean((1.0 - np.minimum(np.sqrt(2.0 * depth_px / radius_px), 1.0)) ** 5))


def _bright_behind(
    brightness: Float[np.ndarray, "h w"], body: Bool[np.ndarray, "h w"], background: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that a mixture with the background beside them would not make darker; all before a bright background."""
    if background.any() and np.median(brightness[~body]) >= _BRIGHT_BACKGROUND * np.median(brightness[body]):
        return np.ones_like(body)
    return _nearby(brightness, background) >= brightness


def _nearby(
    image: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"], deviation_px: float = NEARBY_PX
) -> Float[np.ndarray, "h w"]:
    """Weighted mean over the chosen pixels near each pixel; 0 where none is near."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), deviation_px)
    total = cv2.GaussianBlur(np.where(where, image, 0.0).astype(np.float32), (0, 0), deviation_px)
    return np.where(weight > 1e-4, total / np.maximum(weight, 1e-4), 0.0)
