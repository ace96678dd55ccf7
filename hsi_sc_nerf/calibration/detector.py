"""The detector: counts without light or without data, saturation, and elements and bands that do not work.

An element is one position (sample, band) of the detector, which sees one sample of every line. Its reading is one
number of a cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import ndimage

from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.robust_scatter import robust_std

NEIGHBOURS = 11
"""Width of the median window along the line that an element is compared with."""
LEAST_RESPONSE, LARGEST_RESPONSE = 0.5, 2.0
"""Range of a live element's counts, relative to its neighbours."""
LEAST_BRIGHTNESS = 0.02
"""A sample darker than this fraction of its neighbours in all bands is dead, and not in a shadow."""
CERTAINTY = 6.0
"""Differences count from this many standard deviations, which noise reaches in none of 10^8 elements."""
REACHED_BY_NOISE = 3.0
"""Noise reaches counts up to this many standard deviations away, in about one of 10^3 readings."""
DEAD_BAND_FRACTION = 0.5
"""A band with a larger fraction of dead elements is bad."""
MIN_LIGHT = 0.001
"""A band in which the white counts less than this fraction of its brightest band is unlit."""
DIGITISER_LIMITS = {2**bits - 1 for bits in range(8, 33)} | {(2**bits - 1) << (16 - bits) for bits in (10, 12, 14)}
"""Largest counts of digitisers, also of those that shift their numbers up to 16 bits."""
MIN_AT_LIMIT = 3
"""Fewest readings at the limit of a digitiser that are taken for saturation."""
BELOW_TOP = 10
"""Readings pile up at the largest count if it has more of them than this many counts below it together."""
MIN_TOP_PAIRS = 20
"""Fewest readings, and fewest pairs of neighbours, that can be a pile at the largest count."""
SAME_PATTERN = 1.5
"""Variance of the frames' dark patterns, relative to that of noise, up to which they are the same."""
SOME_LINES = 16
"""Lines that are read of a cube, and at most of its dark cube, to inspect it."""
BRIGHT = 0.5
"""Fraction of the largest count above which readings are bright."""


@dataclass(frozen=True, eq=False)
class Defects:
    """Defects of the detector.

    Attributes:
        saturation_counts: counts from which a reading is saturated; None if nothing saturates.
        dead: elements that do not follow the light (dead, hot or stuck) or have no dark counts, outside of the bad
            bands.
        bad_bands: bands without measurements: listed as bad, unlit, or with most of their elements dead.
    """

    saturation_counts: float | None
    dead: Bool[np.ndarray, "samples bands"]
    bad_bands: Bool[np.ndarray, "bands"]

    def summary(self) -> str:
        """One line for people."""
        level = self.saturation_counts
        saturation = "nothing is saturated" if level is None else f"readings saturate at {level:g} counts"
        return (
            f"{saturation}; {np.count_nonzero(self.dead)} of {self.dead.size} detector elements are dead; "
            f"{np.count_nonzero(self.bad_bands)} of {len(self.bad_bands)} bands are bad"
        )


@dataclass(frozen=True, eq=False)
class Readings:
    """Some lines of a capture, and its dark cube."""

    counts: Num[np.ndarray, "lines samples bands"]
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None = None
    """NaN for no data (`dark_counts`)."""

    def without_dark(self) -> Bool[np.ndarray, "samples bands"]:
        """Elements of which no line of the dark cube has data; none if it cannot be matched by sample."""
        missing = None if self.dark is None else no_data(np.asarray(self.dark), None)
        if missing is None or missing.shape[1:] != self.counts.shape[1:]:
            return np.zeros(self.counts.shape[1:], bool)
        return np.all(missing, axis=0)

    def light(self) -> Float[np.ndarray, "samples bands"]:
        """Mean counts above dark over the lines."""
        return self.counts.mean(axis=0, dtype=np.float64) - dark_columns(self.dark, *self.counts.shape[1:])


def find_defects(
    white: Readings, frames: Sequence[Readings] = (), *, good_bands: Bool[np.ndarray, "bands"] | None = None
) -> Defects:
    """Find the detector's defects on lines of the white and of some frames.

    Args:
        white: the lines that cross the white, over their whole width.
        frames: a few lines of each of some frames. They show elements that the white does not cover, and saturation.
        good_bands: the header's bad-band list ``bbl``.
    """
    white_light = white.light()
    step = float(any(readings.counts.dtype.kind in "iu" for readings in (white, *frames)))
    images = [(white_light, step)]
    if frames:
        images.append((np.mean([readings.light() for readings in frames], axis=0), step))
    dead = elements_without_response(images)
    for readings in (white, *frames):
        dead |= readings.without_dark()
    brightness = np.where(dead, 0.0, white_light).sum(axis=1)
    bright = brightness >= BRIGHT * np.percentile(brightness, 99.0)  # a white may fill less than half of its lines
    bad = unlit_bands(np.where(dead, np.nan, white_light)[bright])
    bad |= dead.mean(axis=0) > DEAD_BAND_FRACTION
    if good_bands is not None:
        bad |= ~good_bands
    counts = [readings.counts for readings in (white, *frames)]
    live = ~dead & ~bad
    if live.any():
        # An element whose dark counts leave no room for light.
        top = max(float(cube.max(axis=0)[live].max()) for cube in counts)
        dead |= dark_columns(white.dark, *white.counts.shape[1:]) >= top
    return Defects(saturation_counts(counts, ~dead & ~bad), dead & ~bad, bad)


def elements_without_response(
    images: Sequence[tuple[Float[np.ndarray, "samples bands"], float]],
) -> Bool[np.ndarray, "samples bands"]:
    """Elements that follow the light in none of the images, and fail to in at least one.

    An element is expected to count as the median of its neighbours along the line, after each sample is divided by
    its brightness over all bands: an edge of the white, or of the object, is no defect. The element follows the light
    if it counts between ``LEAST_RESPONSE`` and ``LARGEST_RESPONSE`` of that. Images that are too dark there, relative
    to the spread over the band, are not used. A warm element, which only has a higher dark level, is not dead.

    Args:
        images: mean counts above dark over an image's lines, and the step of its counts (0 for no integers).
    """
    shape = images[0][0].shape
    follows, fails = np.zeros(shape, bool), np.zeros(shape, bool)
    for light, step in images:
        typical = np.median(light, axis=0)
        lit = typical > 0.0
        if not lit.any():
            continue
        brightness = np.median(light[:, lit] / typical[lit], axis=1)
        around = ndimage.median_filter(brightness, size=NEIGHBOURS, mode="mirror")
        brightness = np.where(brightness < LEAST_BRIGHTNESS * around, around, brightness)
        brightness = np.maximum(brightness, LEAST_BRIGHTNESS)[:, None]
        expected = ndimage.median_filter(light / brightness, size=(NEIGHBOURS, 1), mode="mirror") * brightness
        spread = np.hypot(robust_std(light - expected, axis=0), step / np.sqrt(12.0))
        # Even the least response must exceed the noise.
        conclusive = (expected > 0.0) & (LEAST_RESPONSE * expected >= CERTAINTY * spread)
        as_expected = (light > LEAST_RESPONSE * expected) & (light < LARGEST_RESPONSE * expected)
        follows |= conclusive & as_expected
        fails |= conclusive & ~as_expected
    return fails & ~follows


def unlit_bands(light: Float[np.ndarray, "columns bands"]) -> Bool[np.ndarray, "bands"]:
    """Bands whose median over the columns is below ``MIN_LIGHT`` times that of the brightest; nan counts as 0."""
    typical = np.median(np.where(np.isfinite(light), light, 0.0), axis=0)
    return ~((typical > 0.0) & (typical >= MIN_LIGHT * typical.max()))


def dark_counts(dark: Cube | None) -> Num[np.ndarray, "dark_lines dark_samples bands"] | None:
    """Counts of a dark cube, NaN for no data; None without one.

    Many headers state 0 as ``data ignore value``; a dark cube may read 0, and then it is a count.
    """
    if dark is None:
        return None
    counts, ignored = dark.memmap(), dark.ignore_value
    missing = no_data(counts, ignored)
    if missing is not None and ignored == 0 and _is_dark(counts[spread_rows(len(counts), SOME_LINES)]):
        missing = no_data(counts, None)
    return counts if missing is None else np.where(missing, np.nan, counts)


def _is_dark(counts: Num[np.ndarray, "dark_lines dark_samples bands"]) -> bool:
    """Whether the count 0 is a reading of a dark cube like the others: noise reaches it, or there are no others."""
    readings = np.nan_to_num(counts, posinf=0.0, neginf=0.0).astype(np.float32)
    others = readings[readings != 0.0]
    if not len(others):
        return True
    level = float(np.median(others))
    # A pattern of the elements is no noise, but of one line all that there is.
    changes = np.diff(readings, axis=0) / np.sqrt(2.0) if len(readings) > 1 else others - level
    rounding = 1.0 if (others == np.rint(others)).all() else 0.0
    return abs(level) <= rounding + REACHED_BY_NOISE * float(robust_std(changes))


def dark_columns(
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None, samples: int, bands: int
) -> Float[np.ndarray, "columns bands"]:
    """Counts without light of each sample: the mean over the dark cube's lines with data; 0 without a dark cube.

    An element without any data has the mean of its band. A dark cube of another width cannot be matched by sample and
    gives one spectrum (columns = 1).

    Args:
        dark: NaN for no data (`dark_counts`).
    """
    if dark is None:
        return np.zeros((1, bands))
    counts = np.asarray(dark)
    columns = fill_no_data(counts, None).mean(axis=0, dtype=np.float64)
    missing = no_data(counts, None)
    if missing is not None:
        unknown = missing.all(axis=0)
        level = columns.sum(axis=0, where=~unknown) / np.maximum((~unknown).sum(axis=0), 1)
        columns = np.where(unknown, level, columns)
    return columns if len(columns) == samples else columns.mean(axis=0, keepdims=True)


def pooled_darks(
    darks: Sequence[Float[np.ndarray, "columns bands"]], readings: int, read_noise: Float[np.ndarray, "bands"]
) -> list[Float[np.ndarray, "columns bands"]]:
    """The frames' dark counts with the pattern of columns and bands that all share, and each frame's own level.

    A dark cube has few lines. Its noise is subtracted from every line of the frame, and the noise of a band's level
    from every pixel. A frame's level is one offset for all bands, or one value for each band if the frames differ by
    more than noise. If the frames' patterns differ, their darks are returned unchanged.

    Args:
        read_noise: standard deviation of one reading.
    """
    if len(darks) < 2 or len({dark.shape for dark in darks}) > 1 or len(darks[0]) < 2:
        return list(darks)
    stacked = np.stack(darks)
    frames, columns, bands = stacked.shape
    level = stacked.mean(axis=1, keepdims=True)
    pattern = (stacked - level).mean(axis=0)
    expected = np.maximum((1.0 - 1.0 / frames) * read_noise**2 / readings, 1e-12)
    of_columns = np.median(np.square(stacked - level - pattern).mean(axis=0), axis=0) / (1.0 - 1.0 / columns)
    if np.median(of_columns / expected) > SAME_PATTERN:
        return list(darks)
    offset = level.mean(axis=2, keepdims=True)
    of_bands = np.square(level - offset - (level - offset).mean(axis=0)).mean(axis=0)[0]
    if bands > 1 and np.mean(of_bands * columns / expected) / (1.0 - 1.0 / bands) <= SAME_PATTERN:
        pattern, level = (stacked - offset).mean(axis=0), offset
    return list(level + pattern)


def spread_rows(lines: int, most: int) -> Int[np.ndarray, "rows"]:
    """Numbers of lines that are evenly spread over a cube, without its first and last if it has many."""
    return np.unique(np.linspace(0, lines - 1, min(most, lines) + 2).round().astype(int)[1:-1])


def some_lines(cube: Cube) -> Num[np.ndarray, "rows samples bands"]:
    """Counts of ``SOME_LINES`` lines of a cube (`spread_rows`), no data filled (`fill_no_data`)."""
    return fill_no_data(np.asarray(cube.memmap()[spread_rows(cube.shape[0], SOME_LINES)]), cube.ignore_value)


def light_of_some_lines(cube: Cube, dark: Cube | None) -> Float[np.ndarray, "rows samples bands"]:
    """Counts above dark of ``SOME_LINES`` lines of a cube (`spread_rows`); 0 for no data."""
    counts = np.asarray(cube.memmap()[spread_rows(cube.shape[0], SOME_LINES)])
    return light_above(counts, None if dark is None else some_lines(dark), cube.ignore_value)


def light_above(
    counts: Num[np.ndarray, "lines samples bands"],
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None,
    ignore_value: float | None,
) -> Float[np.ndarray, "lines samples bands"]:
    """Counts above dark; 0 for no data."""
    missing = no_data(counts, ignore_value)
    light = counts.astype(np.float32) - dark_columns(dark, *counts.shape[1:]).astype(np.float32)
    return light if missing is None else np.where(missing, np.float32(0.0), light)


def no_data(counts: Num[np.ndarray, "*shape"], ignore_value: float | None) -> Bool[np.ndarray, "*shape"] | None:
    """Counts that are no data: the header's ``data ignore value``, and floats that are not finite; None if all are.

    None saves memory of the counts' size, and integers without an ignore value are not even read.
    """
    missing = ~np.isfinite(counts) if counts.dtype.kind == "f" else None
    if ignore_value is not None:
        ignored = counts == ignore_value
        missing = ignored if missing is None else missing | ignored
    return missing if missing is not None and missing.any() else None


def fill_no_data(
    counts: Num[np.ndarray, "lines samples bands"], ignore_value: float | None
) -> Num[np.ndarray, "lines samples bands"]:
    """The counts with no data replaced by the mean of the element's other lines, or by 0 if it has none."""
    missing = no_data(counts, ignore_value)
    if missing is None:
        return counts
    total = counts.sum(axis=0, dtype=np.float64, where=~missing)
    mean = total / np.maximum((~missing).sum(axis=0), 1)
    return np.where(missing, mean.astype(counts.dtype), counts)


def saturation_counts(
    cubes: Sequence[Num[np.ndarray, "lines samples bands"]], live: Bool[np.ndarray, "samples bands"]
) -> float | None:
    """The count from which readings of the live elements are saturated; None if nothing saturates.

    The candidate is the largest reading T. It may also be just the brightest pixel, or shared by many pixels of an
    even background without noise. T is the saturation level in two cases:

    1. T is the limit of a digitiser (`DIGITISER_LIMITS`, or the data type's largest), and at
       least ``MIN_AT_LIMIT`` readings have it, and more than have the next lower value.
    2. Readings pile up at T: more than at the ``BELOW_TOP`` counts under it together. Where one of two neighbours is
       at T, usually both are, while equal neighbours are rare among other bright readings, because of noise.
    """
    if not live.any():
        return None
    top = max(float(cube.max(axis=0)[live].max()) for cube in cubes)
    readings = [cube[:, live] for cube in cubes]
    at_top = sum(np.count_nonzero(of_cube == top) for of_cube in readings)
    dtype = cubes[0].dtype
    if top in DIGITISER_LIMITS or (dtype.kind in "iu" and top == np.iinfo(dtype).max):
        lower = [of_cube[of_cube < top] for of_cube in readings]
        next_lower = max((of_cube.max() for of_cube in lower if len(of_cube)), default=top)
        at_next = sum(np.count_nonzero(of_cube == next_lower) for of_cube in lower)
        return top if at_top >= MIN_AT_LIMIT and at_top > at_next else None
    just_below = sum(np.count_nonzero((of_cube < top) & (of_cube >= top - BELOW_TOP)) for of_cube in readings)
    piles_up = at_top >= MIN_TOP_PAIRS and at_top > just_below and _neighbours_share(cubes, live, top)
    return top if piles_up else None


def _neighbours_share(
    cubes: Sequence[Num[np.ndarray, "lines samples bands"]], live: Bool[np.ndarray, "samples bands"], top: float
) -> bool:
    """Whether neighbours share the largest count more often than other bright counts."""
    live_pairs = live[1:] & live[:-1]
    top_pairs = both_at_top = bright_pairs = equal_pairs = 0
    for cube in cubes:
        one, other = cube[:, 1:][:, live_pairs], cube[:, :-1][:, live_pairs]
        either = (one == top) | (other == top)
        top_pairs += int(np.count_nonzero(either))
        both_at_top += int(np.count_nonzero(either & (one == other)))
        bright = ~either & (np.minimum(one, other) > BRIGHT * top)
        bright_pairs += int(np.count_nonzero(bright))
        equal_pairs += int(np.count_nonzero(bright & (one == other)))
    if both_at_top < MIN_TOP_PAIRS or 4 * bright_pairs < top_pairs:
        return False
    fraction_both, fraction_equal = both_at_top / top_pairs, equal_pairs / bright_pairs
    return fraction_both > 0.5 and fraction_both > 3.0 * fraction_equal
