"""Foreground masks: the object on its container, without chamber, container, disc and markers.

Otsu's threshold separates the object's foreground scores from the others. What lies below the container's lid is
excluded by geometry. The edge is decided locally: parts of the object in shade belong to it, and so do mixed pixels
of which the object covers at least half. Light scales foreground score and brightness by the same factor, so their
ratio depends on the material alone. The score of a mixed pixel is its fraction of object times the score of the
object beside it, whatever the background is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_of, pixel_rays
from hsi_sc_nerf.morphology import components, dilate, draw_outline, ellipse_close_open, fill_holes, touching
from hsi_sc_nerf.packed.dataset import Container
from hsi_sc_nerf.processing.foreground_score import background_subspace, foreground_score, otsu_threshold
from hsi_sc_nerf.settings_file import between

MIN_CONTRAST = 0.005
"""Smallest difference between the mean scores of object and background that Otsu's threshold is accepted with."""
MIN_SEPARATION = 6.0
"""Smallest such difference as a multiple of the background's scatter; noise alone has 3 to 5."""
LID_MIDDLE = 0.3
"""Radius of the middle of the container's lid, of the lid's."""
LEAST_PIECE = 0.1
"""Smallest area of a separate piece of the object, of the largest piece's; what is smaller is noise."""
CLOSING_FRACTION = 0.01
"""Diameter of the ellipse that closes gaps, as a fraction of the image's shorter side (3 pixels at least)."""

COLUMNS, TILE_PX = 6, 240
"""Frames in a row of the contact sheet, and the width of each."""
NEARBY_PX = 2.0
"""Standard deviation of the Gaussian weights of averages over a pixel's neighbourhood."""
HALF_COVERED = 0.5
"""Score of a pixel that is half object, relative to the object beside it."""
GROWTH_PX = 2
"""Pixels by which the edge may move outwards where the local score is low and the global threshold too high."""
# Fractions of the object's median brightness: a background brighter than the first makes all mixed pixels bright;
# darker pixels than the second have noisy ratios.
_BRIGHT_BACKGROUND = 0.9
_MIN_BRIGHTNESS = 0.1
_FACES = np.ones((3, 3), bool)


@dataclass(frozen=True)
class MaskConfig:
    """Settings of the foreground masks."""

    threshold: float | None = between(1e-6, 10.0, default=None)
    """Foreground score (the part of the reflectance that the background's spectra cannot explain, RMS over the
    spectrum) from which a pixel is the object's. Otsu's threshold over all frames if not given."""
    weak_fraction: float = between(0.0, 1.0, default=0.5)
    """Parts that stick out of the object (a stem) are added from this fraction of the threshold; 1 for none."""
    shaded_fraction: float | None = between(0.0, 10.0, default=0.5)
    """Pixels next to the object and darker than it are added where their score relative to their brightness is more
    than this fraction of the object's; None for none. Not applied next to even darker pixels."""
    overhang: float | None = between(0.01, 100.0, default=None)
    """The object may reach beyond the container's lid up to this multiple of the lid's radius. 1.2 if not given, or
    1.6 or 2.4 where the object is cut off otherwise."""
    pieces: int = between(1, 1000, default=1)
    """The object consists of up to so many pieces that are apart from each other (two berries, some grains). All of
    them are reconstructed together."""


def foreground_masks(
    bins: Sequence[Float[np.ndarray, "bins h w"]],
    config: MaskConfig,
    regions: Bool[np.ndarray, "frames h w"] | None = None,
) -> tuple[Bool[np.ndarray, "frames h w"], Bool[np.ndarray, "frames"]]:
    """Masks of the object in all frames, with one threshold, and which frames show a piece that they leave out.

    Args:
        regions: pixels of each frame that may be the object's (`above_lid`); all if not given.

    Raises:
        InputError: the spectra of object and background hardly differ.

    Example:
        >>> masks, left_out = foreground_masks([smoothed_bins(binned)], MaskConfig())  # binned: (24, 512, 512)
        >>> masks.shape, left_out
        ((1, 512, 512), array([False]))
    """
    background = background_subspace(bins, regions)
    scores = [foreground_score(image, background) for image in bins]
    threshold = select_threshold(scores) if config.threshold is None else config.threshold
    lowest = _background_level(scores, threshold)
    weak_fraction = max(config.weak_fraction, min(1.0, lowest / threshold))
    masks, left_out = [], []
    for index, score in enumerate(scores):
        region = np.ones(score.shape, bool) if regions is None else regions[index]
        pieces = pieces_above(score, threshold, region)
        left_out.append(len(pieces) > config.pieces)
        mask = foreground_mask(score, threshold, pieces[: config.pieces], region=region, weak_fraction=weak_fraction)
        brightness = bins[index].mean(axis=0, dtype=np.float32)
        may_grow = region & (score > lowest)
        if config.shaded_fraction is not None:
            shaded = shaded_parts(mask, score, brightness, region=may_grow, fraction=config.shaded_fraction)
            mask = fill_holes(mask | shaded)
        masks.append(at_half_coverage(mask, score, brightness, may_grow))
    return np.stack(masks), np.array(left_out)


def _background_level(scores: Sequence[Float[np.ndarray, "h w"]], threshold: float) -> float:
    """Score that the background hardly exceeds: six standard deviations over its median, both robust."""
    low = np.concatenate([score[score <= threshold] for score in scores])
    if len(low) == 0:
        return 0.0
    return float(np.median(low) + 6.0 * median_abs_deviation(low, scale="normal"))


def select_threshold(scores: Sequence[Float[np.ndarray, "h w"]]) -> float:
    """Otsu's threshold, if it separates object and background by `MIN_CONTRAST` and `MIN_SEPARATION`.

    Raises:
        InputError: the spectra of object and background hardly differ.
    """
    threshold, contrast, separation = otsu_threshold(scores)
    if contrast < MIN_CONTRAST or separation < MIN_SEPARATION:
        raise InputError(
            f"no object stands out from the background in these frames (contrast {contrast:.3f}); check that the "
            "object is in view, or give a threshold with --masks.threshold."
        )
    return threshold


def pieces_above(
    score: Float[np.ndarray, "h w"], threshold: float, region: Bool[np.ndarray, "h w"]
) -> list[Bool[np.ndarray, "h w"]]:
    """The connected pieces above the threshold, with gaps closed and holes filled, the largest first."""
    closed = ellipse_close_open((score > threshold) & region, close_px=_closing_px(score), open_px=0)
    return [fill_holes(piece) for piece in components(closed, LEAST_PIECE)]


def foreground_mask(
    score: Float[np.ndarray, "h w"],
    threshold: float,
    pieces: Sequence[Bool[np.ndarray, "h w"]],
    *,
    region: Bool[np.ndarray, "h w"],
    weak_fraction: float = 0.5,
) -> Bool[np.ndarray, "h w"]:
    """The pieces, with thin parts that stick out of them (a woody stem). Their edges, where pixels are mixed, stay.

    Args:
        pieces: pieces of the object (`pieces_above`).
        region: pixels that may be the object's.
        weak_fraction: thin parts are added from this fraction of the threshold on; 1 for none.
    """
    closing_px = _closing_px(score)
    body = np.logical_or.reduce([np.zeros(score.shape, bool), *pieces])
    weak = (score > weak_fraction * threshold) & region
    edge = dilate(body, closing_px)
    sticking_out = touching(weak & ~edge, dilate(edge, 3), min_area_px=closing_px + 1)
    return fill_holes(body | sticking_out | (weak & dilate(sticking_out, closing_px)))


def _closing_px(image: Float[np.ndarray, "h w"]) -> int:
    return max(3, round(CLOSING_FRACTION * min(image.shape))) | 1  # odd


def above_lid(
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    camera_to_world: Float[np.ndarray, "4 4"],
    container: Container,
    overhang: float,
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose rays pass through the space above the container's lid before they meet the container.

    Args:
        distortion: k1, k2, p1, p2 (OpenCV).
        camera_to_world: pose in the object frame, OpenGL axes, metres.
        container: upright cylinder about the z axis, from z = 0 up.
        overhang: the space above the lid is a cylinder of this multiple of the container's radius.
    """
    x, y = np.meshgrid(np.arange(intrinsics.w) + 0.5, np.arange(intrinsics.h) + 0.5)
    pixels = np.stack([x, y], axis=-1)
    if np.any(distortion):
        matrix = intrinsics.matrix()
        pixels = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, distortion, P=matrix).reshape(pixels.shape)
    origin, directions = pixel_rays(intrinsics, camera_to_world, pixels)
    radius, height = container.diameter_m / 2.0, container.height_m
    above, above_end = _cylinder_interval(origin, directions, overhang * radius, height, np.inf)
    solid, solid_end = _cylinder_interval(origin, directions, radius, 0.0, height)
    return (above < above_end) & ~((solid < solid_end) & (solid <= above))


def lid_middle(
    intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"], container: Container
) -> Bool[np.ndarray, "h w"]:
    """Pixels that see the middle of the empty lid, `LID_MIDDLE` of its radius; lens distortion is neglected.

    What stands on the axis hides them, and no wall is seen there.
    """
    ticks = np.linspace(-1.0, 1.0, 41) * LID_MIDDLE * container.diameter_m / 2.0
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(ticks, ticks))
    points = np.stack([x, y, np.full_like(x, container.height_m)], axis=-1)[np.hypot(x, y) <= ticks[-1]]
    return image_of(points, camera_to_world, intrinsics)


def mask_picture(
    path: Path,
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    names: Sequence[str],
) -> None:
    """Write a contact sheet: each frame's pseudo-RGB image with its mask's outline and its name.

    Raises:
        InputError: the operating system refused to write.
    """
    tiles = []
    for image, mask, name in zip(images, masks, names, strict=True):
        scale = TILE_PX / image.shape[1]
        size = (TILE_PX, round(image.shape[0] * scale))
        interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
        small = cv2.resize(np.ascontiguousarray(image), size, interpolation=interpolation)
        tile = draw_outline(small, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
        tiles.append(tile)
    blank = np.full_like(tiles[0], 255)
    rows = [tiles[i : i + COLUMNS] for i in range(0, len(tiles), COLUMNS)]
    rows[-1] += [blank] * (len(rows[0]) - len(rows[-1]))
    write_png(path, np.concatenate([np.concatenate(row, axis=1) for row in rows]))


def _cylinder_interval(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"], radius: float, low: float, high: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Ray parameters, 0 or more, between which x² + y² <= radius² and low <= z <= high; begin > end for a miss."""
    a = np.maximum(np.sum(directions[..., :2] ** 2, axis=-1), 1e-18)
    b = np.sum(directions[..., :2] * origin[:2], axis=-1)
    discriminant = b**2 - a * (np.sum(origin[:2] ** 2) - radius**2)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    slope = np.where(np.abs(directions[..., 2]) < 1e-12, 1e-12, directions[..., 2])
    first, second = (low - origin[2]) / slope, (high - origin[2]) / slope
    begin = np.maximum(np.maximum((-b - root) / a, np.minimum(first, second)), 0.0)
    end = np.minimum((-b + root) / a, np.maximum(first, second))
    return np.where(discriminant > 0.0, begin, np.inf), end


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
        fraction: fraction of the object's median ratio of score and brightness, from which a pixel belongs to it.

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
        brightness: brightness of one frame. A pixel in shade is kept: its score is low because it is dark.
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
    edge = binary_dilation(core, _FACES) & ~core
    too_little = (score < HALF_COVERED * _nearby(score, core)) & ~in_shade & edge
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
