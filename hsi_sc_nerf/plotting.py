"""Figure set-up and false colours shared by all pictures: size, style, colours, saving.

Figures are drawn without a display and without pyplot's global state.

Example:
    >>> with rc_context(STYLE):
    ...     figure = new_figure(4.0, 3.0)
    ...     figure.subplots().plot([0, 1], color=COLOURS[0])
    ...     save_figure(figure, Path("line.png"))
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from hsi_sc_nerf.files import atomic_write

if TYPE_CHECKING:
    from torch import Tensor

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "0.4",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "xtick.color": "0.3",
    "ytick.color": "0.3",
    "legend.frameon": False,
    # Names from files are no formulas.
    "text.parse_math": False,
}
"""Settings for `matplotlib.rc_context`."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which colour-blind readers can distinguish; without yellow, which is faint on white."""
DPI = 160
INDEX_COLOURS = "viridis"
"""matplotlib colour map of spectral indices, errors and distances."""
ANGLE_COLOURS = "magma"
"""matplotlib colour map of spectral angles."""
ANGLE_DRAWN_RAD = (0.0, 0.2)
"""Spectral angles at the ends of the colour map; ENVI's usual threshold for another material is in the middle."""
ERROR_DRAWN = (0.0, 0.1)
"""Root mean squared errors over the bands, reflectance, at the ends of the colour map."""
BLANK = (0.25, 0.25, 0.25)
"""Colour of missing values."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of this size (inches) with constrained layout."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure completely, or leave what is at ``path`` as it is.

    Letters of names that the font lacks, such as Chinese ones, are drawn as boxes.

    Raises:
        InputError: the operating system refused to write.
    """
    with atomic_write(Path(path)) as (temporary,), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font", category=UserWarning)
        figure.savefig(temporary)


def show_image(axes: Axes, image: np.ndarray, **options: Any) -> AxesImage:
    """Show an image without ticks; its pixel coordinates start at its upper left corner.

    Args:
        image: (h, w), or (h, w, 3) as 8 bit or as floats, which are clipped to [0, 1].
    """
    height, width = image.shape[:2]
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.grid(False)
    if image.ndim == 3 and image.dtype != np.uint8:
        image = np.clip(image, 0, 1)
    return axes.imshow(image, extent=(0, width, height, 0), interpolation="nearest", **options)


def logarithmic_axis(axes: Axes, which: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with numbers at its ticks; matplotlib's are formulas, which `STYLE` does not set."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def usual_range(values: Float[np.ndarray, "*shape"]) -> tuple[float, float]:
    """All but the lowest and the highest per cent of the finite values, for the ends of a colour map."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, (1, 99)).tolist() if finite.size else (0.0, 1.0)
    return low, max(high, low + 1e-9)


def coloured(
    values: Float[Tensor, "*shape"], drawn_range: tuple[float, float], colours: str
) -> Float[Tensor, "*shape 3"]:
    """Colours (RGB in [0, 1]) of values.

    Args:
        values: clipped to ``drawn_range``; NaN becomes ``BLANK``.
        drawn_range: values at the two ends of the colour map.

    Example:
        >>> ndvi = torch.tensor([[0.2, 0.8], [0.5, torch.nan]])
        >>> coloured(ndvi, (0.0, 1.0), INDEX_COLOURS).shape
        torch.Size([2, 2, 3])
    """
    import torch  # takes seconds, and most figures do without it

    low, high = drawn_range
    table = torch.as_tensor(matplotlib.colormaps[colours](np.arange(256))[:, :3]).to(values)
    missing = values.isnan()
    position = ((values - low) / (high - low)).clamp(0.0, 1.0).masked_fill(missing, 0.0)
    return torch.where(missing[..., None], table.new_tensor(BLANK), table[(position * 256.0).long().clamp_max(255)])
