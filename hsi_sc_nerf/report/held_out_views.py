"""Held-out views of a run: rendered, scored, and with the spectra around a few points."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.evaluation.band_moments import moment_scores
from hsi_sc_nerf.evaluation.chosen_views import spread_of_views
from hsi_sc_nerf.evaluation.spectral_metrics import (
    band_arrays,
    decibel,
    metrics_of_regions,
    noise_angle,
    spectral_angle_map,
    squared_error_map,
)
from hsi_sc_nerf.packed.pixels import spread_over
from hsi_sc_nerf.terminal import progress_bar

if TYPE_CHECKING:
    from hsi_sc_nerf.models.trained_run import TrainedRun

POINTS = 4
# Radius of the circle around a point, as a fraction of a view's width: 8 pixels of the SPECIM IQ's 512.
_POINT_RADIUS = 1.0 / 64.0


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A held-out view in the report.

    Attributes:
        scores: scores of the view.
        measured_rgb: reflectance in the bands of pseudo-RGB.
        rendered_rgb: likewise.
        points: spectra around some points of the object.
    """

    scores: ViewScores
    measured_rgb: Float[np.ndarray, "h w 3"]
    rendered_rgb: Float[np.ndarray, "h w 3"]
    points: list[PixelSpectra]


def render_held_out(run: TrainedRun, views: int | None) -> Iterator[HeldOutView]:
    """Render ``views`` of the held-out views (None: all), evenly spread; the cubes of one are in memory at a time."""
    held_out = len(run.manager.eval_dataset.frames)
    chosen = spread_of_views(held_out, views or held_out)
    with progress_bar("rendering", "held-out views", len(chosen)) as done:
        for number, index in enumerate(chosen):
            yield _held_out_view(run, index)
            done(number + 1)


def _held_out_view(run: TrainedRun, index: int) -> HeldOutView:
    """A function of its own, whose cubes are freed before the next view is rendered."""
    import torch

    manager, model = run.manager, run.model
    camera, batch = manager.fixed_indices_eval_dataloader.get_camera(index)
    with torch.no_grad():
        rendered = model.get_outputs_for_camera(camera)["spectral"].cpu()
    measured, mask = batch["spectral"].cpu(), batch["mask"].cpu()[..., 0].bool()
    valid = batch["valid"].cpu() if "valid" in batch else torch.ones_like(measured, dtype=torch.bool)
    radius_px = max(1.0, mask.shape[1] * _POINT_RADIUS)
    noise = run.dataset.typical_uncertainty
    noise_std = None if noise is None else torch.from_numpy(noise)
    return HeldOutView(
        score_view(manager.eval_dataset.frames[index].capture, rendered, measured, mask, valid, noise_std),
        measured[..., model.rgb_bands].numpy(),
        rendered[..., model.rgb_bands].numpy(),
        point_spectra(
            measured.masked_fill(~valid, torch.nan).numpy(),
            rendered.numpy(),
            mask.numpy(),
            inner_points(mask.numpy(), POINTS, round(2.0 * radius_px)),
            radius_px,
        ),
    )


@dataclass(frozen=True, eq=False)
class ViewScores:
    """Scores of one held-out view; those by band are of the object's pixels.

    Attributes:
        name: name of the capture.
        metrics: `spectral_metrics` of the object, and with the prefix ``full_`` of the whole frame.
        rmse: root mean square error a band, reflectance; NaN for a band that was measured nowhere on the object.
        psnr_db: peak signal-to-noise ratio a band; likewise.
        ssim: structural similarity a band; likewise.
        angle_rad: map of the spectral angle; NaN where too few bands are valid.
        error: map of the root mean square error over bands, reflectance; NaN where no band is valid.
        mask: True on the object.
        noise_angle_rad: spectral angle by the noise of the measurement, median over the object; NaN if not known.
    """

    name: str
    metrics: dict[str, float]
    rmse: Float[np.ndarray, "bands"]
    psnr_db: Float[np.ndarray, "bands"]
    ssim: Float[np.ndarray, "bands"]
    angle_rad: Float[np.ndarray, "h w"]
    error: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    noise_angle_rad: float


def score_view(
    name: str,
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "h w bands"],
    mask: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w bands"],
    noise_std: Float[Tensor, "bands"] | None = None,
) -> ViewScores:
    """Scores of a view, with the paper's metrics (section "Evaluation Metrics").

    Args:
        noise_std: of the measured reflectance, by band.
    """
    pixels, mse, ssim = (scores[0] for scores in moment_scores(*band_arrays(rendered, measured, [mask], valid)))
    mse, psnr_db, ssim = (np.where(pixels > 0, score, np.nan) for score in (mse, decibel(mse), ssim))
    noise_angle_rad = math.nan
    if noise_std is not None:
        noise_angle_rad = float(noise_angle(rendered[mask], noise_std.to(rendered.device)).nanmedian())
    return ViewScores(
        name,
        metrics_of_regions(rendered, measured, {"": mask, "full_": None}, valid),
        rmse=np.sqrt(mse),
        psnr_db=psnr_db,
        ssim=ssim,
        angle_rad=spectral_angle_map(rendered, measured, valid).cpu().numpy(),
        error=squared_error_map(rendered, measured, valid).sqrt().cpu().numpy(),
        mask=mask.cpu().numpy(),
        noise_angle_rad=noise_angle_rad,
    )


def sample_mean_and_sd(
    values: Float[np.ndarray, "n bands"],
) -> tuple[Float[np.ndarray, "bands"], Float[np.ndarray, "bands"]]:
    """Mean and standard deviation of a sample (one degree of freedom less) over the first axis, without NaN.

    The deviation of a single value is 0; both are NaN where there is none.
    """
    counted = np.isfinite(values)
    count = counted.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(counted, values, 0.0).sum(axis=0) / count
        squares = np.where(counted, (values - mean) ** 2, 0.0).sum(axis=0)
    return mean, np.sqrt(squares / np.maximum(count - 1, 1)) + 0.0 * mean


def object_angles(views: Sequence[ViewScores]) -> Float[np.ndarray, "n"]:
    """Spectral angles (radians) of all the object's pixels of all views that have one."""
    angles = np.concatenate([view.angle_rad[view.mask] for view in views])
    return angles[np.isfinite(angles)]


@dataclass(frozen=True, eq=False)
class PixelSpectra:
    """Spectra of the object's pixels within a circle around a point of a view.

    Attributes:
        line: line of its centre.
        sample: sample of its centre.
        pixels: how many pixels of the object lie in the circle.
        measured: mean reflectance a band; NaN where a band was measured in none of the pixels.
        measured_sd: standard deviation over the pixels, noise and texture together.
        rendered: mean reflectance of the same values in the rendering.
    """

    line: int
    sample: int
    pixels: int
    measured: Float[np.ndarray, "bands"]
    measured_sd: Float[np.ndarray, "bands"]
    rendered: Float[np.ndarray, "bands"]


def inner_points(mask: Bool[np.ndarray, "h w"], count: int, margin_px: int) -> list[tuple[int, int]]:
    """(line, sample) of points spread over the mask, ``margin_px`` inside its edge where it is wide enough."""
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    inside = mask & (depth >= min(margin_px, 0.8 * float(depth.max())))
    return [(line, sample) for _, line, sample in spread_over(inside[None], count).tolist()]


def point_spectra(
    measured: Float[np.ndarray, "h w bands"],
    rendered: Float[np.ndarray, "h w bands"],
    mask: Bool[np.ndarray, "h w"],
    points: Sequence[tuple[int, int]],
    radius_px: float,
) -> list[PixelSpectra]:
    """Spectra of the object's pixels within a circle around each point; values that are NaN in ``measured`` are
    ignored in both."""
    lines, samples = np.indices(mask.shape)
    found = []
    for line, sample in points:
        inside = mask & ((lines - line) ** 2 + (samples - sample) ** 2 <= radius_px**2)
        here = measured[inside].astype(float)
        mean_rendered, _ = sample_mean_and_sd(np.where(np.isfinite(here), rendered[inside], np.nan))
        found.append(PixelSpectra(line, sample, int(inside.sum()), *sample_mean_and_sd(here), mean_rendered))
    return found
