"""Spectral metrics of the paper (section "Evaluation Metrics"), as pure functions on reflectance in [0, 1].

``predicted`` and ``target`` are images (h, w, bands); ``mask`` (h, w) selects the evaluated pixels Omega, all without
one. The arithmetic is float64, in blocks, so that a large cube needs little memory beside itself; results are float32
and finite for finite spectra, where there is anything to judge.

``valid`` (h, w, bands) tells which values of the target are measurements, all without it. Whatever number stands at
the others counts nowhere: a pixel is judged by its valid bands, a band by its valid pixels.

**An empty mask** holds nothing that could be judged: every score is NaN, as it is where no value is valid. A band
without valid pixels is left out of means over bands.

Every function raises ValueError if the images differ in shape, if the mask is not boolean or not (h, w), or if
``valid`` is not boolean or not (h, w, bands).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from hsi_sc_nerf.numerics import check_mask, narrow, safe_sqrt, select_pixels, spectral_angle

# The paper's delta under the logarithm has no printed value: this one caps the PSNR of identical bands at 100 dB.
PSNR_DELTA = 1e-10
MIN_BANDS_OF_AN_ANGLE = 2
"""A spectrum of a single band is a length: it has no direction that could differ."""
BLOCK_VALUES = 1 << 20
"""Values of one image in a block: 8 MiB a temporary in float64, of which there are some dozens."""
Image = Float[Tensor, "h w bands"]
Mask = Bool[Tensor, "h w"]
Valid = Bool[Tensor, "h w bands"]


def spectral_metrics(
    predicted: Image, target: Image, mask: Mask | None = None, valid: Valid | None = None
) -> dict[str, float]:
    """Every metric of one view, by name.

    ``sam`` (rad), ``rmse``, ``ssim`` and ``psnr`` (dB) are the paper's. ``psnr`` is a mean over bands, not of the
    mean error. ``ssim`` reads "moments computed over pixels in Omega" to the letter: one window, the whole of
    Omega, however the pixels lie. It asks whether the object's contrast is right as a whole; ``ssim_windowed`` asks
    whether details are in place (`windowed_scores`). ``rmse_pixel_mean``, the mean of each pixel's root, is what
    the paper's released code prints; it is never above ``rmse``, the text's, where all is valid.

    Example:
        >>> measured = torch.full((16, 16, 4), 0.5)
        >>> round(spectral_metrics(measured + 0.1, measured)["rmse"], 3)
        0.1
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
    from hsi_sc_nerf.evaluation.band_moments import moment_scores, windowed_scores  # which losses do without

    images = band_arrays(predicted, target, list(regions.values()), valid)
    by_band = zip(*moment_scores(*images), windowed_scores(*images), strict=True)
    found: dict[str, float] = {}
    for (name, mask), (pixels, mse, similarity, windows) in zip(regions.items(), by_band, strict=True):
        counted = pixels > 0
        values = {
            "sam": _pixel_mean(angles, mask, has_angles),
            "rmse": safe_sqrt(_pixel_mean(squares, mask, number)),
            "rmse_pixel_mean": _pixel_mean(safe_sqrt(squares), mask, has_any),
            "ssim": _band_mean(similarity[counted]),
            "ssim_windowed": _band_mean(windows[counted]),
            "psnr": _band_mean(decibel(mse)[counted]),
        }
        found |= {f"{name}{metric}": narrow(value, predicted).item() for metric, value in values.items()}
    return found


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


def spectral_angle_map(predicted: Image, target: Image, valid: Valid | None = None) -> Float[Tensor, "h w"]:
    """The angle between the spectra of each pixel, radians in [0, pi]; pi / 2 where either spectrum is zero.

    NaN where a pixel has fewer than two valid bands, and so everywhere in images of a single band.
    """
    angles = torch.cat([spectral_angle(p, t) for p, t, _ in _blocks(predicted, target, valid)])
    if predicted.shape[-1] < MIN_BANDS_OF_AN_ANGLE:
        return torch.full_like(angles, torch.nan)
    return angles if valid is None else torch.where(has_angle(valid), angles, torch.nan)


def noise_angle(
    spectra: Float[Tensor, "*pixels bands"], noise_std: Float[Tensor, "bands"]
) -> Float[Tensor, "*pixels"]:
    """Root mean square spectral angle (rad) that small noise, independent by band, turns these spectra by.

    Noise along a spectrum changes its length alone, so ``angle^2 = sum(std^2 (1 - u^2)) / length^2`` for the unit
    spectrum u. It is infinite for a spectrum of zeros.

    Example:
        >>> noise_angle(torch.full((100,), 0.5), torch.full((100,), 0.01))  # 0.01 sqrt(99) / (0.5 sqrt(100))
        tensor(0.0199)
    """
    power, variance = spectra.double() ** 2, noise_std.double() ** 2
    length2 = power.sum(-1)
    across = variance.sum() - (power * variance).sum(-1) / length2.clamp(min=torch.finfo(torch.float64).tiny)
    return (across.clamp(min=0.0) / length2).sqrt().float()


def squared_error_map(predicted: Image, target: Image, valid: Valid | None = None) -> Float[Tensor, "h w"]:
    """Mean squared error over the bands of each pixel, float64; NaN where none is valid."""
    return torch.cat(
        [
            (p.double() - t.double()).square().mean(-1)
            if v is None
            else (p.double() - t.double()).square().sum(-1) / count_bands(v)
            for p, t, v in _blocks(predicted, target, valid)
        ]
    )


def band_arrays(
    predicted: Image, target: Image, masks: Sequence[Mask | None], valid: Valid | None
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], Bool[np.ndarray, "masks h w"]]:
    """The images and masks as `moment_scores` and `windowed_scores` take them, in the processor's memory."""
    _check_shapes(predicted, target)
    if valid is not None:
        _check_valid(target, valid)
    for mask in masks:
        if mask is not None:
            check_mask(predicted, mask)
    precision = torch.float64 if torch.float64 in (predicted.dtype, target.dtype) else torch.float32
    flags = torch.zeros(0, 0, 0, dtype=torch.bool) if valid is None else valid
    images = (predicted.to(precision), target.to(precision), flags)
    first, second, third = (image.contiguous().numpy(force=True) for image in images)
    whole = torch.ones(predicted.shape[:2], dtype=torch.bool)
    return (first, second, third), np.stack([(whole if mask is None else mask).numpy(force=True) for mask in masks])


def decibel(mse: Float[np.ndarray, "*bands"]) -> Float[np.ndarray, "*bands"]:
    """Peak signal-to-noise ratio of mean squared errors, dB, for a peak of 1; at most ``-10 log10(PSNR_DELTA)``."""
    return -10.0 * np.log10(mse + PSNR_DELTA)


def count_bands(valid: Bool[Tensor, "*pixels bands"]) -> Int[Tensor, "*pixels"]:
    """How many bands of each pixel are valid."""
    # torch makes integers of this kind of all that it adds up: 64-bit ones of a whole image are half a gigabyte.
    return valid.sum(-1, dtype=torch.int16)


def has_angle(valid: Bool[Tensor, "*pixels bands"]) -> Bool[Tensor, "*pixels"]:
    """Pixels with bands enough to tell a spectral angle from."""
    return count_bands(valid) >= MIN_BANDS_OF_AN_ANGLE


def cleared(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``values``, 0 where they are not valid: what stood there, NaN included, touches neither values nor gradients.

    Raises:
        ValueError: ``valid`` is not boolean or of another shape.
    """
    _check_valid(values, valid)
    return torch.where(valid, values, 0.0)


def _pixel_mean(
    values: Float[Tensor, "h w"], mask: Mask | None, weights: Shaped[Tensor, "h w"] | None
) -> Float[Tensor, ""]:
    """Weighted mean over the mask, NaN over nothing; what has weight 0 may be anything."""
    counted = torch.ones_like(values) if weights is None else weights
    values, counted = select_pixels(torch.stack([values.double(), counted.double()], -1), mask).unbind(-1)
    return (torch.where(counted > 0, values, 0.0) * counted).sum() / counted.sum()


def _band_mean(scores: Float[np.ndarray, "bands"]) -> Float[Tensor, ""]:
    return torch.tensor(scores.mean() if len(scores) else np.nan)


def _blocks(
    predicted: Tensor, target: Tensor, valid: Tensor | None
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Lines of both images, a block at a time, 0 where not valid, and which of their values are."""
    _check_shapes(predicted, target)
    step = max(1, BLOCK_VALUES * len(predicted) // max(1, predicted.numel()))
    pairs = zip(predicted.split(step), target.split(step), strict=True)
    if valid is None:
        yield from ((p, t, None) for p, t in pairs)
    else:
        for (p, t), v in zip(pairs, valid.split(step), strict=True):
            yield cleared(p, v), cleared(t, v), v


def _check_shapes(predicted: Tensor, target: Tensor) -> None:
    if predicted.shape != target.shape:
        raise ValueError(f"the images differ in shape: {tuple(predicted.shape)} and {tuple(target.shape)}")


def _check_valid(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> None:
    if valid.dtype != torch.bool or valid.shape != values.shape:
        raise ValueError(
            f"the validity of values of shape {tuple(values.shape)} is boolean with that shape, not {valid.dtype} "
            f"with shape {tuple(valid.shape)}"
        )
