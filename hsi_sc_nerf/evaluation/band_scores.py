"""Scores of each band of a view: mean squared error, peak signal-to-noise ratio, structural similarity.

Arguments are those of `spectral_metrics`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.numerics import check_mask, safe_log10, select_pixels

# The paper's delta under the logarithm has no printed value: this one caps the PSNR of identical bands at 100 dB.
PSNR_DELTA = 1e-10
# Stability constants of Wang et al. 2004 (K1 = 0.01, K2 = 0.03) for a dynamic range of 1, and their window.
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
SSIM_WINDOW_PX = 11
SSIM_WINDOW_SIGMA_PX = 1.5


# Values of one image in a block: 8 MiB a temporary in float64, of which there are some dozens.
BLOCK_VALUES = 1 << 20
Image = Float[Tensor, "h w bands"]
Mask = Bool[Tensor, "h w"]
Valid = Bool[Tensor, "h w bands"]


def band_scores(
    predicted: Image, target: Image, masks: Sequence[Mask | None], valid: Valid | None = None
) -> list[tuple[Float[Tensor, "bands"], Float[Tensor, "bands"], Float[Tensor, "bands"]]]:
    """`moment_scores` and `windowed_scores` over each of several masks."""
    windowed = windowed_scores(predicted, target, masks, valid)
    by_mask = moment_scores(predicted, target, masks, valid)
    return [(*scores, windows) for scores, windows in zip(by_mask, windowed, strict=True)]


def moment_scores(
    predicted: Image, target: Image, masks: Sequence[Mask | None], valid: Valid | None = None
) -> list[tuple[Float[Tensor, "bands"], Float[Tensor, "bands"]]]:
    """Mean squared error (paper, MSE_b) and SSIM of each band over each of several masks, float64.

    SSIM takes means, variances and covariance over all the pixels of the mask: one window.
    """
    if _is_compiled(predicted, target):
        from hsi_sc_nerf.evaluation import band_moments_cpu  # compiles; a GPU does without it

        found = torch.from_numpy(band_moments_cpu.moments(*_for_loops(predicted, target, masks, valid)))
        return list(zip(found[5], _ssim(*found[:5]), strict=True))
    return [
        (
            _over_pixels(lambda p, t, v: _band_mean((p - t).square(), v), predicted, target, mask, valid),
            _over_pixels(_ssim_over_pixels, predicted, target, mask, valid),
        )
        for mask in masks
    ]


def windowed_scores(
    predicted: Image, target: Image, masks: Sequence[Mask | None], valid: Valid | None = None
) -> list[Float[Tensor, "bands"]]:
    """SSIM of each band over 11 x 11 Gaussian windows (sigma 1.5 px), float64: the usual index of Wang et al. 2004.

    A window counts if its centre lies in the mask and is valid; what it covers may lie outside the mask. At the
    image's border the window is cut, values that are not valid are cut out of it, and its weights are scaled to sum
    to 1, so that every valid pixel is a centre.
    """
    if _is_compiled(predicted, target):
        from hsi_sc_nerf.evaluation import band_moments_cpu

        taps = _gaussian_weights(SSIM_WINDOW_PX, torch.tensor([SSIM_WINDOW_PX // 2]))[0].numpy()
        loops = _for_loops(predicted, target, masks, valid)
        counts, sums = map(torch.from_numpy, band_moments_cpu.window_scores(*loops, taps, (SSIM_C1, SSIM_C2)))
        return list(torch.where(counts > 0, sums / counts.clamp_min(1), 1.0))
    return [_windowed_score(predicted, target, mask, valid) for mask in masks]


def _windowed_score(
    predicted: Image, target: Image, mask: Mask | None, valid: Valid | None
) -> Float[Tensor, "bands"]:
    height, width, bands = predicted.shape
    if mask is None:
        mask = torch.ones(height, width, dtype=torch.bool, device=predicted.device)
    if len(select_pixels(predicted[..., :1], mask)) == 0:
        return predicted.new_ones(bands).double()
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    weights_rows, weights_columns = _gaussian_weights(height, rows), _gaussian_weights(width, columns)
    centres = mask[rows][:, columns]

    def window_sum(values: Float[Tensor, "some h w"]) -> Float[Tensor, "some rows columns"]:
        return weights_rows @ (values @ weights_columns.T)

    scores = []
    for some_p, some_t, some_valid in image_blocks(predicted, target, valid, -1):
        p, t = some_p.double().movedim(-1, 0), some_t.double().movedim(-1, 0)
        moments = [window_sum(values) for values in (p, t, p.square(), t.square(), p * t)]
        if some_valid is not None:
            # What is not valid is 0 and added nothing: the rest's weights are scaled to sum to 1.
            weight = window_sum(some_valid.double().movedim(-1, 0)).clamp_min(torch.finfo(torch.float64).tiny)
            moments = [moment / weight for moment in moments]
        mean_p, mean_t, square_p, square_t, product = moments
        local = _ssim(
            mean_p, mean_t, square_p - mean_p.square(), square_t - mean_t.square(), product - mean_p * mean_t
        )[:, centres].T
        if some_valid is None:
            scores.append(local.mean(0))
        else:
            at_centres = some_valid[mask]
            scores.append(torch.where(at_centres.any(0), _band_mean(cleared(local, at_centres), at_centres), 1.0))
    return torch.cat(scores)


def decibel(mse: Float[Tensor, "bands"]) -> Float[Tensor, "bands"]:
    """Peak signal-to-noise ratio of mean squared errors, dB, for a peak of 1; at most ``-10 log10(PSNR_DELTA)``."""
    return -10.0 * safe_log10(mse + PSNR_DELTA)


def _over_pixels(
    band_score: Callable[[Tensor, Tensor, Tensor | None], Tensor],
    predicted: Tensor,
    target: Tensor,
    mask: Tensor | None,
    valid: Tensor | None,
) -> Float[Tensor, "bands"]:
    """A score of each band from its selected pixels: ``band_score`` gets (n, some bands) of both and of ``valid``."""
    scores = [
        band_score(
            select_pixels(p, mask).double(),
            select_pixels(t, mask).double(),
            None if v is None else select_pixels(v, mask),
        )
        for p, t, v in image_blocks(predicted, target, valid, -1)
    ]
    return torch.cat(scores)


def _band_mean(values: Float[Tensor, "n bands"], valid: Bool[Tensor, "n bands"] | None) -> Float[Tensor, "bands"]:
    """Mean of each band over its valid pixels, of values that are 0 elsewhere; 0 without any."""
    if valid is None:
        return values.sum(0) / max(values.shape[0], 1)
    return values.sum(0) / valid.sum(0, dtype=torch.int32).clamp_min(1)


def _ssim(mean_p: Tensor, mean_t: Tensor, variance_p: Tensor, variance_t: Tensor, covariance: Tensor) -> Tensor:
    """SSIM from the moments (Wang et al. 2004, Eq. 13), in [-1, 1] even where rounding has bent the moments."""
    variance_p, variance_t = variance_p.clamp_min(0), variance_t.clamp_min(0)
    bound = (variance_p * variance_t).sqrt()
    covariance = covariance.clamp(-bound, bound)
    luminance = (2 * mean_p * mean_t + SSIM_C1) / (mean_p.square() + mean_t.square() + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_p + variance_t + SSIM_C2)


def _ssim_over_pixels(
    p: Float[Tensor, "n bands"], t: Float[Tensor, "n bands"], valid: Bool[Tensor, "n bands"] | None
) -> Float[Tensor, "bands"]:
    mean_p, mean_t = _band_mean(p, valid), _band_mean(t, valid)
    p, t = p - mean_p, t - mean_t
    if valid is not None:
        p, t = cleared(p, valid), cleared(t, valid)
    variance_p, variance_t = _band_mean(p.square(), valid), _band_mean(t.square(), valid)
    return _ssim(mean_p, mean_t, variance_p, variance_t, _band_mean(p * t, valid))


def _gaussian_weights(size: int, centres: Tensor) -> Float[Tensor, "centres size"]:
    """One row a centre: the window's weights over a line of ``size`` pixels, cut at its ends and summing to 1."""
    distance = torch.arange(size, dtype=torch.float64, device=centres.device) - centres[:, None]
    weights = torch.exp(-0.5 * (distance / SSIM_WINDOW_SIGMA_PX).square())
    weights = torch.where(distance.abs() <= SSIM_WINDOW_PX // 2, weights, 0.0)
    return weights / weights.sum(1, keepdim=True)


def _is_compiled(predicted: Image, target: Image) -> bool:
    """Whether images are such as compiled loops take: those of the processor, in single precision."""
    return all(image.device.type == "cpu" and image.dtype == torch.float32 for image in (predicted, target))


def _for_loops(
    predicted: Image, target: Image, masks: Sequence[Mask | None], valid: Valid | None
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """The images and all masks as `band_moments_cpu` takes them."""
    check_shapes(predicted, target)
    if valid is not None:
        check_valid(target, valid)
    for mask in masks:
        if mask is not None:
            check_mask(predicted, mask)
    flags = torch.zeros(0, 0, 0, dtype=torch.bool) if valid is None else valid
    whole = torch.ones(predicted.shape[:2], dtype=torch.bool)
    chosen = np.stack([(whole if mask is None else mask).numpy() for mask in masks])
    first, second, third = (image.contiguous().numpy(force=True) for image in (predicted, target, flags))
    return (first, second, third), chosen


def image_blocks(
    predicted: Tensor, target: Tensor, valid: Tensor | None, dim: int
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Both images in slices along ``dim``, 0 where not valid, and which of their values are."""
    check_shapes(predicted, target)
    step = max(1, BLOCK_VALUES * predicted.shape[dim] // max(1, predicted.numel()))
    pairs = zip(predicted.split(step, dim), target.split(step, dim), strict=True)
    if valid is None:
        yield from ((p, t, None) for p, t in pairs)
    else:
        for (p, t), v in zip(pairs, valid.split(step, dim), strict=True):
            yield cleared(p, v), cleared(t, v), v


def check_shapes(predicted: Tensor, target: Tensor) -> None:
    """Raise ValueError where the images differ in shape."""
    if predicted.shape != target.shape:
        raise ValueError(f"the images differ in shape: {tuple(predicted.shape)} and {tuple(target.shape)}")


def cleared(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``values``, 0 where they are not valid: what stood there, NaN included, touches neither values nor gradients.

    Raises:
        ValueError: ``valid`` is not boolean or of another shape.
    """
    check_valid(values, valid)
    return torch.where(valid, values, 0.0)


def check_valid(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> None:
    """Raise ValueError where the validity is not boolean, or its shape is not that of the values."""
    if valid.dtype != torch.bool or valid.shape != values.shape:
        raise ValueError(
            f"the validity of values of shape {tuple(values.shape)} is boolean with that shape, not {valid.dtype} "
            f"with shape {tuple(valid.shape)}"
        )
