"""What the sensor counts without light."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Num


def dark_columns(
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None, samples: int, bands: int
) -> Float[np.ndarray, "columns bands"]:
    """Mean over the dark cube's lines, for each sample of a line; 0 without a dark cube.

    A dark cube of another width cannot be matched sample by sample and gives one spectrum (columns = 1).
    """
    if dark is None:
        return np.zeros((1, bands))
    columns = dark.mean(axis=0, dtype=np.float64)
    return columns if len(columns) == samples else columns.mean(axis=0, keepdims=True)
