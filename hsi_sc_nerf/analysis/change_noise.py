"""How large the errors of the changes of patches are, by how hard each was to reconstruct, and how they are alike.

Most of the surface did not change, so the changes themselves show the errors. They are larger where cameras saw the
surface at grazing angles or seldom, at its rim, and where it is rough or bent: by how much, each pair of days tells.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.stats import rankdata

PATCH_M = 0.005
"""Size of the patches that are tested; finer ones would test the noise of single points."""
_BIWEIGHT = 9.0
_CLIPPED = 3.0
_ROUNDING = 1e-5
"""In every unit that is compared: radians, reflectance, millimetres."""
_KNOTS = (0.5, 0.75, 0.9)
"""Fractions of the patches above which the noise may rise more steeply; below the first it is flat."""
_TAILS = 4.0
"""Degrees of freedom of Student's distribution, whose long tails take in what changed."""
_STEEPEST = 5.0
_BINS = 24
_MOST_PATCHES = 1500
"""Patches that the correlation is found from."""


def noise_of_patches(
    change: Float[np.ndarray, "p k"],
    conditions: Float[np.ndarray, "p c"],
    misplaced: Float[np.ndarray, "p k"],
    centres_m: Float[np.ndarray, "p 3"],
) -> Float[np.ndarray, "p k"]:
    """Standard deviation of the errors of each patch, robust against patches that changed.

    The logarithm of the noise is that of the easy patches plus slopes, none below 0, times how far the rank of each
    condition lies above each of `_KNOTS`. They make the changes most likely by Student's distribution, whose tails
    take in patches that changed. Patches in the likelihood count as independent ones, and a slope has an exponential
    prior of mean 1, so that few parts tell little apart. At last the noise is scaled to the biweight scale.

    Args:
        change: about 0 where nothing changed; NaN where it is not known.
        conditions: what makes errors larger, each column the larger the harder the patch; only the order counts.
        misplaced: standard deviation of each change by the registration, which comes on top and is not returned.
        centres_m: centres of the patches.

    Example:
        >>> random, hard = np.random.default_rng(0), np.arange(900.0)[:, None]
        >>> change = random.normal(size=(900, 1)) * np.where(hard < 800.0, 1.0, 5.0)
        >>> noise = noise_of_patches(change, hard, np.zeros((900, 1)), random.random((900, 3)))
        >>> bool(noise[880, 0] > 2.5 * noise[100, 0])
        True
    """
    known = np.isfinite(change).all(axis=1)
    rank = (rankdata(conditions, axis=0) - 0.5) / len(change) if conditions.size else conditions
    steps = [np.maximum(rank - knot, 0.0) / (1.0 - knot) for knot in _KNOTS]
    harder = np.concatenate(steps, axis=1)
    columns = [
        _noise(one[known], harder, known, off[known], centres_m[known])
        for one, off in zip(change.T, misplaced.T, strict=True)
    ]
    return np.stack(columns, axis=1)


def _noise(
    change: Float[np.ndarray, "n"],
    harder: Float[np.ndarray, "p s"],
    known: Float[np.ndarray, "p"],
    misplaced: Float[np.ndarray, "n"],
    centres_m: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "p"]:
    usual = biweight_scale(change)
    if harder[known].any():
        ratio = change / np.hypot(usual, misplaced)
        weight = correlation(ratio[:, None], centres_m)[1] / len(ratio)
        squares, off, steps = np.square(change / usual), np.square(misplaced / usual), harder[known]

        def unlikely(slopes: Float[np.ndarray, "1+s"]) -> tuple[float, Float[np.ndarray, "1+s"]]:
            own = np.exp(2.0 * (slopes[0] + steps @ slopes[1:]))
            variance = own + off
            tail = squares / (_TAILS * variance)
            value = 0.5 * np.log(variance) + (_TAILS + 1.0) / 2.0 * np.log1p(tail)
            rise = (1.0 - (_TAILS + 1.0) * tail / (1.0 + tail)) * own / variance
            gradient = weight * np.concatenate([[rise.sum()], rise @ steps])
            gradient[1:] += 1.0
            return weight * value.sum() + slopes[1:].sum(), gradient

        start = np.concatenate([[0.0], np.full(harder.shape[1], 0.1)])
        bounds = [(-_STEEPEST, _STEEPEST), *[(0.0, _STEEPEST)] * harder.shape[1]]
        found = minimize(unlikely, start, jac=True, bounds=bounds).x
        noise = usual * np.exp(found[0] + harder @ found[1:])
    else:
        noise = np.full(len(harder), usual)
    return np.maximum(noise * biweight_scale(change / np.hypot(noise[known], misplaced)), _ROUNDING)


def biweight_scale(values: Float[np.ndarray, "n"]) -> float:
    """Tukey's biweight midvariance as a standard deviation (Mosteller and Tukey 1977): outliers do not count.

    At least what rounding in files of single precision makes, which is no change.
    """
    off = values - np.median(values)
    within = 1.0 - np.square(off / max(_BIWEIGHT * np.median(np.abs(off)), 1e-12))
    kept = within > 0.0
    off, within = off[kept], within[kept]
    weight = np.sum(within * (5.0 * within - 4.0))
    variance = len(off) * np.sum(np.square(off) * within**4) / max(weight, 1e-12) ** 2
    return float(max(np.sqrt(variance), _ROUNDING))


def correlation(ratio: Float[np.ndarray, "n k"], centres_m: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Length over which changes of patches, in standard deviations, are alike, and how many are independent.

    The mean product of pairs over their distance falls to 1 / e at that length. For errors that decay exponentially
    the variance of a mean over n patches is that of ``n² / sum exp(-distance / length)`` independent ones.
    """
    if len(ratio) > _MOST_PATCHES:
        chosen = np.random.default_rng(0).choice(len(ratio), _MOST_PATCHES, replace=False)
        ratio, centres_m = ratio[chosen], centres_m[chosen]
    clipped = np.clip(ratio, -_CLIPPED, _CLIPPED)
    clipped = clipped - clipped.mean(axis=0)
    distance_m = cdist(centres_m, centres_m)
    product = clipped @ clipped.T / max(np.square(clipped).sum() / len(clipped), 1e-12)
    edges = np.arange(_BINS + 1) * PATCH_M + PATCH_M / 2.0
    each = np.digitize(distance_m.ravel(), edges)
    count = np.bincount(each, minlength=_BINS + 2)
    mean = np.bincount(each, product.ravel(), _BINS + 2) / np.maximum(count, 1)
    # Bin 0 holds each patch with itself; bin b the pairs about b patches apart.
    filled = np.flatnonzero(count[: _BINS + 1])
    at, value = filled * PATCH_M, np.concatenate([[1.0], mean[filled[1:]]])
    below = np.flatnonzero(value < np.exp(-1.0))
    last = int(below[0]) if len(below) else len(at) - 1
    high, low = value[last - 1], min(value[last], np.exp(-1.0))
    length_m = float(at[last - 1] + (at[last] - at[last - 1]) * (high - np.exp(-1.0)) / max(high - low, 1e-12))
    return length_m, float(len(ratio) ** 2 / np.exp(-distance_m / max(length_m, 1e-9)).sum())
