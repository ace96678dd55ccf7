"""Compare rendered views with the measured frames: metrics, a picture of each view, and a table of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map, spectral_metrics, squared_error_map
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.plotting.false_colour import ANGLE_COLOURS, ANGLE_DRAWN_RAD, ERROR_DRAWN
from hsi_sc_nerf.rendering.cubes import RenderedView

_STYLE: Any = {"font.size": 9, "axes.titlesize": 9, "axes.linewidth": 0.0}
_PANEL_INCHES = 2.2
_COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "valid": ("valid pixels, %", lambda fraction: f"{100.0 * fraction:.1f}"),
    "sam": ("SAM, rad", "{:.4f}".format),
    "rmse": ("RMSE", "{:.4f}".format),
    "ssim": ("SSIM", "{:.3f}".format),
    "psnr": ("PSNR, dB", "{:.2f}".format),
}


def compare(
    folder: Path, name: str, view: RenderedView, item: Mapping[str, Any], rgb_bands: Sequence[int]
) -> dict[str, float]:
    """Metrics of a rendered frame on the object; ``NAME.png`` shows it beside the measured frame.

    Args:
        folder: folder of the picture.
        name: of the frame.
        view: the rendering.
        item: the frame as `SpectralDataset` gives it.
        rgb_bands: bands shown as red, green, blue.

    Raises:
        InputError: the picture cannot be written.
    """
    measured, mask, valid = item["spectral"], item["mask"][..., 0].bool(), item.get("valid")
    _draw_comparison(folder / f"{name}.png", name, view.spectral, measured, mask, valid, rgb_bands)
    return spectral_metrics(view.spectral, measured, mask, valid)


def write_report(path: Path, rows: Sequence[Mapping[str, Any]], legends: Mapping[str, str]) -> None:
    """Write a table of the views as ``PATH.md`` and ``PATH.json``.

    Args:
        path: path without a suffix.
        rows: name, fraction of valid pixels and, if the view was measured, metrics of each view.
        legends: what the colours of each video mean.

    Raises:
        InputError: the files cannot be written.
    """
    columns = {key: column for key, column in _COLUMNS.items() if key in rows[0]}
    lines = [
        "| view | " + " | ".join(title for title, _ in columns.values()) + " |",
        "| --- |" + " ---: |" * len(columns),
        *(
            f"| {row['view']} | " + " | ".join(shown(row[key]) for key, (_, shown) in columns.items()) + " |"
            for row in rows
        ),
    ]
    if "sam" in columns:
        lines += ["", "Metrics compare rendered and measured spectra on the object (masked)."]
    if legends:
        lines += ["", *(f"- `{name}`: {legend}" for name, legend in legends.items())]
    write_json(path.with_suffix(".json"), {"views": [dict(row) for row in rows], "videos": dict(legends)})
    with atomic_write(path.with_suffix(".md")) as (temporary,):
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


@rc_context(_STYLE)
def _draw_comparison(
    path: Path,
    name: str,
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "h w bands"],
    mask: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w bands"] | None,
    rgb_bands: Sequence[int],
) -> None:
    """Draw measured and rendered pseudo-RGB, the reflectance error and, on the object, the spectral angle.

    Pixels without a valid measurement are grey.
    """
    error = squared_error_map(rendered, measured, valid).sqrt().numpy()
    angle = torch.where(mask, spectral_angle_map(rendered, measured, valid), torch.nan).numpy()
    on_object = mask.numpy()
    height, width = on_object.shape
    size = (4 * _PANEL_INCHES + 1.2, _PANEL_INCHES * height / width + 0.6)
    figure = Figure(figsize=size, dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 4)
    for axes in panels:
        axes.set(xticks=[], yticks=[])
    for axes, title, image in zip(panels, (f"{name}, measured", "rendered"), (measured, rendered), strict=False):
        axes.imshow(image[..., list(rgb_bands)].clamp(0.0, 1.0).numpy(), interpolation="nearest")
        axes.set_title(title)
    for axes, title, values, colours, (low, high), unit in (
        (panels[2], "reflectance error", error, "viridis", ERROR_DRAWN, ""),
        (panels[3], "spectral angle", angle, ANGLE_COLOURS, ANGLE_DRAWN_RAD, " rad"),
    ):
        colour_map = matplotlib.colormaps[colours].with_extremes(bad="0.85")
        shown = axes.imshow(values, cmap=colour_map, vmin=low, vmax=high, interpolation="nearest")
        axes.set_title(title)
        known = values[on_object & np.isfinite(values)]
        if len(known):
            axes.set_xlabel(f"mean on the object {known.mean():.4f}{unit}")
        figure.colorbar(shown, ax=axes, extend="max", fraction=0.05, pad=0.02)
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary)
