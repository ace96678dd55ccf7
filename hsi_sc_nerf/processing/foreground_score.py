"""Foreground score: the part of a spectrum that the background's spectra cannot explain.

Flat spectra (Teflon, paper, ink) and the principal components of the surroundings' spectra span a subspace. The score
is what is left of a spectrum after its projection on to that subspace (orthogonal subspace projection; J. C. Harsanyi
and C.-I. Chang, IEEE Trans. Geoscience and Remote Sensing 32, 1994). The score of a mixed pixel is nearly the
object's score times its fraction.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16
from skimage.filters import threshold_otsu

SPECTRAL_BINS = 24
"""Neighbouring bands are averaged into this number of bins, or a few less, before the score: it reduces noise."""
SMOOTHING_PX = 0.5
"""Standard deviation of the Gaussian that smooths the bins over neighbouring pixels."""
MAX_COMPONENTS = 6
"""Largest number of principal components of the background: boards with two paints have three."""
BORDER_FRACTION = 1 / 8
"""Width of the margins that show the background where the container is not known, of the image's shorter side."""
# The smallest subspace is taken that separates object and background by this fraction of the best.
_OF_BEST_SEPARATION = 0.8
_SAMPLED_PIXELS = 200_000
# Components of a smaller standard deviation of reflectance are rounding.
_MIN_DEVIATION = 0.002
_HISTOGRAM_BINS = 512


def foreground_score(
    bins: Float[np.ndarray, "bins h w"], background: Float[np.ndarray, "bins rank"]
) -> Float[np.ndarray, "h w"]:
    """Root mean square over bins of what is left of each spectrum outside of the background's subspace.

    Args:
        background: orthonormal columns (`background_subspace`).

    Example:
        >>> background = background_subspace(bins_of_frames)
        >>> scores = [foreground_score(bins, background) for bins in bins_of_frames]
    """
    spectra = bins.reshape(len(bins), -1).astype(np.float32)
    columns = background.astype(np.float32)
    spectra -= columns @ (columns.T @ spectra)
    return np.sqrt(np.mean(spectra**2, axis=0)).reshape(bins.shape[1:])


def spectral_bin_width(bands: int) -> int:
    """Number of neighbouring bands in a bin, so that there are `SPECTRAL_BINS` or fewer bins of one width."""
    return -(-bands // SPECTRAL_BINS)


def smoothed_bins(binned: Float[np.ndarray, "bins h w"]) -> Float16[np.ndarray, "bins h w"]:
    """Slightly smoothed bins of a frame, as small as they are kept."""
    return np.stack([cv2.GaussianBlur(image, (0, 0), SMOOTHING_PX) for image in binned]).astype(np.float16)


def background_subspace(
    bins: Sequence[Float[np.ndarray, "bins h w"]], regions: Bool[np.ndarray, "frames h w"] | None = None
) -> Float[np.ndarray, "bins rank"]:
    """Orthonormal basis of flat spectra and of the smallest number of components that separates the object well.

    Args:
        bins: bins of each frame (`smoothed_bins`).
        regions: pixels of each frame that may be the object's; the background is learned from the others. Without
            them it is learned from the margins on the left and on the right.
    """
    shape = bins[0].shape[1:]
    margin = np.ones(shape, bool)
    width = max(1, round(BORDER_FRACTION * min(shape)))
    margin[:, width:-width] = False  # the object may reach the top
    step = max(1, len(bins) * margin.size // _SAMPLED_PIXELS)
    spectra, outside = [], []
    for index, image in enumerate(bins):
        chosen = slice(index % step, None, step)
        spectra.append(image.reshape(len(image), -1)[:, chosen].T.astype(np.float64))
        outside.append((margin if regions is None else ~regions[index]).reshape(-1)[chosen])
    sample = np.concatenate(spectra)
    surroundings = sample[np.concatenate(outside)]
    flat = np.full((sample.shape[1], 1), sample.shape[1] ** -0.5)
    if len(surroundings) == 0:
        return flat
    uneven = surroundings - surroundings.mean(axis=1, keepdims=True)
    variances, components = np.linalg.eigh(uneven.T @ uneven / len(uneven))
    most = min(MAX_COMPONENTS, max(0, len(flat) // 2 - 1))
    components = components[:, variances > _MIN_DEVIATION**2][:, ::-1][:, :most]
    basis = np.concatenate([flat, components], axis=1)
    ranks = range(1, basis.shape[1] + 1)
    separations = [otsu_threshold([foreground_score(sample.T[..., None], basis[:, :rank])])[2] for rank in ranks]
    good = np.array(separations) >= _OF_BEST_SEPARATION * max(separations)
    return basis[:, : ranks[int(np.argmax(good))]]


def otsu_threshold(scores: Sequence[Float[np.ndarray, "h w"]]) -> tuple[float, float, float]:
    """Otsu's threshold over all frames together, and how far apart the two classes are.

    Args:
        scores: scores of each frame, 0 or more.

    Returns:
        The threshold; the difference of the classes' means (0 for equal scores); and that difference over the
        standard deviation of the lower class.
    """
    top = max(float(score.max()) for score in scores)
    if not top > 0.0:
        return 0.0, 0.0, 0.0
    counts = np.sum([np.histogram(score, bins=_HISTOGRAM_BINS, range=(0.0, top))[0] for score in scores], axis=0)
    centres = (np.arange(_HISTOGRAM_BINS) + 0.5) * top / _HISTOGRAM_BINS
    threshold = threshold_otsu(hist=(counts, centres))
    high = centres > threshold
    if not counts[high].any() or not counts[~high].any():
        return float(threshold), 0.0, 0.0
    low_mean, high_mean = (np.average(centres[part], weights=counts[part]) for part in (~high, high))
    variance = np.average((centres[~high] - low_mean) ** 2, weights=counts[~high])
    contrast = float(high_mean - low_mean)
    # The middle of the gap between two clear classes.
    threshold = (threshold + centres[high & (counts > 0)][0]) / 2.0
    # Scores within one bin of the histogram scatter by its width.
    return float(threshold), contrast, contrast / float(np.sqrt(variance + (top / _HISTOGRAM_BINS) ** 2 / 12.0))
