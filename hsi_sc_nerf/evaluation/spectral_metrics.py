"""Spectral metrics of the paper (section "Evaluation Metrics"), as pure functions on reflectance in [0, 1].

``predicted`` and ``target`` are images (h, w, bands); ``mask`` (h, w) selects the evaluated pixels Omega, all without
one. The arithmetic is float64, in blocks, so that a large cube needs little memory beside itself; results are float32
and finite for finite spectra.

``valid`` (h, w, bands) tells which values of the target are measurements, all without it. Whatever number stands at
the others counts nowhere: a pixel is judged by its valid bands, a band by its valid pixels.

**An empty mask** holds nothing that could differ: it scores like identical images (angle and errors 0, SSIM 1, PSNR
at its cap). That says nothing about a view; leave such a view out of a mean over views. So does a band without valid
pixels, which is therefore left out of means over bands, unless all are such.

Every function raises ValueError if the images differ in shape, if the mask is not boolean or not (h, w), or if
``valid`` is not boolean or not (h, w, bands).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from hsi_sc_nerf.numerics import masked_mean, narrow, safe_log10, safe_sqrt, select_pixels, spectral_angle

# The paper's delta under the logarithm has no printed value: this one caps the PSNR of identical bands at 100 dB.
PSNR_DELTA = 1e-10
# Stability constants of Wang et al. 2004 (K1 = 0.01, K2 = 0.03) for a dynamic range of 1, and their window.
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
SSIM_WINDOW_PX = 11
SSIM_WINDOW_SIGMA_PX = 1.5
# Values of one image in a block: 8 MiB a temporary in float64, of which there are some dozens.
_BLOCK_VALUES = 1 << 20
Image = Float[Tensor, "h w bands"]
Mask = Bool[Tensor, "h w"]
Valid = Bool[Tensor, "h w bands"]
MIN_BANDS_OF_AN_ANGLE = 2
"""A spectrum of a single band is a length: it has no direction that could differ."""


def _blocks(
    predicted: Tensor, target: Tensor, valid: Tensor | None, dim: int
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Both images in slices along ``dim``, 0 where not valid, and which of their values are."""
    if predicted.shape != target.shape:
        raise ValueError(f"the images differ in shape: {tuple(predicted.shape)} and {tuple(target.shape)}")
    step = max(1, _BLOCK_VALUES * predicted.shape[dim] // max(1, predicted.numel()))
    pairs = zip(predicted.split(step, dim), target.split(step, dim), strict=True)
    if valid is None:
        yield from ((p, t, None) for p, t in pairs)
    else:
        for (p, t), v in zip(pairs, valid.split(step, dim), strict=True):
            yield cleared(p, v), cleared(t, v), v


def _pixel_mean(
    values: Float[Tensor, "h w"], mask: Mask | None, weights: Shaped[Tensor, "h w"] | None
) -> Float[Tensor, ""]:
    """Weighted mean over the mask; what has weight 0 may be anything."""
    if weights is None:
        return masked_mean(values, mask)
    values, weights = select_pixels(torch.stack([values.double(), weights.double()], -1), mask).unbind(-1)
    return (torch.where(weights > 0, values, 0.0) * weights).sum() / weights.sum().clamp_min(1.0)


def _band_mean(values: Float[Tensor, "n bands"], valid: Bool[Tensor, "n bands"] | None) -> Float[Tensor, "bands"]:
    """Mean of each band over its valid pixels, of values that are 0 elsewhere; 0 without any."""
    if valid is None:
        return values.sum(0) / max(values.shape[0], 1)
    return values.sum(0) / valid.sum(0, dtype=torch.int32).clamp_min(1)


def _mean_over_bands(scores: Float[Tensor, "bands"], mask: Mask | None, valid: Valid | None) -> Float[Tensor, ""]:
    """Mean over the bands that have a valid pixel in the mask; over all where none has."""
    if valid is None:
        return scores.mean()
    measured = select_pixels(valid, mask).any(0)
    return scores[measured].mean() if measured.any() else scores.mean()


def spectral_angle_map(predicted: Image, target: Image, valid: Valid | None = None) -> Float[Tensor, "h w"]:
    """The angle between the spectra of each pixel, radians in [0, pi]; pi / 2 where either spectrum is zero.

    NaN where a pixel has fewer than two valid bands.
    """
    angles = torch.cat([spectral_angle(p, t) for p, t, _ in _blocks(predicted, target, valid, 0)])
    return angles if valid is None else torch.where(has_angle(valid), angles, torch.nan)


def squared_error_map(predicted: Image, target: Image, valid: Valid | None = None) -> Float[Tensor, "h w"]:
    """Mean squared error over the bands of each pixel, float64; NaN where none is valid."""
    return torch.cat(
        [
            (p.double() - t.double()).square().mean(-1)
            if v is None
            else (p.double() - t.double()).square().sum(-1) / count_bands(v)
            for p, t, v in _blocks(predicted, target, valid, 0)
        ]
    )


def spectral_angle_mapper(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, ""]:
    """Mean over pixels of the angle between the spectra, radians (paper, SAM; Kruse et al. 1993).

    A pixel whose spectrum is zero on either side counts pi / 2, which is what the paper's delta makes of it. One with
    fewer than two valid bands is left out.
    """
    angles = spectral_angle_map(predicted, target, valid)
    return narrow(_pixel_mean(angles, mask, None if valid is None else has_angle(valid)), predicted)


def spectral_rmse(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, ""]:
    """Root of the squared error's mean over pixels and bands (paper, spectral RMSE); valid values count alike."""
    squares = squared_error_map(predicted, target, valid)
    return narrow(safe_sqrt(_pixel_mean(squares, mask, None if valid is None else count_bands(valid))), predicted)


def pixel_mean_rmse(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, ""]:
    """Mean over pixels of each pixel's root mean squared error over the bands.

    This is what the paper's released code prints as RMSE; it is never above ``spectral_rmse``, the text's, where all
    is valid. A pixel without valid bands is left out.
    """
    roots = safe_sqrt(squared_error_map(predicted, target, valid))
    return narrow(_pixel_mean(roots, mask, None if valid is None else valid.any(-1)), predicted)


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
        for p, t, v in _blocks(predicted, target, valid, -1)
    ]
    return torch.cat(scores)


def per_band_mse(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, "bands"]:
    """Mean squared error over the pixels of each band, float64 (paper, MSE_b)."""
    return _over_pixels(lambda p, t, v: _band_mean((p - t).square(), v), predicted, target, mask, valid)


def per_band_psnr(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, "bands"]:
    """Peak signal-to-noise ratio of each band, dB, for a peak of 1; at most ``-10 log10(PSNR_DELTA)`` = 100 dB."""
    return narrow(-10.0 * safe_log10(per_band_mse(predicted, target, mask, valid) + PSNR_DELTA), predicted)


def psnr(predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None) -> Float[Tensor, ""]:
    """Mean over bands of ``per_band_psnr`` (paper, PSNR_HSI): not the PSNR of the mean error."""
    return _mean_over_bands(per_band_psnr(predicted, target, mask, valid), mask, valid)


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


def per_band_ssim(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, "bands"]:
    """SSIM of each band with means, variances and covariance over all the pixels of the mask: one window."""
    return narrow(_over_pixels(_ssim_over_pixels, predicted, target, mask, valid), predicted)


def ssim(predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None) -> Float[Tensor, ""]:
    """Structural similarity, mean over bands, with moments "computed over pixels in Omega" (paper, SSIM_HSI).

    Read to the letter: one window, the whole of Omega, however the pixels lie. It asks whether the object's contrast
    is right as a whole, not whether details are in place; ``windowed_ssim`` does that.
    """
    return _mean_over_bands(per_band_ssim(predicted, target, mask, valid), mask, valid)


def _gaussian_weights(size: int, centres: Tensor) -> Float[Tensor, "centres size"]:
    """One row a centre: the window's weights over a line of ``size`` pixels, cut at its ends and summing to 1."""
    distance = torch.arange(size, dtype=torch.float64, device=centres.device) - centres[:, None]
    weights = torch.exp(-0.5 * (distance / SSIM_WINDOW_SIGMA_PX).square())
    weights = torch.where(distance.abs() <= SSIM_WINDOW_PX // 2, weights, 0.0)
    return weights / weights.sum(1, keepdim=True)


def per_band_windowed_ssim(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, "bands"]:
    """``windowed_ssim`` of each band."""
    height, width, bands = predicted.shape
    if mask is None:
        mask = torch.ones(height, width, dtype=torch.bool, device=predicted.device)
    if len(select_pixels(predicted[..., :1], mask)) == 0:
        return narrow(predicted.new_ones(bands), predicted)
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    weights_rows, weights_columns = _gaussian_weights(height, rows), _gaussian_weights(width, columns)
    centres = mask[rows][:, columns]

    def window_sum(values: Float[Tensor, "some h w"]) -> Float[Tensor, "some rows columns"]:
        return weights_rows @ (values @ weights_columns.T)

    scores = []
    for some_p, some_t, some_valid in _blocks(predicted, target, valid, -1):
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
    return narrow(torch.cat(scores), predicted)


def windowed_ssim(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> Float[Tensor, ""]:
    """Mean SSIM over 11 x 11 Gaussian windows (sigma 1.5 px) and bands: the usual index of Wang et al. 2004.

    A window counts if its centre lies in the mask and is valid; what it covers may lie outside the mask. At the
    image's border the window is cut, values that are not valid are cut out of it, and its weights are scaled to sum
    to 1, so that every valid pixel is a centre. The paper's formula, ``ssim``, takes the moments over all pixels at
    once instead.
    """
    return _mean_over_bands(per_band_windowed_ssim(predicted, target, mask, valid), mask, valid)


def spectral_metrics(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> dict[str, float]:
    """Every metric of one view, by name.

    ``sam`` (rad), ``rmse``, ``ssim`` and ``psnr`` (dB) are the paper's; ``rmse_pixel_mean`` and ``ssim_windowed`` are
    other usual readings of the same names.
    """
    metrics = {
        "sam": spectral_angle_mapper,
        "rmse": spectral_rmse,
        "rmse_pixel_mean": pixel_mean_rmse,
        "ssim": ssim,
        "ssim_windowed": windowed_ssim,
        "psnr": psnr,
    }
    return {name: metric(predicted, target, mask, valid).item() for name, metric in metrics.items()}


def cleared(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``values``, 0 where they are not valid: what stood there, NaN included, touches neither values nor gradients.

    Raises:
        ValueError: ``valid`` is not boolean or of another shape.
    """
    if valid.dtype != torch.bool or valid.shape != values.shape:
        raise ValueError(
            f"the validity of values of shape {tuple(values.shape)} is boolean with that shape, not {valid.dtype} "
            f"with shape {tuple(valid.shape)}"
        )
    return torch.where(valid, values, 0.0)


def count_bands(valid: Bool[Tensor, "*pixels bands"]) -> Int[Tensor, "*pixels"]:
    """How many bands of each pixel are valid."""
    # torch makes integers of this kind of all that it adds up: 64-bit ones of a whole image are half a gigabyte.
    return valid.sum(-1, dtype=torch.int16)


def has_angle(valid: Bool[Tensor, "*pixels bands"]) -> Bool[Tensor, "*pixels"]:
    """Pixels with bands enough to tell a spectral angle from."""
    return count_bands(valid) >= MIN_BANDS_OF_AN_ANGLE
