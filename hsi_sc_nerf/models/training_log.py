"""What a run tells beside nerfstudio's own logs: spectra of fixed pixels, and each stage's result in a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

# What the paper's table has, with units; the whole frame's have the prefix `full_`.
_SUMMARY = {"sam": "SAM {:.4f} rad", "rmse": "RMSE {:.4f}", "ssim": "SSIM {:.3f}", "psnr": "PSNR {:.1f} dB"}


def stage_summary(name: str, metrics: Mapping[str, float]) -> str:
    """One line on the held-out views at the end of a stage.

    Args:
        name: of the stage.
        metrics: masked metrics by name, and with the prefix ``full_`` those of whole frames.
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
        valid: which measured values are measurements; the others are not drawn. All without it.
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
