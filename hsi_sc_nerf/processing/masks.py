"""Foreground masks: the object on the container, without chamber, container, disc and markers.

Plant tissue changes its reflectance strongly between 400 and 1000 nm (pigments, red edge), while Teflon, plastic,
paper and ink are nearly flat: the spread of a pixel's spectrum tells them apart. What prints and labels may still
feign is removed by geometry: the object stands on the container's lid. In shade the spread falls with the light, so
the object's dark parts (its underside, next to the container) are told by spread relative to brightness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.morphology import dilate, ellipse_close_open, fill_holes, largest_component, touching
from hsi_sc_nerf.packed.dataset import Container

_HISTOGRAM_BINS = 512
# Shares of the object's median brightness: a background that lets shaded parts be told, and the least light to do it.
_BRIGHT_BACKGROUND = 0.5
_DARKEST = 0.1


@dataclass(frozen=True)
class MaskConfig:
    """Settings of the foreground masks."""

    spectral_bins: int = 24
    """Neighbouring bands are averaged into so many bins of equal width (or a few less) before their spread is taken,
    which quiets noise."""
    smoothing_px: float = 0.5
    """Standard deviation of the Gaussian that smooths the bins over neighbouring pixels, pixels; 0 for none."""
    threshold: float | None = None
    """Spread of reflectance over the bins from which a pixel is the object's. Found over all frames if not given."""
    weak_share: float = 0.5
    """Parts that stick out of the object (a stem) are added from this share of the threshold; 1 for none."""
    shaded_share: float | None = 0.4
    """Pixels darker than the object and next to it are added where their spread relative to their brightness is more
    than this share of the object's; none for none. Not done before a dark background, where noise feigns spread."""
    min_contrast: float = 0.03
    """Least difference between the mean spreads of object and background that is believed."""
    morphology_fraction: float = 0.01
    """Diameter of the ellipse that closes gaps, as a share of the image's shorter side (3 pixels at least)."""
    overhang: float = 1.2
    """The object may reach beyond the container's lid up to this many times its radius."""


def bin_width(bands: int, spectral_bins: int) -> int:
    """How many neighbouring bands a bin averages, so that there are ``spectral_bins`` or fewer bins of one width."""
    return -(-bands // spectral_bins)


def foreground_score(
    binned: Float[np.ndarray, "bins lines samples"], smoothing_px: float = 0.5
) -> Float[np.ndarray, "lines samples"]:
    """Standard deviation over spectral bins of the (slightly smoothed) reflectance: 0 for a flat spectrum.

    Where a pixel is part object and part flat background the score is nearly its share times the object's score.
    """
    # Differences from the first bin, whose squares single precision holds: exactly 0 for a flat spectrum.
    first = _smoothed(binned[0], smoothing_px)
    difference, total, squares = np.empty_like(first), np.zeros_like(first), np.zeros_like(first)
    for image in binned[1:]:
        cv2.subtract(_smoothed(image, smoothing_px), first, dst=difference)
        cv2.accumulate(difference, total)
        cv2.accumulateSquare(difference, squares)
    total /= len(binned)
    return np.sqrt(np.maximum(squares / len(binned) - total**2, 0.0))


def brightness(
    binned: Float[np.ndarray, "bins lines samples"], smoothing_px: float = 0.5
) -> Float[np.ndarray, "lines samples"]:
    """Mean over spectral bins of the (slightly smoothed) reflectance."""
    return _smoothed(binned.mean(axis=0), smoothing_px)


def otsu_threshold(scores: Sequence[Float[np.ndarray, "lines samples"]]) -> tuple[float, float]:
    """Otsu's threshold over all frames together, and the contrast: the difference of the two classes' means.

    N. Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9 (1979). Scores are not
    negative. A contrast of 0 means that all scores are the same.
    """
    top = max(float(score.max()) for score in scores)
    if not top > 0.0:
        return 0.0, 0.0
    counts = sum(np.histogram(score, bins=_HISTOGRAM_BINS, range=(0.0, top))[0] for score in scores)
    edges = np.linspace(0.0, top, _HISTOGRAM_BINS + 1)
    weights = counts / np.sum(counts)
    below = np.cumsum(weights)[:-1]
    moment = np.cumsum(weights * (edges[:-1] + edges[1:]) / 2.0)
    split = (below > 0.0) & (below < 1.0)
    low = np.divide(moment[:-1], below, out=np.zeros_like(below), where=split)
    high = np.divide(moment[-1] - moment[:-1], 1.0 - below, out=np.zeros_like(below), where=split)
    between = below * (1.0 - below) * (high - low) ** 2
    # Empty bins between two clear classes tie: take the middle of the plateau.
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-9))
    middle = int(best[len(best) // 2])
    return float(edges[middle + 1]), float(high[middle] - low[middle])


def choose_threshold(scores: Sequence[Float[np.ndarray, "lines samples"]], config: MaskConfig) -> float:
    """The given threshold, or Otsu's where object and background are told apart.

    Raises:
        InputError: the spectra of object and background hardly differ.
    """
    if config.threshold is not None:
        return config.threshold
    threshold, contrast = otsu_threshold(scores)
    if contrast < config.min_contrast:
        raise InputError(
            f"no object can be told from the background in these frames (contrast {contrast:.3f}); check that the "
            "object is in view, or give a threshold with --masks.threshold."
        )
    return threshold


def above_lid(
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    camera_to_world: Float[np.ndarray, "4 4"],
    container: Container,
    overhang: float = 1.2,
) -> Bool[np.ndarray, "h w"]:
    """Pixels that can show something standing on the lid: their rays pass over it before they meet the container.

    "Over it" is the upright cylinder around the axis with ``overhang`` times the container's radius, from the lid
    upwards.
    """
    origin, directions = pixel_rays(intrinsics, camera_to_world, _undistorted_pixels(intrinsics, distortion))
    radius = container.diameter_m / 2.0
    above = _intersect(
        _cylinder_interval(origin, directions, overhang * radius),
        _slab_interval(origin, directions, container.height_m, np.inf),
    )
    solid = _intersect(
        _cylinder_interval(origin, directions, radius), _slab_interval(origin, directions, 0.0, container.height_m)
    )
    blocked = (solid[0] < solid[1]) & (solid[0] <= above[0])
    return (above[0] < above[1]) & ~blocked


def foreground_mask(
    score: Float[np.ndarray, "lines samples"],
    threshold: float,
    *,
    allowed: Bool[np.ndarray, "lines samples"] | None = None,
    weak_share: float = 0.5,
    morphology_fraction: float = 0.01,
) -> Bool[np.ndarray, "lines samples"]:
    """Pixels above the threshold (inside ``allowed``): gaps closed, largest component, holes filled.

    Parts above ``weak_share`` of the threshold that stick out of the object (a woody stem) are added; its rim, where
    pixels are part background, does not grow. A share of 1 adds nothing.
    """
    allowed = np.ones(score.shape, dtype=bool) if allowed is None else allowed
    closing_px = max(3, round(morphology_fraction * min(score.shape)))
    closed = ellipse_close_open((score > threshold) & allowed, close_px=closing_px, open_px=0)
    body = fill_holes(largest_component(closed))
    weak = (score > weak_share * threshold) & allowed
    rim = dilate(body, closing_px)
    sticking_out = touching(weak & ~rim, dilate(rim, 3), min_area_px=closing_px + 1)
    return fill_holes(body | sticking_out | (weak & dilate(sticking_out, closing_px)))


def shaded_parts(
    body: Bool[np.ndarray, "lines samples"],
    score: Float[np.ndarray, "lines samples"],
    brightness: Float[np.ndarray, "lines samples"],
    *,
    allowed: Bool[np.ndarray, "lines samples"] | None = None,
    share: float = 0.4,
) -> Bool[np.ndarray, "lines samples"]:
    """Pixels (inside ``allowed``) that belong to ``body`` but get less light than most of it.

    Illumination scales spread and brightness alike, their ratio stays the material's. A pixel that is part white
    background has less of it than its share of object: the default of 0.4 is reached by about 60 % object. There are
    none where the background is less than half as bright as the body.
    """
    empty = np.zeros_like(body)
    if not body.any() or body.all():
        return empty
    typical = float(np.median(brightness[body]))
    if np.median(brightness[~body]) < _BRIGHT_BACKGROUND * typical:
        return empty
    relative = score / np.maximum(brightness, _DARKEST * typical)
    shaded = (relative > share * np.median(relative[body])) & (brightness < typical) & ~body
    if allowed is not None:
        shaded &= allowed
    return touching(shaded, dilate(body, 3), min_area_px=1)


def _smoothed(image: Float[np.ndarray, "lines samples"], sigma_px: float) -> Float[np.ndarray, "lines samples"]:
    return cv2.GaussianBlur(image, (0, 0), sigma_px) if sigma_px > 0.0 else image


_Interval = tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]


def _undistorted_pixels(
    intrinsics: PinholeIntrinsics, distortion: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "h w 2"]:
    """Where each pixel's centre would be without lens distortion."""
    x, y = np.meshgrid(np.arange(intrinsics.w) + 0.5, np.arange(intrinsics.h) + 0.5)
    pixels = np.stack([x, y], axis=-1)
    if not np.any(distortion):
        return pixels
    matrix = intrinsics.matrix()
    return cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, np.asarray(distortion), P=matrix).reshape(
        pixels.shape
    )


def _cylinder_interval(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"], radius: float
) -> _Interval:
    """Ray parameters between which x² + y² <= radius² (an empty interval for a miss)."""
    a = np.maximum(np.sum(directions[..., :2] ** 2, axis=-1), 1e-18)
    b = np.sum(directions[..., :2] * origin[:2], axis=-1)
    discriminant = b**2 - a * (np.sum(origin[:2] ** 2) - radius**2)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    hit = discriminant > 0.0
    return np.where(hit, (-b - root) / a, np.inf), np.where(hit, (-b + root) / a, -np.inf)


def _slab_interval(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"], low: float, high: float
) -> _Interval:
    """Ray parameters between which low <= z <= high."""
    slope = np.where(np.abs(directions[..., 2]) < 1e-12, 1e-12, directions[..., 2])
    first, second = (low - origin[2]) / slope, (high - origin[2]) / slope
    return np.minimum(first, second), np.maximum(first, second)


def _intersect(a: _Interval, b: _Interval) -> _Interval:
    """The common part of two intervals, in front of the camera."""
    return np.maximum(np.maximum(a[0], b[0]), 0.0), np.minimum(a[1], b[1])
