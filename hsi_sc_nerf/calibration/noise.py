"""The noise of a reading, measured on a session's own dark and white cubes.

The variance of a reading is a line over its counts above dark, the photon transfer curve (Janesick, "Photon
Transfer", SPIE 2007): ``variance = read_noise^2 + counts_per_electron * counts``. The dark cube gives the read noise,
the white tarp the slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import stats

QUANTISATION_VARIANCE = 1.0 / 12.0
"""Of a count that was rounded, counts^2."""
MOST_TRIPLES = 64
"""Groups of three neighbouring lines of the tarp that are read: more would not make the slope any better."""
FEWEST_PIXELS = 100
"""Of the tarp, below which the slope is not measured."""
MOST_SATURATED = 0.01
"""A band is left out of the slope if more than this share of its elements reached saturation on the tarp."""
OUTLIER_PROBABILITY = 1e-4
"""Pixels and elements that noise alone would make so rarely are dirt or defects, and are left out."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variance of one reading.

    Attributes:
        read_noise: standard deviation of a reading without light, counts; its rounding is part of it.
        counts_per_electron: variance that light adds a count above dark: the slope of the photon transfer curve, the
            same for all elements of the detector.
        read_noise_measured: False where the dark cube tells nothing and the read noise is that of rounding alone.
        photon_noise_measured: False where the tarp tells nothing and the slope is 0.
    """

    read_noise: Float[np.ndarray, "bands"]
    counts_per_electron: float
    read_noise_measured: bool
    photon_noise_measured: bool

    def variance(self, above_dark: Float[np.ndarray, "*shape bands"]) -> Float[np.ndarray, "*shape bands"]:
        """Variance of readings, counts^2, from their counts above dark; negative counts (noise) count as 0."""
        return self.read_noise**2 + self.counts_per_electron * np.maximum(above_dark, 0.0)


def measure_noise(
    white: Num[np.ndarray, "lines samples bands"],
    region: Bool[np.ndarray, "lines samples"],
    dark: Num[np.ndarray, "dark_lines columns bands"] | None,
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
) -> NoiseModel:
    """The noise of a session's readings.

    Args:
        white: counts of the white tarp; a memory map is read in part only.
        region: where the image shows nothing but tarp, and all of it is data.
        dark: counts without light that belong to it; without any, the dark level is taken for 0.
        saturation_counts: counts from which a reading is saturated; None where nothing is.
        dead: detector elements that do not follow the light.
    """
    bands = white.shape[2]
    rounding = np.full(bands, np.sqrt(QUANTISATION_VARIANCE))
    measured = None if dark is None else read_noise(dark, None if dark.shape[1] != white.shape[1] else dead)
    of_readings = rounding if measured is None else np.maximum(measured, rounding)
    level = np.zeros((1, bands)) if dark is None else dark.mean(axis=0, dtype=np.float64)
    if len(level) != white.shape[1]:
        level = level.mean(axis=0, keepdims=True)
    slope = photon_transfer_slope(white, region, level, of_readings, saturation_counts=saturation_counts, dead=dead)
    return NoiseModel(of_readings, slope or 0.0, measured is not None, slope is not None)


def read_noise(
    dark: Num[np.ndarray, "dark_lines columns bands"], dead: Bool[np.ndarray, "columns bands"] | None = None
) -> Float[np.ndarray, "bands"] | None:
    """Standard deviation of a reading without light in each band, counts.

    Each element's variance is taken over the dark cube's lines; a band's is the mean over its elements without those
    that are dead or whose variance is not that of the others (elements that flicker or hang).

    Returns None where the cube has a single line, or lines that are all the same.
    """
    lines = len(dark)
    if lines < 2:
        return None
    variance = dark.var(axis=0, ddof=1, dtype=np.float64)
    if dead is not None:
        variance[dead] = np.nan
    if not np.nansum(variance) > 0.0:
        return None
    degrees = lines - 1
    middle = np.maximum(np.nanmedian(variance, axis=0), QUANTISATION_VARIANCE) / stats.chi2.median(degrees)
    low, high = (middle * stats.chi2.ppf(p, degrees) for p in (OUTLIER_PROBABILITY, 1.0 - OUTLIER_PROBABILITY))
    # Below the rounding's own variance an element is quiet by chance of where its level lies between two counts.
    usual = (variance <= high) & ((variance >= low) | (low <= QUANTISATION_VARIANCE))
    return np.sqrt(np.where(usual, variance, 0.0).sum(axis=0) / np.maximum(usual.sum(axis=0), 1))


def photon_transfer_slope(
    white: Num[np.ndarray, "lines samples bands"],
    region: Bool[np.ndarray, "lines samples"],
    dark: Float[np.ndarray, "columns bands"],
    read_noise: Float[np.ndarray, "bands"],
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
) -> float | None:
    """Slope of the photon transfer curve, counts per electron, from the tarp.

    Second differences between three neighbouring lines cancel what is even or a gradient over the tarp; their
    variance is 6 times a reading's. The part of a difference that has the white's own spectrum (a weave, a flickering
    lamp) is taken off as well, in each pixel, and so are pixels that still differ from the rest (dirt, edges). The
    bands, whose signals differ, then give the slope by weighted least squares through the read noise at no signal.

    Returns None where the region is too small or nothing in it is lit and unsaturated.
    """
    inside_all = region[:-2] & region[1:-1] & region[2:]
    centres = np.flatnonzero(inside_all.any(axis=1)) + 1
    if len(centres) > MOST_TRIPLES:
        centres = centres[np.linspace(0, len(centres) - 1, MOST_TRIPLES).round().astype(int)]
    inside = inside_all[centres - 1]
    if inside.sum() < FEWEST_PIXELS:
        return None
    difference, total, saturated = _second_differences(white, centres, inside, saturation_counts)
    columns = inside.any(axis=0)
    alive = np.broadcast_to(columns[:, None], saturated.shape) & (True if dead is None else ~dead)
    saturated &= alive
    readable = alive & ~saturated & (saturated.sum(axis=0) <= MOST_SATURATED * alive.sum(axis=0))
    signal = np.where(readable, total / np.maximum(inside.sum(axis=0), 1)[:, None] - dark, 0.0).clip(min=0.0)
    of_pixel = signal.sum(axis=1, keepdims=True)
    if not of_pixel.any():
        return None
    share = signal / np.where(of_pixel > 0.0, of_pixel, 1.0)
    difference *= readable
    difference -= difference.sum(axis=2, keepdims=True) * share.astype(np.float32)
    squared = np.square(difference, out=difference)
    squared /= 6.0
    kept = inside & _no_outlier(squared, inside, readable)
    # Expected squares: what the slope multiplies, and what the read noise leaves, after the projection.
    read_variance = readable * read_noise**2
    per_slope = signal * (1.0 - share)
    of_read = read_variance * (1.0 - 2.0 * share) + share**2 * read_variance.sum(axis=1, keepdims=True)
    readings = kept.sum(axis=0) @ readable.astype(float)
    used = readings > 0
    x, offset = ((kept.sum(axis=0) @ (part * readable))[used] / readings[used] for part in (per_slope, of_read))
    y = np.einsum("nsb,ns->b", squared, kept.astype(np.float32))[used] / readings[used]
    if not x.any():
        # A single band has nothing left after the projection.
        return None
    slope = 0.0
    for _ in range(5):
        # A variance is known to a share of itself, so the weights need the slope that they give.
        weight = readings[used] / np.maximum(offset + slope * x, QUANTISATION_VARIANCE) ** 2
        slope = max(0.0, float((weight * x * (y - offset)).sum() / (weight * x * x).sum()))
    return slope


def _second_differences(
    white: Num[np.ndarray, "lines samples bands"],
    centres: Int[np.ndarray, "triples"],
    inside: Bool[np.ndarray, "triples samples"],
    saturation_counts: float | None,
) -> tuple[
    Float[np.ndarray, "triples samples bands"], Float[np.ndarray, "samples bands"], Bool[np.ndarray, "samples bands"]
]:
    """Second differences about each centre, the sum of the centres' counts, and which elements saturate anywhere.

    All three inside the region alone.
    """
    difference = np.zeros((len(centres), *white.shape[1:]), np.float32)
    total = np.zeros(white.shape[1:])
    saturated = np.zeros(white.shape[1:], bool)
    for n, centre in enumerate(centres):
        # Counts outside may be no numbers, which times 0 would still be none.
        three = np.where(inside[n][:, None], white[centre - 1 : centre + 2], 0).astype(np.float32)
        difference[n] = three[0] - 2.0 * three[1] + three[2]
        total += three[1]
        if saturation_counts is not None:
            saturated |= three.max(axis=0) >= saturation_counts
    return difference, total, saturated


def _no_outlier(
    squared: Float[np.ndarray, "triples samples bands"],
    inside: Bool[np.ndarray, "triples samples"],
    readable: Bool[np.ndarray, "samples bands"],
) -> Bool[np.ndarray, "triples samples"]:
    """Pixels whose squares, summed over the bands in units of their variance, are those of noise."""
    pixels = squared[inside]
    counted = np.broadcast_to(readable, squared.shape)[inside]
    usual = np.maximum(np.median(pixels, axis=0) / stats.chi2.median(1), QUANTISATION_VARIANCE)
    degrees = np.maximum(counted.sum(axis=1), 1)
    score = (pixels / usual).sum(axis=1) / stats.chi2.median(degrees)
    limit = stats.chi2.isf(OUTLIER_PROBABILITY, degrees) / stats.chi2.median(degrees)
    usual_pixel = np.zeros(inside.shape, bool)
    usual_pixel[inside] = score <= np.median(score) * limit
    return usual_pixel
