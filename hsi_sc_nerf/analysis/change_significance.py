"""Whether a part of a surface changed by more than the errors of two clouds, which are smooth over centimetres.

The errors of a cloud from a radiance field are biases that neighbours share and that differ from run to run. The
scatter of frames, which a cloud's columns state, does not show them. Their size is therefore a robust estimate from
the changes of most of the surface. The distance at which changes of patches are correlated gives the number of
independent parts of that estimate. The test is Student's (or Hotelling's), whose heavier tails account for the small
number of parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.change_noise import PATCH_M, correlation, noise_of_patches

FALSE_DISCOVERIES = 0.05
"""Expected fraction of the patches called changed that did not (Benjamini and Yekutieli 2001)."""
_BIWEIGHT_EFFICIENCY = 0.87
"""Efficiency of the biweight scale for normal errors: the fraction of the sample that counts."""
_NEAR_M = 0.015
"""Within this distance of a place, errors are of one size."""
_LARGEST = 2.0
"""The largest of some ten normal errors, in standard deviations."""
_OBSERVATIONS = 12.0
"""Largest number of observations that the noise of a patch in its own conditions counts as: few patches are like
it."""


@dataclass(frozen=True)
class Patches:
    """The seen surface in compact pieces of about one size.

    Attributes:
        of_vertex: number of the patch of each vertex, -1 where it is not seen.
        centres_m: centres of each patch.
        areas_m2: areas of each patch.
    """

    of_vertex: Int[np.ndarray, "v"]
    centres_m: Float[np.ndarray, "p 3"]
    areas_m2: Float[np.ndarray, "p"]

    def means(self, values: Float[np.ndarray, "v k"], areas_m2: Float[np.ndarray, "v"]) -> Float[np.ndarray, "p k"]:
        """Mean of the vertices' values over each patch, weighted by area; NaN where one is not finite."""
        seen = self.of_vertex >= 0
        at, weight = self.of_vertex[seen], areas_m2[seen]
        sums = [np.bincount(at, weight * column, len(self.areas_m2)) for column in values[seen].T]
        return np.stack(sums, axis=1) / self.areas_m2[:, None]


@dataclass(frozen=True)
class Significance:
    """Test of a change of each patch beyond that of the whole surface, and of the whole surface's.

    Attributes:
        p: probability of so large a change of each patch without one, adjusted for false discoveries; 1 if unknown.
        noise: standard deviation of the changes of a usual patch, of each of the tested numbers.
        length_m: distance at which the errors of two patches are correlated by 1 / e.
        independent: number of independent parts of the surface.
        whole: change of the whole surface (median over the patches).
        whole_sd: its standard deviation.
        whole_p: probability of so large a change without one.
    """

    p: Float[np.ndarray, "p"]
    noise: Float[np.ndarray, "k"]
    length_m: float
    independent: float
    whole: Float[np.ndarray, "k"]
    whole_sd: Float[np.ndarray, "k"]
    whole_p: float


def surface_patches(
    vertices_m: Float[np.ndarray, "v 3"], areas_m2: Float[np.ndarray, "v"], seen: Bool[np.ndarray, "v"]
) -> Patches:
    """Divide the seen vertices into patches: each belongs to the nearest centre of an occupied cube."""
    points = vertices_m[seen]
    if len(points) == 0:
        return Patches(np.full(len(vertices_m), -1), np.zeros((0, 3)), np.zeros(0))
    _, cube = np.unique(np.floor(points / PATCH_M).astype(int), axis=0, return_inverse=True)
    count = np.bincount(cube.ravel())
    seeds = np.stack([np.bincount(cube.ravel(), axis) for axis in points.T], axis=1) / count[:, None]
    # A cube that the surface only grazes makes no patch.
    nearest = cKDTree(seeds[count >= np.median(count) / 3.0]).query(points)[1]
    _, number = np.unique(nearest, return_inverse=True)
    of_vertex = np.full(len(vertices_m), -1)
    of_vertex[seen] = number.ravel()
    area = np.bincount(number.ravel(), areas_m2[seen])
    centres = [np.bincount(number.ravel(), areas_m2[seen] * axis) for axis in points.T]
    return Patches(of_vertex, np.stack(centres, axis=1) / area[:, None], area)


def significance(
    change: Float[np.ndarray, "p k"],
    centres_m: Float[np.ndarray, "p 3"],
    misplaced: Float[np.ndarray, "p k"],
    session_sd: Float[np.ndarray, "k"],
    conditions: Float[np.ndarray, "p c"] | None = None,
    repeat: Float[np.ndarray, "p k"] | None = None,
    rim: Bool[np.ndarray, "p"] | None = None,
    quantities: int = 1,
) -> Significance:
    """Test each patch's change against the errors that the changes of all patches show.

    The change of a patch is k numbers, such as principal components of its spectrum. Beyond the whole surface's, it
    has the variance ``noise² + misplaced²``, with the noise of patches under such conditions
    (`hsi_sc_nerf.analysis.change_noise.noise_of_patches`). T², the sum of the k squared ratios, is compared with
    Hotelling's distribution for as many observations as there are independent parts, or like patches.

    The changes ``repeat`` between two captures of one day are errors alone. No noise is less than the repeat's. This
    holds for the noise of all patches, for half of the largest error around a patch (for a patch at the rim of the
    seen surface, anywhere at the rim), and for the error that a whole session shares. Errors are as smooth as the
    smoother of the two. A patch has then changed if its change is significant in itself, and beyond that of the whole
    surface.

    Args:
        change: after less before, NaN where it is not known.
        centres_m: centres of the patches.
        misplaced: change of each patch that an error of the registration would make.
        session_sd: standard deviation of errors that a whole session shares.
        conditions: what makes the errors of a patch larger, each column the larger the harder; none by default.
        repeat: change of each patch from the first day to another capture of it, NaN where it is not known.
        rim: which patches lie at the rim of what is seen; none by default.
        quantities: of the same surface that are tested with this one. Each is held to its part of the false
            discoveries (Bonferroni), so that all of them together make no more.

    Example:
        >>> centres_m = np.random.default_rng(0).random((400, 3))
        >>> change = np.random.default_rng(1).normal(size=(400, 1))
        >>> change[0] = 30.0
        >>> found = significance(change, centres_m, np.zeros((400, 1)), np.zeros(1))
        >>> np.flatnonzero(found.p < FALSE_DISCOVERIES)
        array([0])
    """
    known = np.isfinite(change).all(axis=1)
    used, off, at_m, dimensions = change[known], misplaced[known], centres_m[known], change.shape[1]
    hard = np.zeros((len(change), 0))[known] if conditions is None else conditions[known]
    whole = np.median(used, axis=0)
    beyond = used - whole
    noise = noise_of_patches(beyond, hard, off, at_m)
    sd = np.hypot(noise, off)
    if repeat is None:
        length_m, independent = correlation(beyond / sd, at_m)
        squares = np.square(beyond / sd).sum(axis=1)
    else:
        both = np.isfinite(repeat[known]).all(axis=1)
        shared = np.median(repeat[known][both], axis=0)
        errors = repeat[known] - shared
        noise = np.maximum(noise, noise_of_patches(errors, hard, off, at_m))
        session_sd = np.maximum(session_sd, np.abs(shared))
        sd = np.hypot(noise, off)
        at_rim = np.zeros(len(used), bool) if rim is None else rim[known]
        sd *= np.maximum(_largest_around(errors / sd, at_m, both, at_rim) / _LARGEST, 1.0)
        found = correlation(beyond / sd, at_m), correlation((errors / sd)[both], at_m[both])
        length_m, independent = max(one for one, _ in found), min(one for _, one in found)
        in_itself = np.square(used / np.hypot(sd, session_sd)).sum(axis=1)
        squares = np.minimum(np.square(beyond / sd).sum(axis=1), in_itself)
    of_all = independent * _BIWEIGHT_EFFICIENCY
    of_like = min(of_all, _OBSERVATIONS) if hard.shape[1] else of_all
    p = np.ones(len(change))
    of_patches = hotelling_p(squares, dimensions, max(of_like, dimensions + 2.0))
    p[known] = np.minimum(quantities * stats.false_discovery_control(of_patches, method="by"), 1.0)
    # The median of normal errors has pi / 2 times the variance of the mean.
    usual = np.median(noise, axis=0)
    whole_sd = np.sqrt(np.pi / 2.0 * np.square(usual) / independent + np.square(session_sd))
    whole_p = hotelling_p(np.square(whole / whole_sd).sum(), dimensions, max(of_all, dimensions + 2.0))
    return Significance(p, usual, length_m, independent, whole, whole_sd, float(whole_p))


def _largest_around(
    ratio: Float[np.ndarray, "n k"],
    centres_m: Float[np.ndarray, "n 3"],
    known: Bool[np.ndarray, "n"],
    rim: Bool[np.ndarray, "n"],
) -> Float[np.ndarray, "n k"]:
    """Largest size of the known ratios around each patch, or at the whole rim; 0 where none is known."""
    size = np.where(known[:, None], np.abs(ratio), 0.0)
    around = cKDTree(centres_m).query_ball_point(centres_m, _NEAR_M)
    largest = np.stack([size[near].max(axis=0) for near in around])
    largest[rim] = np.maximum(largest[rim], size[rim].max(axis=0, initial=0.0))
    return largest


def hotelling_p(squares: Float[np.ndarray, "*n"], dimensions: int, observations: float) -> Float[np.ndarray, "*n"]:
    """p-value of T² (Hotelling 1931): the probability of a larger one.

    Args:
        dimensions: number of the values that T² combines.
        observations: number of observations that their variances are estimated from.
    """
    free = observations - 1.0
    last = free - dimensions + 1.0
    return stats.f.sf(squares * last / (dimensions * free), dimensions, last)
