"""What is wrong with the detector: where it saturates, which of its elements and bands do not follow the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Num
from scipy import ndimage

from hsi_sc_nerf.calibration.dark import dark_columns
from hsi_sc_nerf.calibration.saturation import saturation_counts

NEIGHBOURS = 11
"""An element is compared with the median of so many along its line, itself in the middle."""
LEAST_RESPONSE, LARGEST_RESPONSE = 0.5, 2.0
"""An element follows the light if it counts between these shares of what its neighbours count."""
LEAST_BRIGHTNESS = 0.02
"""A sample that counts less than this share of its neighbours in all bands is taken for dead, not for a shadow."""
CERTAINTY = 6.0
"""Differences count from this many standard deviations on: of 10^8 elements none is wrong by chance."""
DEAD_BAND_SHARE = 0.5
"""A band with more dead elements than this is bad."""


@dataclass(frozen=True, eq=False)
class Defects:
    """What is wrong with the detector.

    Attributes:
        saturation_counts: counts from which a reading is saturated; None where nothing is.
        dead: elements that do not follow the light (dead, hot or stuck), in the bands that are not bad as a whole.
        bad_bands: bands that measure nothing: listed as bad, unlit, or with most of their elements dead.
    """

    saturation_counts: float | None
    dead: Bool[np.ndarray, "samples bands"]
    bad_bands: Bool[np.ndarray, "bands"]

    def tally(self) -> str:
        """One line for people."""
        samples, bands = self.dead.shape
        dead = np.count_nonzero(self.dead[:, ~self.bad_bands])
        parts = [
            "nothing is saturated"
            if self.saturation_counts is None
            else f"readings saturate at {self.saturation_counts:g} counts",
            f"{dead} of {samples * bands} detector elements are dead",
            f"{np.count_nonzero(self.bad_bands)} of {bands} bands are bad",
        ]
        return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class Readings:
    """Some lines of one or more captures, and their dark cube."""

    counts: Num[np.ndarray, "lines samples bands"]
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None = None

    def light(self) -> Float[np.ndarray, "samples bands"]:
        """Mean over the lines of the counts above dark."""
        samples, bands = self.counts.shape[1:]
        return self.counts.mean(axis=0, dtype=np.float64) - dark_columns(self.dark, samples, bands)

    def resolution(self) -> float:
        """Step between counts: 1 for whole numbers, 0 for others."""
        return 1.0 if np.issubdtype(self.counts.dtype, np.integer) else 0.0


def find_defects(
    white: Readings,
    frames: Sequence[Readings] = (),
    *,
    good_bands: Bool[np.ndarray, "bands"] | None = None,
    min_light: float = 0.001,
) -> Defects:
    """Defects of the detector from lines of the white and a few lines of the frames.

    Args:
        white: the lines of the white's image that cross the white, over their whole width.
        frames: a few lines of each of some frames. They tell of the elements that the white does not reach, and of
            saturation; each `Readings` should be of one capture.
        good_bands: the header's ``bbl``.
        min_light: a band in which the white counts less than this share of its brightest band's is unlit.
    """
    samples, bands = white.counts.shape[1:]
    white_light = white.light()
    images = [(white_light, white.resolution())]
    if frames:
        frame_light = np.mean([readings.light() for readings in frames], axis=0)
        images.append((frame_light, max(readings.resolution() for readings in frames)))
    dead = elements_without_response(images)
    bad = unlit_bands(np.where(dead, np.nan, white_light), min_light)
    bad |= dead.mean(axis=0) > DEAD_BAND_SHARE
    if good_bands is not None:
        bad |= ~good_bands
    counts = [readings.counts for readings in (white, *frames)]
    live = ~dead & ~bad
    if live.any():
        # An element whose dark level leaves no room for light.
        top = max(float(cube.max(axis=0)[live].max()) for cube in counts)
        dead |= dark_columns(white.dark, samples, bands) >= top
    return Defects(saturation_counts(counts, ~dead & ~bad), dead & ~bad, bad)


def elements_without_response(
    images: Sequence[tuple[Float[np.ndarray, "samples bands"], float]],
) -> Bool[np.ndarray, "samples bands"]:
    """Detector elements that do not follow the light in any image in which their neighbours see some.

    In each image an element is expected to count as its neighbours along the line do (their median), each divided by
    how bright its sample is in all bands: so an edge of the white, or of a thing in the frames, is no defect. It
    follows the light in that image if it counts between ``LEAST_RESPONSE`` and ``LARGEST_RESPONSE`` of that; where
    the light is too weak, against the spread of all elements of the band, an image does not tell. An element that
    follows in any of the images is not dead: a warm element, which has a dark level of its own, lives.

    Args:
        images: of each the mean over its lines of the counts above dark, and the step of its counts (0 where they are
            no whole numbers).
    """
    shape = images[0][0].shape
    follows, fails = np.zeros(shape, bool), np.zeros(shape, bool)
    for light, step in images:
        usual = np.median(light, axis=0)
        lit = usual > 0.0
        if not lit.any():
            continue
        # How much brighter a sample is than others, in all bands: an edge of the white, or of a thing in the frames.
        brightness = np.median(light[:, lit] / usual[lit], axis=1)
        around = ndimage.median_filter(brightness, size=NEIGHBOURS, mode="mirror")
        brightness = np.where(brightness < LEAST_BRIGHTNESS * around, around, brightness)
        brightness = np.maximum(brightness, LEAST_BRIGHTNESS)[:, None]
        neighbours = ndimage.median_filter(light / brightness, size=(NEIGHBOURS, 1), mode="mirror")
        expected = neighbours * brightness
        spread = 1.4826 * np.median(np.abs(light - expected), axis=0)
        spread = np.hypot(spread, step / np.sqrt(12.0))
        # Half of the expected light must be beyond doubt.
        told = (expected > 0.0) & (LEAST_RESPONSE * expected >= CERTAINTY * spread)
        as_expected = (light > LEAST_RESPONSE * expected) & (light < LARGEST_RESPONSE * expected)
        follows |= told & as_expected
        fails |= told & ~as_expected
    return fails & ~follows


def unlit_bands(light: Float[np.ndarray, "columns bands"], min_light: float) -> Bool[np.ndarray, "bands"]:
    """Bands whose median over the columns is less than ``min_light`` times the brightest band's; nan is no light."""
    lit = np.where(np.isfinite(light), light, 0.0)
    typical = np.median(lit, axis=0)
    return ~((typical > 0.0) & (typical >= min_light * typical.max()))
