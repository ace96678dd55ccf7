"""Pixels whose light follows one common course over the frames, and the robust mean of that course.

The logarithm of a pixel's light is split into its grey level, a weighted mean over bins of bands, and its colour,
what is left. How far grey levels scatter beyond the sensor's noise is taken from the data: images of a path tracer,
or lamps that flicker, scatter by percents, but in all bands alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from hsi_sc_nerf.robust_scatter import robust_std

MIN_PIXELS, MIN_FRACTION, MIN_SCATTERING_FRACTION = 64, 0.05, 0.15
"""Fewest static pixels, and their least fraction of all pixels without and with scatter: with scatter, more pixels
follow a course by chance."""
MIN_SIGNAL = 10.0
"""Least signal-to-noise ratio of a pixel's bin, so that its logarithm is normal."""
TOLERANCE = 0.002
"""Relative deviation of a static pixel's course from the common one, beyond its noise: the lamps' light does not
change by the same factor everywhere, and a bin's bands have other weights in every pixel."""
SCATTERS = (0.0, 0.01, 0.02, 0.04, 0.08)
"""Scatters of the grey level that are tried, ascending (relative)."""
CLEARLY_MORE = 1.4
"""A larger scatter is taken if it makes more than this many times as many pixels static."""
SCATTER_OF_COLOUR = 0.2
"""Scatter of the colour relative to that of the grey level."""
NOISE_MARGIN = 1.5
"""Factor by which variances may exceed the model's."""
FALSE_ALARM = 1e-3
"""Fraction of static pixels that noise alone may exclude."""
OUTLYING_FRAMES = 0.1
"""Fraction of the frames in which the grey level of a static pixel may be an outlier, and standard deviations from
which it is one."""
HUBER = 1.5
"""Standard deviations from which a grey level has limited influence (Huber & Ronchetti, "Robust Statistics")."""
SMALLEST_COUNT = 1e-3
"""Replaces counts that have no logarithm, which are not used."""
BLOCK_PX = 16
"""Neighbouring pixels whose median course is a candidate for the common one."""
AVERAGED_PX, AVERAGED_TOLERANCE = 32, 0.005
"""Neighbouring pixels over which scatter must average out, and what may be left (relative): the object's reflections
on to the wall."""
REGIONS = 4
"""Rows and columns of regions, with equally many static pixels each, whose means give the error of the common course:
what changes the light on many neighbours does not average out."""
MAX_BLOCKS, MAX_VOTERS = 64, 1024
"""Largest numbers of candidates, and of pixels that vote for them."""
ROUNDS = 5
"""Iterations of the static pixels and their common course."""


@dataclass(frozen=True, eq=False)
class Courses:
    """Logarithm of the light of pixels over the frames, relative to each pixel's mean over the frames.

    Attributes:
        log: log of each bin of bands.
        variance: variance of ``log`` by the sensor's noise and ``TOLERANCE``; infinite in bins that cannot be used.
        weight: weight of the bins in the grey level; their sum is 1, or 0 without usable bins.
        grey_variance: variance of the grey level by the sensor's noise and ``TOLERANCE``.
        judged: pixels with enough usable bins.
    """

    log: Float[np.ndarray, "pixels frames bins"]
    variance: Float[np.ndarray, "pixels bins"]
    weight: Float[np.ndarray, "pixels bins"]
    grey_variance: Float[np.ndarray, "pixels"]
    judged: Bool[np.ndarray, "pixels"]

    @staticmethod
    def of(counts: Float[np.ndarray, "pixels frames bins"], variance: Float[np.ndarray, "pixels bins"]) -> Courses:
        """Courses of counts above dark (overwritten), and the variance of one count, infinite if not usable."""
        mean = counts.mean(axis=1)
        usable = (mean > MIN_SIGNAL * np.sqrt(variance)) & (counts.min(axis=1) > 0.0)
        relative = np.where(usable, variance, 0.0) / np.where(usable, mean, 1.0) ** 2 + TOLERANCE**2
        total = np.maximum((usable / relative).sum(axis=1), SMALLEST_COUNT)
        log = np.log(np.maximum(counts, SMALLEST_COUNT, out=counts), out=counts)
        log -= log.mean(axis=1, keepdims=True)
        return Courses(
            log,
            variance=np.where(usable, relative, np.inf),
            weight=(usable / relative / total[:, None]).astype(np.float32),
            grey_variance=1.0 / total + TOLERANCE**2,
            judged=usable.sum(axis=1) >= max(1, counts.shape[2] // 2),
        )

    def select(self, pixels: Bool[np.ndarray, "pixels"] | Int[np.ndarray, "chosen"]) -> Courses:
        """The courses of some pixels."""
        return Courses(*(part[pixels] for part in vars(self).values()))

    def relative_to(
        self, common: Float[np.ndarray, "frames bins"]
    ) -> tuple[Float[np.ndarray, "pixels frames"], Float[np.ndarray, "pixels frames bins"]]:
        """Grey levels and colours relative to a common course.

        The middle of a pixel's grey levels is 0, whatever happens to it in a few frames.
        """
        colour = self.log - common
        grey = np.matmul(colour, self.weight[..., None])[..., 0]
        colour -= grey[..., None]
        few = len(common) < 1.0 / OUTLYING_FRAMES
        return grey - (grey.mean(axis=1) if few else np.median(grey, axis=1))[:, None], colour

    def agree(self, common: Float[np.ndarray, "frames bins"], scatter: float) -> Bool[np.ndarray, "pixels"]:
        """Pixels that follow a course within their noise and a scatter of their grey level."""
        frames, free = len(common), np.maximum(np.isfinite(self.variance).sum(axis=1) - 1, 1)
        grey, colour = self.relative_to(common)
        of_grey = grey**2 / (self.grey_variance + scatter**2)[:, None]
        weight = (1.0 / (self.variance + (SCATTER_OF_COLOUR * scatter) ** 2)).astype(np.float32)
        of_colour = np.matmul(np.square(colour, out=colour), weight[..., None])[..., 0]
        limit = NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM / frames, 1)
        outlying = int(OUTLYING_FRAMES * frames) if scatter > 0.0 else 0
        return (
            self.judged
            & (of_colour.sum(axis=1) <= NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM, (frames - 1) * free))
            & (of_colour.max(axis=1) <= NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM / frames, free))
            & (np.minimum(of_grey, limit).sum(axis=1) <= NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM, frames - 1))
            & ((of_grey > limit).sum(axis=1) <= outlying)
        )


def static_pixels(courses: Courses) -> tuple[Bool[np.ndarray, "pixels"], Float[np.ndarray, "frames bins"]]:
    """Pixels whose light follows one common course over the frames, whatever their spectrum, and that course.

    The scatter of their grey levels is the smallest that makes enough pixels static, unless a larger one makes far
    more of them static. A rotating surface has a course of its own unless it looks the same from all sides, and if
    nothing is static, few pixels agree on any course.
    """
    best, course = np.zeros(len(courses.log), bool), np.zeros(courses.log.shape[1:])
    for scatter in SCATTERS:
        static, common = _static_with_scatter(courses, scatter)
        fraction = MIN_SCATTERING_FRACTION if scatter > 0.0 else MIN_FRACTION
        if static.sum() >= max(MIN_PIXELS, fraction * len(static), CLEARLY_MORE * best.sum()):
            best, course = static, common
        elif best.any():
            break
    return best, course


def grey_deviation(
    courses: Courses, static: Bool[np.ndarray, "lines samples"], common: Float[np.ndarray, "frames bins"]
) -> tuple[Float[np.ndarray, "static frames"], float, float]:
    """Deviation of static pixels' grey levels from their robust mean in each frame.

    Args:
        courses: courses of all pixels, in reading order.
        static: which of them are static.
        common: their common course.

    Returns:
        The deviations (natural logarithm); their scatter (standard deviation); and the standard error of a frame's
        mean, from the means of regions of the image.
    """
    region = _equal_regions(static)
    chosen, frames = courses.select(static.ravel()), len(common)
    for _ in range(ROUNDS):
        deviation, _ = chosen.relative_to(common)
        # The robust standard deviation, so that sensor noise is part of it.
        scatter = float(robust_std(deviation))
        variance = np.maximum(chosen.grey_variance, scatter**2)
        common = common + _robust_mean(deviation, variance)[:, None]
    deviation, _ = chosen.relative_to(common)
    limit = HUBER * np.sqrt(variance)[:, None]
    limited = deviation.clip(-limit, limit)
    means = np.stack([np.bincount(region, of_frame) for of_frame in limited.T]) / np.bincount(region)
    free = max(means.shape[1] - 1.0, 0.5) * (frames - 1) / frames
    inside = float((np.abs(deviation) < limit).mean())
    error = np.sqrt(np.square(means).mean() / free) / inside
    return deviation, scatter, float(error)


def _equal_regions(static: Bool[np.ndarray, "lines samples"]) -> Int[np.ndarray, "static"]:
    """Number of the region of each static pixel, in reading order: rows of equally many, cut into as many parts."""
    sample = np.nonzero(static)[1]
    row = np.arange(len(sample)) * REGIONS // len(sample)
    region = np.empty_like(row)
    region[np.lexsort((sample, row))] = np.arange(len(sample)) * REGIONS**2 // len(sample)
    return region


def _static_with_scatter(
    courses: Courses, scatter: float
) -> tuple[Bool[np.ndarray, "pixels"], Float[np.ndarray, "frames bins"]]:
    """Pixels that follow the course that most of them follow, found as in RANSAC, and that course.

    The candidates are median courses of blocks of neighbours, which have little noise.
    """
    static, common = np.zeros(len(courses.log), bool), np.zeros(courses.log.shape[1:])
    voters = np.flatnonzero(courses.judged)
    if not len(voters):
        return static, common
    voting = courses.select(voters[:: max(1, len(voters) // MAX_VOTERS)])
    starts = np.arange(0, max(1, len(voters) - BLOCK_PX + 1), BLOCK_PX)
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, MAX_BLOCKS).round().astype(int))]
    candidates = [np.median(courses.log[voters[start : start + BLOCK_PX]], axis=0) for start in starts]
    common = max(candidates, key=lambda candidate: int(voting.agree(candidate, scatter).sum()))
    for _ in range(ROUNDS):
        before, static = static, courses.agree(common, scatter)
        if not static.any() or (static == before).all():
            break
        chosen = courses.select(static)
        grey, colour = chosen.relative_to(common)
        weight = 1.0 / chosen.variance
        common = common + np.einsum("pfk,pk->fk", colour, weight) / np.maximum(weight.sum(axis=0), SMALLEST_COUNT)
        common += _robust_mean(grey, chosen.grey_variance + scatter**2)[:, None]
    return (static & _averages_out(courses, common, static, scatter) if scatter > 0.0 else static), common


def _averages_out(
    courses: Courses, common: Float[np.ndarray, "frames bins"], static: Bool[np.ndarray, "pixels"], scatter: float
) -> Bool[np.ndarray, "pixels"]:
    """Pixels of blocks of neighbours whose mean follows the course: a moving object covers neighbours together."""
    block = np.arange(len(static)) // AVERAGED_PX
    chosen, of_block = courses.select(static), block[static]
    members = np.bincount(of_block, minlength=block[-1] + 1)
    variance = chosen.grey_variance + scatter**2
    limit = 3.0 * np.sqrt(variance)[:, None]
    limited = chosen.relative_to(common)[0].clip(-limit, limit)
    total = np.stack([np.bincount(of_block, of_frame, len(members)) for of_frame in limited.T], axis=1)
    expected = np.bincount(of_block, variance, len(members)) + (members * AVERAGED_TOLERANCE) ** 2
    chi_square = (total**2 / np.maximum(expected, 1e-12)[:, None]).sum(axis=1)
    return (chi_square <= NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM, len(common) - 1))[block]


def _robust_mean(
    values: Float[np.ndarray, "pixels frames"], variance: Float[np.ndarray, "pixels"]
) -> Float[np.ndarray, "frames"]:
    """Huber's mean over the pixels in each frame, weighted by 1 / variance."""
    deviation, weight = np.sqrt(variance)[:, None], 1.0 / variance[:, None]
    mean = np.median(values, axis=0)
    for _ in range(ROUNDS):
        limited = np.clip(values - mean, -HUBER * deviation, HUBER * deviation)
        mean = mean + (limited * weight).sum(axis=0) / weight.sum(axis=0)
    return mean
