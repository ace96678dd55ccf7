"""How much each band counts in the losses, from how well it was measured."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

MODEL_ERROR = 0.01
"""Error of the model itself (reflectance), which no band's measurement can tell it from."""


def inverse_variance_weights(
    standard_deviation: Float[np.ndarray, "bands"], model_error: float = MODEL_ERROR
) -> Float[np.ndarray, "bands"]:
    """Weights of mean 1 in proportion to ``1 / (sigma^2 + model_error^2)``, those of least squares.

    The model's own error keeps the best bands from taking the whole loss: where a measurement is better than what
    the model can explain, a still better one tells nothing more.

    Args:
        standard_deviation: of a typical reflectance, one number a band; not finite (no measurement) counts as 0.
        model_error: error that all bands have in common, greater than 0.

    Raises:
        ValueError: ``model_error`` is not positive, or no band has a finite deviation.
    """
    if not model_error > 0.0:
        raise ValueError(f"the model's error has to be greater than 0, not {model_error}")
    known = np.isfinite(standard_deviation)
    if not known.any():
        raise ValueError("no band has a finite standard deviation to be weighted by")
    weights = np.where(known, 1.0 / (np.where(known, standard_deviation, 0.0) ** 2 + model_error**2), 0.0)
    return weights / weights.mean()
