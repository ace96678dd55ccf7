"""Mean squared error and structural similarity of two images by band, as compiled loops over the processor's cores.

A tensor library would write every moment of every window to memory in float64. Here a line of windows is kept, and
the bands of a pixel, which lie side by side, are worked on at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.compiled import compiled

SSIM_STABILITY = (0.01**2, 0.03**2)
"""Constants of Wang et al. 2004 (K1 = 0.01, K2 = 0.03) for a dynamic range of 1."""
SSIM_WINDOW_PX = 11
SSIM_WINDOW_SIGMA_PX = 1.5
_BANDS_AT_ONCE = 32
"""Bands whose window sums of a line of pixels are kept at a time: they fit into a processor's cache."""

Images = tuple[Float[np.ndarray, "h w bands"], Float[np.ndarray, "h w bands"], Bool[np.ndarray, "h w bands"]]
"""Predicted, target, and which values of the target count; the last has no pixels where all do."""
BandScore = Float[np.ndarray, "masks bands"]


def moment_scores(
    images: Images, masks: Bool[np.ndarray, "masks h w"]
) -> tuple[Int[np.ndarray, "masks bands"], BandScore, BandScore]:
    """Scores over the valid pixels of each mask as one window; `spectral_metrics.band_arrays` gives the arguments.

    Returns:
        Numbers of these pixels, mean squared error (paper, MSE_b; 0 without any pixel), and SSIM (1 without any).
    """
    means = np.zeros((2, len(masks), images[0].shape[2]))
    # Deviations from the means keep large offsets from cancelling.
    for _ in range(2):
        parts = _in_parts(_add_deviations, images, masks, means)
        pixels, sums = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        moments = sums / np.maximum(pixels, 1)
        means += moments[:2]
    variance_p, variance_t, covariance, mse = moments[2:]
    return pixels, mse, _similarity.py_func(means[0], means[1], variance_p, variance_t, covariance)


def windowed_scores(images: Images, masks: Bool[np.ndarray, "masks h w"]) -> BandScore:
    """Mean SSIM of the Gaussian windows around the valid pixels of each mask (Wang et al. 2004); 1 without any.

    What a window covers may lie outside the mask. At the image's border it is cut, values that are not valid are cut
    out of it, and its weights are scaled to sum to 1.
    """
    from_middle = np.arange(SSIM_WINDOW_PX) - SSIM_WINDOW_PX // 2
    taps = np.exp(-0.5 * (from_middle / SSIM_WINDOW_SIGMA_PX) ** 2)
    counts, sums = np.zeros((2, len(masks), images[0].shape[2]))
    for part_counts, part_sums in _in_parts(_add_windows, images, masks, taps / taps.sum()):
        counts += part_counts
        sums += part_sums[0]
    return np.where(counts > 0, sums / np.maximum(counts, 1), 1.0)


def _in_parts(
    kernel: Callable[..., None], images: Images, masks: np.ndarray, *arguments: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Numbers of pixels and sums of each part of the lines; a thread of torch's number works on each part."""
    shape = masks.shape[0], images[0].shape[2]
    parts = max(1, min(torch.get_num_threads(), images[0].shape[0]))
    edges = np.linspace(0, images[0].shape[0], parts + 1).astype(int)

    def work(part: int) -> tuple[np.ndarray, np.ndarray]:
        found = np.zeros(shape, np.int64), np.zeros((6, *shape))
        kernel(images, masks, *arguments, edges[part], edges[part + 1], *found)
        return found

    if parts == 1:
        return [work(0)]
    with ThreadPoolExecutor(parts) as pool:
        return list(pool.map(work, range(parts)))


@compiled
def _add_deviations(images, masks, means, first, last, counts, sums):
    """Add p, t, p², t², p t and the squared error, where p and t are deviations from the means."""
    predicted, target, valid = images
    for m in range(len(masks)):
        for y in range(first, last):
            for x in range(predicted.shape[1]):
                if masks[m, y, x]:
                    for b in range(predicted.shape[2]):
                        if len(valid) == 0 or valid[y, x, b]:
                            p, t = np.float64(predicted[y, x, b]), np.float64(target[y, x, b])
                            error = p - t
                            p -= means[0, m, b]
                            t -= means[1, m, b]
                            counts[m, b] += 1
                            sums[0, m, b] += p
                            sums[1, m, b] += t
                            sums[2, m, b] += p * p
                            sums[3, m, b] += t * t
                            sums[4, m, b] += p * t
                            sums[5, m, b] += error * error


@compiled
def _add_windows(images, masks, taps, first, last, counts, sums):
    """SSIM over the windows of some lines; the kept sums are those of p, t, p², t², p t and of what is valid."""
    valid = images[2]
    _, width, bands = images[0].shape
    reach = len(taps) // 2
    down = np.empty((width, 6, _BANDS_AT_ONCE))
    window = np.empty((6, _BANDS_AT_ONCE))
    score = np.empty(_BANDS_AT_ONCE)
    for y in range(first, last):
        left, right = _extent(masks[:, y])
        if left == right:
            continue
        for start in range(0, bands, _BANDS_AT_ONCE):
            some = min(_BANDS_AT_ONCE, bands - start)
            for x in range(max(left - reach, 0), min(right + reach, width)):
                _sum_down(images, taps, y, x, start, some, down[x])
            for x in range(left, right):
                if not masks[:, y, x].any():
                    continue
                _sum_across(down, taps, x, some, window)
                _score(window, some, score)
                for m in range(len(masks)):
                    if masks[m, y, x]:
                        for k in range(some):
                            if len(valid) == 0 or valid[y, x, start + k]:
                                counts[m, start + k] += 1
                                sums[0, m, start + k] += score[k]


@compiled
def _extent(lines):
    """First and end of the pixels of a line that lie in some mask."""
    left, right = lines.shape[1], 0
    for x in range(lines.shape[1]):
        if lines[:, x].any():
            left, right = min(left, x), x + 1
    return min(left, right), right


@compiled
def _sum_down(images, taps, y, x, start, some, sums):
    predicted, target, valid = images
    reach = len(taps) // 2
    sums[:, :some] = 0.0
    for line in range(max(y - reach, 0), min(y + reach + 1, predicted.shape[0])):
        weight = taps[line - y + reach]
        ps, ts = predicted[line, x, start : start + some], target[line, x, start : start + some]
        for k in range(some):
            counts = len(valid) == 0 or valid[line, x, start + k]
            # What stands where it is not valid, NaN included, counts nowhere.
            p, t = np.float64(ps[k]) if counts else 0.0, np.float64(ts[k]) if counts else 0.0
            sums[0, k] += weight * p
            sums[1, k] += weight * t
            sums[2, k] += weight * p * p
            sums[3, k] += weight * t * t
            sums[4, k] += weight * p * t
            sums[5, k] += weight if counts else 0.0


@compiled
def _sum_across(down, taps, x, some, window):
    reach = len(taps) // 2
    window[:, :some] = 0.0
    for sample in range(max(x - reach, 0), min(x + reach + 1, len(down))):
        weight = taps[sample - x + reach]
        for moment in range(6):
            for k in range(some):
                window[moment, k] += weight * down[sample, moment, k]


@compiled
def _score(window, some, score):
    for k in range(some):
        total = window[5, k]
        mean_p, mean_t = window[0, k] / total, window[1, k] / total
        variance_p, variance_t = window[2, k] / total - mean_p * mean_p, window[3, k] / total - mean_t * mean_t
        score[k] = _similarity(mean_p, mean_t, variance_p, variance_t, window[4, k] / total - mean_p * mean_t)


@compiled
def _similarity(mean_p, mean_t, variance_p, variance_t, covariance):
    """SSIM (Wang et al. 2004, Eq. 13), in [-1, 1] even where rounding has bent the moments."""
    variance_p, variance_t = np.maximum(variance_p, 0.0), np.maximum(variance_t, 0.0)
    bound = np.sqrt(variance_p * variance_t)
    covariance = np.minimum(np.maximum(covariance, -bound), bound)
    c1, c2 = SSIM_STABILITY
    luminance = (2.0 * mean_p * mean_t + c1) / (mean_p * mean_p + mean_t * mean_t + c1)
    return luminance * (2.0 * covariance + c2) / (variance_p + variance_t + c2)
