"""How well held-out views are rendered: metrics a view, curves by band, the spectral angle of every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import (
    PSNR_DELTA,
    per_band_mse,
    per_band_ssim,
    spectral_angle_map,
    spectral_metrics,
    squared_error_map,
)


@dataclass(frozen=True, eq=False)
class ViewScores:
    """Scores of one held-out view; those by band are of the object's pixels.

    Attributes:
        name: of the capture.
        metrics: `spectral_metrics` of the object, and with the prefix ``full_`` of the whole frame.
        rmse: root mean square error a band, reflectance; NaN for a band that was measured nowhere on the object.
        psnr_db: peak signal-to-noise ratio a band; likewise.
        ssim: structural similarity a band; likewise.
        angle_rad: map of the spectral angle; NaN where too few bands are valid.
        error: map of the root mean square error over bands, reflectance; NaN where no band is valid.
        mask: True on the object.
    """

    name: str
    metrics: dict[str, float]
    rmse: Float[np.ndarray, "bands"]
    psnr_db: Float[np.ndarray, "bands"]
    ssim: Float[np.ndarray, "bands"]
    angle_rad: Float[np.ndarray, "h w"]
    error: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]


def score_view(
    name: str,
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "h w bands"],
    mask: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w bands"] | None = None,
) -> ViewScores:
    """Scores of a view, with the paper's metrics (section "Evaluation Metrics")."""
    mse = per_band_mse(rendered, measured, mask, valid).cpu().numpy()
    if valid is not None:
        mse = np.where(valid[mask].any(0).cpu().numpy(), mse, np.nan)
    metrics = spectral_metrics(rendered, measured, mask, valid)
    metrics |= {f"full_{k}": v for k, v in spectral_metrics(rendered, measured, None, valid).items()}
    ssim = per_band_ssim(rendered, measured, mask, valid).double().cpu().numpy()
    return ViewScores(
        name,
        metrics,
        rmse=np.sqrt(mse),
        psnr_db=-10.0 * np.log10(mse + PSNR_DELTA),
        ssim=np.where(np.isnan(mse), np.nan, ssim),
        angle_rad=spectral_angle_map(rendered, measured, valid).cpu().numpy(),
        error=squared_error_map(rendered, measured, valid).sqrt().cpu().numpy(),
        mask=mask.cpu().numpy(),
    )


def over_views(
    curves: Sequence[Float[np.ndarray, "bands"]],
) -> tuple[Float[np.ndarray, "bands"], Float[np.ndarray, "bands"]]:
    """Mean and standard deviation of each band over the views that measured it; NaN where none did.

    The deviation is that of a sample (one degree of freedom less), 0 for a single view.
    """
    stacked = np.stack(curves)
    counted = np.isfinite(stacked)
    views = counted.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(counted, stacked, 0.0).sum(axis=0) / views
        squares = np.where(counted, (stacked - mean) ** 2, 0.0).sum(axis=0)
    return mean, np.sqrt(squares / np.maximum(views - 1, 1)) + 0.0 * mean


def object_angles(views: Sequence[ViewScores]) -> Float[np.ndarray, "n"]:
    """Spectral angles (radians) of all the object's pixels of all views that have one."""
    angles = np.concatenate([view.angle_rad[view.mask] for view in views])
    return angles[np.isfinite(angles)]


def spread_of_views(count: int, wanted: int) -> list[int]:
    """Indices of ``wanted`` of ``count`` views, evenly spread; all where there are no more."""
    wanted = min(count, wanted)
    return [(2 * i + 1) * count // (2 * wanted) for i in range(wanted)]
