"""Errors that smooth displacements of the markers' corners would cause, and that no residual shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, Problem
from hsi_sc_nerf.poses.model_selection import LOSS_SIGMAS
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.turntable import MarkerObservations

_FIELD_PX = 0.007
"""Standard deviation of each field's amplitude: print, lens and pixels are that far from the model's."""


def with_hidden_errors(adjusted: Adjusted, markers: MarkerObservations) -> Adjusted:
    """The same turntable with a covariance that counts smooth displacements over the image (``smooth_fields``).

    Residuals hardly show them, for another camera explains most of them.
    """
    hidden = _FIELD_PX * smooth_fields(markers.corners_px.reshape(-1, 2))
    corners = MarkerResiduals(adjusted.turntable, markers, LOSS_SIGMAS, hidden=hidden)
    problem = Problem(adjusted.turntable, *adjusted.problem.residuals[:-1], corners, free=adjusted.problem.free)
    return replace(adjusted, problem=problem)


def smooth_fields(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 k"]:
    """Polynomials of the place up to the third degree along x and along y, each with a root mean square of 1 px."""
    place = pixels - np.median(pixels, axis=0)
    x, y = (place / np.abs(place).max()).T
    shapes = np.stack([x**i * y ** (n - i) for n in (1, 2, 3) for i in range(n + 1)], axis=-1)
    shapes /= np.sqrt((shapes**2).mean(axis=0))
    nothing = np.zeros_like(shapes)
    return np.stack([np.concatenate(pair, axis=-1) for pair in ((shapes, nothing), (nothing, shapes))], axis=1)
