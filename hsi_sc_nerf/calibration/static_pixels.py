"""Which pixels of a session show something that stands still, from their courses over the frames alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

TOLERANCE = 0.002
"""By how much (relative) a static pixel's course may differ from the common one beyond its noise: the lamps' light
does not change by quite the same factor everywhere, nor do a bin's bands weigh the same in every pixel."""
NOISE_MARGIN = 1.5
"""Variances may be larger than the noise model's by this factor."""
FALSE_ALARM = 1e-3
"""Share of static pixels that noise alone may exclude."""
SMALLEST_COUNT = 1e-3
"""Stands for counts that have no logarithm, and are not used."""
SMALLEST_SIGNAL = 10.0
"""Signal over noise from which a pixel's counts in a bin are looked at: below, their logarithm is not normal."""
BLOCK_PX = 16
"""Neighbouring pixels whose median course is tried as the common one."""
MOST_BLOCKS, MOST_VOTERS = 256, 4096
"""How many such courses are tried, and how many pixels judge them."""
ROUNDS = 5
"""Of finding the pixels that follow a course and the course of these pixels."""


def static_pixels(
    counts: Float[np.ndarray, "pixels frames bins"], variance: Float[np.ndarray, "pixels bins"]
) -> Bool[np.ndarray, "pixels"]:
    """Pixels that follow one common course in time, within their noise, whatever their spectrum.

    The course that most pixels follow is looked for, as by random sampling and consensus, but with the median
    courses of blocks of neighbours as candidates, so that a pixel's noise does not count. Things that turn change by
    their own courses, and where nothing stands still few pixels agree on any. A turning thing that looks the same
    from all sides follows the lamps too, and counts as static.

    Args:
        counts: above dark, in bins of bands, overwritten; neighbours in the image follow each other.
        variance: of one of these (mean over the frames); infinite where the counts cannot be used.
    """
    frames = counts.shape[1]
    bins_needed = max(1, counts.shape[2] // 2)
    mean = counts.mean(axis=1)
    usable = (mean > SMALLEST_SIGNAL * np.sqrt(variance)) & (counts.min(axis=1) > 0.0)
    relative = np.where(usable, variance, 0.0) / np.where(usable, mean, 1.0) ** 2
    weight = (usable / (relative + TOLERANCE**2)).astype(np.float32)
    course = np.log(np.maximum(counts, SMALLEST_COUNT, out=counts), out=counts)
    course -= course.mean(axis=1, keepdims=True)
    judged = usable.sum(axis=1) >= bins_needed
    degrees = np.maximum((frames - 1) * usable.sum(axis=1), 1)
    over_frames = NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM, degrees)

    voters = np.flatnonzero(judged)
    voters = voters[:: max(1, len(voters) // MOST_VOTERS)]
    if not len(voters):
        return judged
    candidates = _candidates(course)
    votes = _chi_square(course[voters], weight[voters], candidates) <= over_frames[voters, None]
    common = candidates[int(votes.sum(axis=0).argmax())]
    in_a_frame = NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM / frames, np.maximum(usable.sum(axis=1), 1))
    static = np.zeros(len(course), bool)
    for _ in range(ROUNDS):
        residual = course - common
        np.square(residual, out=residual)
        by_frame = np.matmul(residual, weight[..., None])[..., 0]
        before, static = (
            static,
            judged & (by_frame.sum(axis=1) <= over_frames) & (by_frame.max(axis=1) <= in_a_frame),
        )
        if not static.any() or (static == before).all():
            break
        total = weight[static].sum(axis=0)
        common = np.einsum("pfk,pk->fk", course[static], weight[static]) / np.where(total > 0.0, total, 1.0)
    return static


def _candidates(course: Float[np.ndarray, "pixels frames bins"]) -> Float[np.ndarray, "blocks frames bins"]:
    """Median courses of blocks of neighbours, evenly spread."""
    starts = np.arange(0, max(1, len(course) - BLOCK_PX + 1), BLOCK_PX)
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, MOST_BLOCKS).round().astype(int))]
    return np.stack([np.median(course[start : start + BLOCK_PX], axis=0) for start in starts])


def _chi_square(
    course: Float[np.ndarray, "pixels frames bins"],
    weight: Float[np.ndarray, "pixels bins"],
    candidates: Float[np.ndarray, "blocks frames bins"],
) -> Float[np.ndarray, "pixels blocks"]:
    """Squared distance of each pixel's course from each candidate, in units of its variance."""
    weighted = course * weight[:, None]
    own = np.einsum("pfk,pfk->p", course, weighted)[:, None]
    product = weighted.reshape(len(course), -1) @ candidates.reshape(len(candidates), -1).T
    return own - 2.0 * product + weight @ np.square(candidates).sum(axis=1).T
