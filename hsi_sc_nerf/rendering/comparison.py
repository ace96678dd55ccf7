"""Compare rendered views with the measured frames: metrics, a picture of each view, and a table of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import torch
from jaxtyping import Float
from matplotlib import rc_context
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map, spectral_metrics, squared_error_map
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.plotting.figures import (
    ANGLE_COLOURS,
    ANGLE_DRAWN_RAD,
    ERROR_DRAWN,
    INDEX_COLOURS,
    STYLE,
    new_figure,
    save_figure,
    show_image,
)
from hsi_sc_nerf.rendering.views import RenderedView
from hsi_sc_nerf.terminal import markdown_table

_PANEL_IN = 2.2
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
    _draw_comparison(folder / f"{name}.png", view.spectral, item, rgb_bands)
    return spectral_metrics(view.spectral, item["spectral"], item["mask"][..., 0].bool(), item.get("valid"))


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
    cells = [[row["view"], *(shown(row[key]) for key, (_, shown) in columns.items())] for row in rows]
    parts = [markdown_table(["view", *(title for title, _ in columns.values())], cells)]
    if "sam" in columns:
        parts.append("Metrics compare rendered and measured spectra on the object (masked).")
    parts += ["\n".join(f"- `{name}`: {legend}" for name, legend in legends.items())] if legends else []
    write_json(path.with_suffix(".json"), {"views": [dict(row) for row in rows], "videos": dict(legends)})
    with atomic_write(path.with_suffix(".md")) as (temporary,):
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


@rc_context(STYLE)
def _draw_comparison(
    path: Path, rendered: Float[Tensor, "h w bands"], item: Mapping[str, Any], rgb_bands: Sequence[int]
) -> None:
    """Measured and rendered pseudo-RGB, the reflectance error and, on the object, the spectral angle.

    Pixels without a valid measurement are grey.
    """
    measured, mask, valid = item["spectral"], item["mask"][..., 0].bool(), item.get("valid")
    height, width = mask.shape
    figure = new_figure(4 * _PANEL_IN + 1.2, _PANEL_IN * height / width + 0.6)
    panels = figure.subplots(1, 4)
    for axes, title, spectra in zip(
        panels, (f"{path.stem}, measured", "rendered"), (measured, rendered), strict=False
    ):
        show_image(axes, spectra[..., list(rgb_bands)].numpy())
        axes.set_title(title)
    error = squared_error_map(rendered, measured, valid).sqrt()
    angle = torch.where(mask, spectral_angle_map(rendered, measured, valid), torch.nan)
    for axes, title, values, colours, (low, high), unit in (
        (panels[2], "reflectance error", error, INDEX_COLOURS, ERROR_DRAWN, ""),
        (panels[3], "spectral angle", angle, ANGLE_COLOURS, ANGLE_DRAWN_RAD, " rad"),
    ):
        colour_map = matplotlib.colormaps[colours].with_extremes(bad="0.85")
        shown = show_image(axes, values.numpy(), cmap=colour_map, vmin=low, vmax=high)
        axes.set(title=title, xlabel=f"mean on the object {float(values[mask].nanmean()):.4f}{unit}")
        figure.colorbar(shown, ax=axes, extend="max", fraction=0.05, pad=0.02)
    save_figure(figure, path)
