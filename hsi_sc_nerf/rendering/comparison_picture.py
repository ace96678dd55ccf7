"""A frame as it was measured, as it is rendered, and how far apart the two are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map, squared_error_map
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.plotting.false_colour import ANGLE_COLOURS, ANGLE_DRAWN_RAD, ERROR_DRAWN

_STYLE: Any = {"font.size": 9, "axes.titlesize": 9, "axes.linewidth": 0.0}


@rc_context(_STYLE)
def draw_comparison(
    path: Path,
    name: str,
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "h w bands"],
    mask: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w bands"] | None,
    rgb_bands: Sequence[int],
) -> None:
    """Draw measured and rendered pseudo-RGB, the error of reflectance and, on the object, the spectral angle.

    Args:
        path: the PNG file, whole or not at all.
        name: of the frame.
        rendered: reflectance.
        measured: reflectance.
        mask: the object.
        valid: which measured values are measurements; all where it is None. Grey where a pixel has none.
        rgb_bands: shown as red, green, blue.

    Raises:
        InputError: the file cannot be written.
    """
    error = squared_error_map(rendered, measured, valid).sqrt().numpy()
    angle = torch.where(mask, spectral_angle_map(rendered, measured, valid), torch.nan).numpy()
    on_object = mask.numpy()
    height, width = on_object.shape
    cell_in = 2.2
    figure = Figure(figsize=(4 * cell_in + 1.2, cell_in * height / width + 0.6), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 4)
    for axes in panels:
        axes.set(xticks=[], yticks=[])
    for axes, title, image in zip(panels, (f"{name}, measured", "rendered"), (measured, rendered), strict=False):
        axes.imshow(image[..., list(rgb_bands)].clamp(0.0, 1.0).numpy(), interpolation="nearest")
        axes.set_title(title)
    for axes, title, values, colours, drawn, unit in (
        (panels[2], "error of reflectance", error, "viridis", ERROR_DRAWN, ""),
        (panels[3], "spectral angle", angle, ANGLE_COLOURS, ANGLE_DRAWN_RAD, " rad"),
    ):
        shown = axes.imshow(
            values,
            cmap=matplotlib.colormaps[colours].with_extremes(bad="0.85"),
            vmin=drawn[0],
            vmax=drawn[1],
            interpolation="nearest",
        )
        axes.set_title(title)
        known = values[on_object & np.isfinite(values)]
        if len(known):
            axes.set_xlabel(f"mean on the object {known.mean():.4f}{unit}")
        figure.colorbar(shown, ax=axes, extend="max", fraction=0.05, pad=0.02)
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary)
