"""Foreground masks: the object on its container, without chamber, container, disc and markers.

Otsu's threshold separates the object's foreground scores from the others. What lies below the container's lid is
excluded by geometry. The edge is decided locally (`mask_edges`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.morphology import components, dilate, draw_outline, ellipse_close_open, fill_holes, touching
from hsi_sc_nerf.processing.foreground_score import background_subspace, foreground_score, otsu_threshold
from hsi_sc_nerf.processing.mask_edges import GrownMask, half_covered_masks, shaded_parts
from hsi_sc_nerf.settings_file import between

MIN_CONTRAST = 0.005
"""Smallest difference between the mean scores of object and background that Otsu's threshold is accepted with."""
MIN_SEPARATION = 6.0
"""Smallest such difference as a multiple of the background's scatter; noise alone has 3 to 5."""
LEAST_PIECE = 0.1
"""Smallest area of a separate piece of the object, of the largest piece's; what is smaller is noise."""
CLOSING_FRACTION = 0.01
"""Diameter of the ellipse that closes gaps, as a fraction of the image's shorter side (3 pixels at least)."""

COLUMNS, TILE_PX = 6, 240
"""Frames in a row of the contact sheet, and the width of each."""


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
    than this fraction of the way from that of what is beside them to the object's; None for none. Not applied next to
    even darker pixels."""
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
        regions: pixels of each frame that may be the object's (`lid_regions.above_lid`); all if not given.

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
    left_out, frames = [], []
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
        frames.append(GrownMask(mask, score, brightness, may_grow))
    return np.stack(half_covered_masks(frames)), np.array(left_out)


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
