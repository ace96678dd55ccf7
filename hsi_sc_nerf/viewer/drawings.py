"""Small drawings for the viewer's panel: a plot of spectra, and a colour bar; as PNG in the text of a web page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

WIDTH_PX = 240
"""Width that the viewer shows pictures at."""
_DPI = 3 * 96  # three dots to a pixel of the page: sharp on screens with many
_STYLE: Any = {"font.size": 7, "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False}
# Okabe and Ito's blue and vermilion, which colour-blind readers tell apart.
_COLOURS = ("#0072B2", "#D55E00")


@rc_context(_STYLE)
def spectra_plot(
    wavelengths_nm: Float[np.ndarray, "bands"], spectra: Mapping[str, Float[np.ndarray, "bands"]], title: str
) -> bytes:
    """PNG of up to two named spectra over the wavelength; NaN leaves a gap."""
    figure = _figure(170)
    axes = figure.add_subplot()
    for (name, spectrum), colour in zip(spectra.items(), _COLOURS, strict=False):
        axes.plot(wavelengths_nm, spectrum, color=colour, linewidth=1.0, label=name)
    axes.set(xlabel="Wavelength (nm)", ylabel="Reflectance", title=title)
    axes.set_xlim(wavelengths_nm.min(), wavelengths_nm.max())
    axes.set_ylim(0.0, max(0.1, 1.05 * max(float(np.nanmax(spectrum)) for spectrum in spectra.values())))
    axes.grid(color="0.9", linewidth=0.5)
    axes.legend(frameon=False)
    return _png(figure)


@rc_context(_STYLE)
def colour_bar(drawn_range: tuple[float, float], colours: str, label: str) -> bytes:
    """PNG of a colour map with its range."""
    figure = _figure(46)
    mappable = matplotlib.cm.ScalarMappable(Normalize(*drawn_range), colours)
    bar = figure.colorbar(mappable, cax=figure.add_subplot(), orientation="horizontal")
    bar.set_label(label)
    return _png(figure)


def inline_image(png: bytes, text: str) -> str:
    """Markdown that shows a picture, or ``text`` where pictures are not shown."""
    return f"![{text}](data:image/png;base64,{base64.b64encode(png).decode()})"


def _figure(height_px: int) -> Figure:
    figure = Figure(figsize=(WIDTH_PX / 96, height_px / 96), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    memory = io.BytesIO()
    figure.savefig(memory, format="png")
    return memory.getvalue()
