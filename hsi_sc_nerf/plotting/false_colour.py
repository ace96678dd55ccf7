"""Numbers as colours of a colour map with a stated range."""

from __future__ import annotations

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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


def coloured(
    values: Float[Tensor, "*shape"], drawn_range: tuple[float, float], colours: str
) -> Float[Tensor, "*shape 3"]:
    """Colours (RGB in [0, 1]) of values.

    Args:
        values: clipped to ``drawn_range``; NaN becomes ``BLANK``.
        drawn_range: values at the two ends of the colour map.
        colours: name of a matplotlib colour map.

    Example:
        >>> ndvi = torch.tensor([[0.2, 0.8], [0.5, torch.nan]])
        >>> coloured(ndvi, (0.0, 1.0), INDEX_COLOURS).shape
        torch.Size([2, 2, 3])
    """
    low, high = drawn_range
    table = torch.as_tensor(matplotlib.colormaps[colours](np.arange(256))[:, :3]).to(values)
    missing = values.isnan()
    position = ((values - low) / (high - low)).clamp(0.0, 1.0).masked_fill(missing, 0.0)
    return torch.where(missing[..., None], table.new_tensor(BLANK), table[(position * 256.0).long().clamp_max(255)])
