"""What a training run shows beside nerfstudio's logs: progress bar, results of each stage, spectra of some pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import TracebackType

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.progress import MofNCompleteColumn, TextColumn
from torch import Tensor

from hsi_sc_nerf.models.stages import Stage
from hsi_sc_nerf.progress import timed_progress

# Metrics of the paper's table.
_SUMMARY = {"sam": "SAM {:.4f} rad", "rmse": "RMSE {:.4f}", "ssim": "SSIM {:.3f}", "psnr": "PSNR {:.1f} dB"}


def stage_summary(name: str, metrics: Mapping[str, float]) -> str:
    """One line with the metrics of the held-out views at the end of a stage.

    Args:
        name: name of the stage.
        metrics: metrics inside the masks by name, and those of whole frames with the prefix ``full_``.
    """
    masked, full = (
        ", ".join(text.format(metrics[prefix + key]) for key, text in _SUMMARY.items()) for prefix in ("", "full_")
    )
    return f"{name} stage, held-out views: object {masked}; whole frame {full}"


def draw_spectra(
    wavelengths_nm: Float[np.ndarray, "bands"],
    measured: Float[Tensor, "pixels bands"],
    rendered: Float[Tensor, "pixels bands"],
    labels: Sequence[str],
    valid: Bool[Tensor, "pixels bands"] | None = None,
) -> Float[Tensor, "h w 3"]:
    """Picture of the measured (dashed) and rendered (solid) spectra of some pixels, colours in [0, 1].

    Args:
        wavelengths_nm: band centres.
        measured: reflectance, in [0, 1].
        rendered: reflectance of the same pixels.
        labels: name of each pixel.
        valid: which measured values are measurements; the others are not drawn. None for all.
    """
    figure = Figure(figsize=(7, 4), dpi=90, layout="constrained")
    axes = figure.subplots()
    shown = measured if valid is None else torch.where(valid, measured, torch.nan)
    for i, label in enumerate(labels):
        axes.plot(wavelengths_nm, rendered[i].numpy(), color=f"C{i}", label=label)
        axes.plot(wavelengths_nm, shown[i].numpy(), color=f"C{i}", linestyle="--", linewidth=1)
    axes.set(xlabel="wavelength, nm", ylabel="reflectance", title="rendered (solid) and measured (dashed)")
    axes.legend(fontsize="small")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return torch.from_numpy(np.asarray(canvas.buffer_rgba())[..., :3] / np.float32(255))


class TrainingProgress:
    """Progress bar with stage, steps, PSNR of the batches and time left, as a context manager."""

    def __init__(self, total_steps: int, first_step: int) -> None:
        self._progress = timed_progress(MofNCompleteColumn(), TextColumn("{task.fields[quality]}"))
        self._task = self._progress.add_task("training", total=total_steps, completed=first_step, quality="")
        self._smoothed_psnr: float | None = None

    def __enter__(self) -> TrainingProgress:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, step: int, stage: Stage, psnr: float) -> None:
        """Show that ``step`` of ``stage`` is done."""
        if math.isfinite(psnr):  # not so in a skipped step
            before = self._smoothed_psnr
            self._smoothed_psnr = psnr if before is None else 0.95 * before + 0.05 * psnr
        self._progress.update(
            self._task,
            completed=step + 1,
            description=f"training, {stage.config.name} stage",
            quality="" if self._smoothed_psnr is None else f"PSNR {self._smoothed_psnr:.1f} dB",
        )
