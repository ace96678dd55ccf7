"""The standard deviation of most of the values, which a few wild ones leave as it is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution, as a multiple of its median absolute deviation."""


def robust_std(
    deviation: Float[np.ndarray, "n *columns"], axis: int | None = None, least: float = 0.0
) -> Float[np.ndarray, "*columns"]:
    """Standard deviation of normally distributed deviations about 0, by their median magnitude.

    Up to half of the values may be anything. NaN is left out.

    Args:
        deviation: of the values from what is expected.
        axis: along which the values lie; all of them without it.
        least: smallest that is returned.

    Example:
        >>> float(robust_std(np.array([-1.0, 1.0, -1.0, 1.0, 500.0])))
        1.4826
    """
    return np.maximum(SIGMA_OF_MAD * np.nanmedian(np.abs(deviation), axis=axis), least)
