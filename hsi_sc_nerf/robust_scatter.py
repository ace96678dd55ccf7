"""The standard deviation of most of the values, which a few wild ones leave as it is, and weights without those."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution, as a multiple of its median absolute deviation."""
TUKEY = 4.685
"""Cut-off of Tukey's weights in standard deviations: 95 % efficient for normal errors."""


def robust_std(
    deviation: Float[np.ndarray, "n *columns"], axis: int | None = None, least: float = 0.0
) -> Float[np.ndarray, "*columns"]:
    """Standard deviation of normally distributed deviations about 0, by their median magnitude.

    Up to half of the values may be anything. NaN is left out.

    Args:
        deviation: deviation of the values from what is expected.
        axis: along which the values lie; all of them without it.
        least: smallest that is returned.

    Example:
        >>> float(robust_std(np.array([-1.0, 1.0, -1.0, 1.0, 500.0])))
        1.4826
    """
    return np.maximum(SIGMA_OF_MAD * np.nanmedian(np.abs(deviation), axis=axis), least)


def tukey_weights(
    deviation: Float[np.ndarray, "*shape"], std: Float[np.ndarray, "*#shape"] | float = 1.0
) -> Float[np.ndarray, "*shape"]:
    """Tukey's biweight of deviations from what is expected: 1 at none, 0 from `TUKEY` standard deviations on.

    Args:
        deviation: in the unit of ``std``; NaN has the weight 0.

    Example:
        >>> tukey_weights(np.array([0.0, 1.0, 5.0])).round(3)
        array([1.   , 0.911, 0.   ])
    """
    scaled = deviation / (TUKEY * std)
    return np.where(np.abs(scaled) < 1.0, np.square(1.0 - np.square(scaled)), 0.0)
