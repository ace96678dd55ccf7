"""What the report asks of a trained model: its held-out views and its surface."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from hsi_sc_nerf.export.ply import SpectralCloud, read_spectral_ply
from hsi_sc_nerf.report.places import PlaceSpectra, inner_places, place_spectra
from hsi_sc_nerf.report.scores import ViewScores, score_view, spread_of_views
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit

if TYPE_CHECKING:
    from hsi_sc_nerf.models.trained_run import TrainedRun

PLACES = 4
# Radius of a place, as a share of a view's width: 8 pixels of the SPECIM IQ's 512.
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
