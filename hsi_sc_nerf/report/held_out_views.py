"""Held-out views of a run: rendered, scored, and with the spectra of a few places."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import (
    PSNR_DELTA,
    per_band_mse,
    per_band_ssim,
    spectral_angle_map,
    spectral_metrics,
    squared_error_map,
)
from hsi_sc_nerf.export.ply import SpectralCloud, read_spectral_ply
from hsi_sc_nerf.packed.pixels import spread_over
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit

if TYPE_CHECKING:
    from hsi_sc_nerf.models.trained_run import TrainedRun

PLACES = 4
# Radius of a place, as a fraction of a view's width: 8 pixels of the SPECIM IQ's 512.
_PLACE_RADIUS = 1.0 / 64.0


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A held-out view as the report shows it.

    Attributes:
        scores: of the view.
        measured_rgb: pseudo-RGB.
        rendered_rgb: likewise.
        places: spectra of some places of the object.
    """

    scores: ViewScores
    measured_rgb: UInt8[np.ndarray, "h w 3"]
    rendered_rgb: UInt8[np.ndarray, "h w 3"]
    places: list[PlaceSpectra]


def render_held_out(run: TrainedRun, views: int) -> Iterator[HeldOutView]:
    """Render ``views`` of the held-out views, evenly spread, one after another; one cube is in memory at a time."""
    import torch

    manager, model = run.manager, run.model
    frames = manager.eval_dataset.frames
    for index in spread_of_views(len(frames), views):
        camera, batch = manager.fixed_indices_eval_dataloader.get_camera(index)
        with torch.no_grad():
            rendered = model.get_outputs_for_camera(camera)["spectral"].cpu()
        measured, mask = batch["spectral"].cpu(), batch["mask"].cpu()[..., 0].bool()
        valid = batch["valid"].cpu() if "valid" in batch else None
        radius_px = max(1.0, mask.shape[1] * _PLACE_RADIUS)
        yield HeldOutView(
            score_view(frames[index].capture, rendered, measured, mask, valid),
            to_8_bit(measured[..., model.rgb_bands].numpy()),
            to_8_bit(rendered[..., model.rgb_bands].numpy()),
            place_spectra(
                measured.numpy(),
                rendered.numpy(),
                mask.numpy(),
                inner_places(mask.numpy(), PLACES, round(2.0 * radius_px)),
                radius_px,
                None if valid is None else valid.numpy(),
            ),
        )


def sample_cloud(run: TrainedRun, points: int) -> SpectralCloud:
    """Points of the object's surface with their spectra, in metres and the object frame.

    Raises:
        InputError: the model holds no object.
    """
    from hsi_sc_nerf.export.options import CloudOptions
    from hsi_sc_nerf.export.spectral_export import export_cloud

    with tempfile.TemporaryDirectory() as folder:
        return read_spectral_ply(export_cloud(run, Path(folder), CloudOptions(num_points=points)))


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


@dataclass(frozen=True, eq=False)
class PlaceSpectra:
    """Spectra of the object's pixels within a circle.

    Attributes:
        line: of its centre.
        sample: of its centre.
        pixels: how many pixels of the object lie in it.
        measured: mean reflectance a band; NaN where a band was measured in none of the pixels.
        measured_sd: standard deviation over the pixels (one degree of freedom less), noise and texture together.
        rendered: mean reflectance of the same values in the rendering.
    """

    line: int
    sample: int
    pixels: int
    measured: Float[np.ndarray, "bands"]
    measured_sd: Float[np.ndarray, "bands"]
    rendered: Float[np.ndarray, "bands"]


def inner_places(mask: Bool[np.ndarray, "h w"], count: int, margin_px: int) -> list[tuple[int, int]]:
    """(line, sample) of places spread over the mask, ``margin_px`` inside its edge where it is wide enough."""
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    inside = mask & (depth >= min(margin_px, 0.8 * float(depth.max())))
    return [(line, sample) for _, line, sample in spread_over(inside[None], count).tolist()]


def place_spectra(
    measured: Float[np.ndarray, "h w bands"],
    rendered: Float[np.ndarray, "h w bands"],
    mask: Bool[np.ndarray, "h w"],
    places: Sequence[tuple[int, int]],
    radius_px: float,
    valid: Bool[np.ndarray, "h w bands"] | None = None,
) -> list[PlaceSpectra]:
    """Spectra of the object's pixels within a circle round each place; values that are not valid count nowhere."""
    lines, samples = np.indices(mask.shape)
    found = []
    for line, sample in places:
        inside = mask & ((lines - line) ** 2 + (samples - sample) ** 2 <= radius_px**2)
        here, there = measured[inside].astype(float), rendered[inside].astype(float)
        counts = np.ones_like(here, bool) if valid is None else valid[inside]
        of_band = counts.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, mean_rendered = (np.where(counts, s, 0.0).sum(axis=0) / of_band for s in (here, there))
            squares = np.where(counts, (here - mean) ** 2, 0.0).sum(axis=0)
        sd = np.sqrt(squares / np.maximum(of_band - 1, 1)) + 0.0 * mean
        found.append(PlaceSpectra(line, sample, int(inside.sum()), mean, sd, mean_rendered))
    return found
