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

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from hsi_sc_nerf.evaluation.band_scores import Image, Mask, Valid, band_scores, decibel, image_blocks
from hsi_sc_nerf.numerics import masked_mean, narrow, safe_sqrt, select_pixels, spectral_angle

MIN_BANDS_OF_AN_ANGLE = 2
"""A spectrum of a single band is a length: it has no direction that could differ."""


def _pixel_mean(
    values: Float[Tensor, "h w"], mask: Mask | None, weights: Shaped[Tensor, "h w"] | None
) -> Float[Tensor, ""]:
    """Weighted mean over the mask; what has weight 0 may be anything."""
    if weights is None:
        return masked_mean(values, mask)
    values, weights = select_pixels(torch.stack([values.double(), weights.double()], -1), mask).unbind(-1)
    return (torch.where(weights > 0, values, 0.0) * weights).sum() / weights.sum().clamp_min(1.0)


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
    angles = torch.cat([spectral_angle(p, t) for p, t, _ in image_blocks(predicted, target, valid, 0)])
    return angles if valid is None else torch.where(has_angle(valid), angles, torch.nan)


def squared_error_map(predicted: Image, target: Image, valid: Valid | None = None) -> Float[Tensor, "h w"]:
    """Mean squared error over the bands of each pixel, float64; NaN where none is valid."""
    return torch.cat(
        [
            (p.double() - t.double()).square().mean(-1)
            if v is None
            else (p.double() - t.double()).square().sum(-1) / count_bands(v)
            for p, t, v in image_blocks(predicted, target, valid, 0)
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


def spectral_metrics(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> dict[str, float]:
    """Every metric of one view, by name.

    ``sam`` (rad), ``rmse``, ``ssim`` and ``psnr`` (dB) are the paper's. ``psnr`` is a mean over bands, not of the
    mean error. ``ssim`` reads "moments computed over pixels in Omega" to the letter: one window, the whole of
    Omega, however the pixels lie. It asks whether the object's contrast is right as a whole; ``ssim_windowed`` asks
    whether details are in place (`windowed_scores`). ``rmse_pixel_mean``, the mean of each pixel's root, is what
    the paper's released code prints; it is never above ``rmse``, the text's, where all is valid.
    """
    return metrics_of_regions(predicted, target, {"": mask}, valid)


def metrics_of_regions(
    predicted: Image, target: Image, regions: Mapping[str, Mask | None], valid: Valid | None = None
) -> dict[str, float]:
    """`spectral_metrics` of several masks, each name after the mask's; the pixels are looked at once for all.

    Example:
        >>> metrics_of_regions(rendered, measured, {"": mask, "full_": None})["full_psnr"]
    """
    angles, squares = spectral_angle_map(predicted, target, valid), squared_error_map(predicted, target, valid)
    has_angles, number, has_any = None, None, None
    if valid is not None:
        has_angles, number, has_any = has_angle(valid), count_bands(valid), valid.any(-1)
    by_band = band_scores(predicted, target, list(regions.values()), valid)
    found: dict[str, float] = {}
    for (name, mask), (mse, similarity, windows) in zip(regions.items(), by_band, strict=True):
        values = {
            "sam": _pixel_mean(angles, mask, has_angles),
            "rmse": safe_sqrt(_pixel_mean(squares, mask, number)),
            "rmse_pixel_mean": _pixel_mean(safe_sqrt(squares), mask, has_any),
            "ssim": _mean_over_bands(similarity, mask, valid),
            "ssim_windowed": _mean_over_bands(windows, mask, valid),
            "psnr": _mean_over_bands(decibel(mse), mask, valid),
        }
        found |= {f"{name}{metric}": narrow(value, predicted).item() for metric, value in values.items()}
    return found


def count_bands(valid: Bool[Tensor, "*pixels bands"]) -> Int[Tensor, "*pixels"]:
    """How many bands of each pixel are valid."""
    # torch makes integers of this kind of all that it adds up: 64-bit ones of a whole image are half a gigabyte.
    return valid.sum(-1, dtype=torch.int16)


def has_angle(valid: Bool[Tensor, "*pixels bands"]) -> Bool[Tensor, "*pixels"]:
    """Pixels with bands enough to tell a spectral angle from."""
    return count_bands(valid) >= MIN_BANDS_OF_AN_ANGLE
