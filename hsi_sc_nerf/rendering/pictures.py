"""Pictures of rendered views: beside the measured frames with metrics and a table, and as videos in false colours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import rc_context
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map, spectral_metrics, squared_error_map
from hsi_sc_nerf.files import atomic_write, nan_to_none, write_json
from hsi_sc_nerf.indices.catalogue import find_index
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.plotting import (
    ANGLE_COLOURS,
    ANGLE_DRAWN_RAD,
    ERROR_DRAWN,
    INDEX_COLOURS,
    STYLE,
    coloured,
    new_figure,
    save_figure,
    show_image,
)
from hsi_sc_nerf.rendering.views import RenderedView
from hsi_sc_nerf.spectra import COMPOSITES, composite, require_bands
from hsi_sc_nerf.terminal import markdown_table

_PANEL_IN = 2.2
_COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "valid": ("valid pixels, %", lambda fraction: f"{100.0 * fraction:.1f}"),
    "sam": ("SAM, rad", "{:.4f}".format),
    "rmse": ("RMSE", "{:.4f}".format),
    "ssim": ("SSIM", "{:.3f}".format),
    "psnr": ("PSNR, dB", "{:.2f}".format),
}
_CONSTANT_RATE_FACTOR = "18"
"""Quality of x264: visually lossless."""


def compare_view(
    folder: Path, name: str, view: RenderedView, item: Mapping[str, Any], rgb_bands: Sequence[int]
) -> dict[str, float]:
    """Metrics of a rendered frame on the object; ``NAME.png`` shows it beside the measured frame.

    Args:
        item: the frame as `SpectralDataset` gives it.

    Raises:
        InputError: the picture cannot be written.
    """
    _draw_comparison(folder / f"{name}.png", view.spectral, item, rgb_bands)
    return spectral_metrics(view.spectral, item["spectral"], item["mask"][..., 0].bool(), item.get("valid"))


def write_render_report(path: Path, rows: Sequence[Mapping[str, Any]], legends: Mapping[str, str]) -> None:
    """Write a table of the views as ``PATH.md`` and ``PATH.json``.

    Args:
        rows: name, fraction of valid pixels and, if the view was measured, metrics of each view.

    Raises:
        InputError: the files cannot be written.
    """
    columns = {key: column for key, column in _COLUMNS.items() if key in rows[0]}
    # A frame that shows nothing of the object has no score.
    rows = [nan_to_none(row) for row in rows]
    cells = [
        [row["view"], *("-" if row[key] is None else shown(row[key]) for key, (_, shown) in columns.items())]
        for row in rows
    ]
    parts = [markdown_table(["view", *(title for title, _ in columns.values())], cells)]
    if "sam" in columns:
        parts.append("Metrics compare rendered and measured spectra on the object (masked).")
    parts += ["\n".join(f"- `{name}`: {legend}" for name, legend in legends.items())] if legends else []
    write_json(path.with_suffix(".json"), {"views": rows, "videos": dict(legends)})
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


@dataclass(frozen=True)
class FalseColour:
    """A composite or an index as a picture.

    Attributes:
        name: name of the composite or the index.
        legend: what the colours mean.
        colours: turns a view into a picture, colours in [0, 1].
    """

    name: str
    legend: str
    colours: Callable[[RenderedView], Float[Tensor, "h w 3"]]


def find_false_colour(name: str, wavelengths_nm: Float[np.ndarray, "bands"]) -> FalseColour:
    """The composite of a name, in upper or lower case, or the index by name or formula (`find_indices`).

    Raises:
        InputError: there is no such composite or index, no band is near a wavelength that it needs, or a formula
            lacks the range of values of its colours, which all frames of a video share.

    Example:
        >>> ndvi = find_false_colour("NDVI", run.dataset.wavelengths_nm)
        >>> picture = ndvi.colours(render_view(run.model, run.manager.eval_dataset.cameras[:1]))
    """
    found = next((known for known in COMPOSITES if known.casefold() == name.casefold()), None)
    if found is not None:
        rgb_nm = COMPOSITES[found].wavelengths_nm
        require_bands(wavelengths_nm, rgb_nm, found)
        return FalseColour(
            found,
            f"{', '.join(f'{nm:g}' for nm in rgb_nm)} nm as red, green, blue",
            lambda view: composite(view.spectral, wavelengths_nm, rgb_nm).clamp(0.0, 1.0),
        )
    try:
        index = find_index(name)
    except InputError as error:
        if "=" in name:
            raise
        raise InputError(f"there is no composite (one of {', '.join(COMPOSITES)}) '{name}', and {error}") from error
    require_bands(wavelengths_nm, index.wavelengths_nm, index.name)
    if not index.has_range:
        raise InputError(f"give the values at both ends of the colour scale: '{index.definition} [LOW, HIGH]'.")
    low, high = ends = index.drawn_range

    def colours(view: RenderedView) -> Float[Tensor, "h w 3"]:
        values = index_values(index, view.spectral, wavelengths_nm)
        return coloured(values.masked_fill(~view.valid, torch.nan), ends, INDEX_COLOURS)

    legend = f"{index.expression}, {low:g} to {high:g} in {INDEX_COLOURS}, grey outside the object"
    return FalseColour(index.name, legend, colours)


@contextmanager
def open_video(path: Path, frames_per_second: int) -> Iterator[Callable[[UInt8[np.ndarray, "h w 3"]], None]]:
    """Write a video that browsers play (H.264 in MP4); the context gives a function that adds a frame (RGB).

    All frames have the size of the first one. An odd last line or column, which the format does not allow, is left
    out. The file is complete when the context ends, and is not held in memory.

    Example:
        >>> with open_video(Path("orbit.mp4"), frames_per_second=15) as add_frame:
        ...     add_frame(np.zeros((480, 640, 3), np.uint8))
    """
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=frames_per_second, options={"crf": _CONSTANT_RATE_FACTOR})
        stream.pix_fmt = "yuv420p"

        def add_frame(image: np.ndarray) -> None:
            even = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
            if not stream.codec_context.is_open:
                stream.height, stream.width = even.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield add_frame
        container.mux(stream.encode())
