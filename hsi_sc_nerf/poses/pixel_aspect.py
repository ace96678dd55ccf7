"""Are the pixels square? A line scanner whose speed does not fit its frame rate makes them longer or shorter.

Images of square markers in many orientations determine the pixels' shape: the images' lines are moved closer together
or further apart until the turntable fits the corners best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hsi_sc_nerf.findings import Finding, Level
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, Problem
from hsi_sc_nerf.poses.model_selection import EVIDENCE_NEEDED, LOSS_SIGMAS, f_test_evidence
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.turntable import MarkerObservations

ASPECT_AMBER, ASPECT_RED = 0.005, 0.015
"""Departures from square pixels. One of 0.05 moves poses by three centimetres (docs/validation/sessions.md)."""
_STEP, _ROUNDS = 0.02, 3
"""Steps of the search for the best spacing (logarithm), and number of its rounds."""


def pixel_aspect(adjusted: Adjusted, observations: MarkerObservations) -> tuple[float, float]:
    """Height of a pixel over its width by the markers, and the evidence that pixels are not square.

    Args:
        adjusted: the turntable of square pixels.
        observations: the corners that it was adjusted to.

    Returns:
        The ratio, and -log10 of the p-value for square pixels.

    Example:
        >>> adjusted, kept, _ = adjust_without_outliers(start, observations)
        >>> pixel_aspect(adjusted, kept)
        (1.0004, 0.31)
    """
    turntable, free = adjusted.turntable, adjusted.problem.free

    def solved(log_aspect: float) -> Adjusted:
        nonlocal turntable
        seen = stretched(observations, float(np.exp(log_aspect)), turntable.centre_px[1])
        problem = Problem(MarkerResiduals(turntable, seen, LOSS_SIGMAS), free=free)
        turntable = problem.minimise(turntable)
        return Adjusted(turntable, problem)

    best, found = 0.0, solved(0.0)
    cost_of_squares = found.cost
    for _ in range(_ROUNDS):
        low, high = solved(best - _STEP).cost, solved(best + _STEP).cost
        curvature = low - 2.0 * found.cost + high
        # Far from the minimum the cost need not be a parabola.
        towards = np.sign(low - high) * 2.0 * _STEP
        move = 0.5 * _STEP * (low - high) / curvature if curvature > 0.0 else towards
        best += float(np.clip(move, -4.0 * _STEP, 4.0 * _STEP))
        found = solved(best)
    gain = max(cost_of_squares - found.cost, 0.0) / found.variance
    return float(np.exp(best)), f_test_evidence(gain, 1, found.degrees_of_freedom)


def stretched(observations: MarkerObservations, factor: float, centre_px: float) -> MarkerObservations:
    """The corners with the images' lines further apart by a factor; the line of the principal point is fixed."""
    scale, centre = np.array([1.0, factor]), np.array([0.0, centre_px])
    both = np.tile(scale, 4)
    return replace(
        observations,
        corners_px=centre + (observations.corners_px - centre) * scale,
        covariance_px2=observations.covariance_px2 * both[:, None] * both,
    )


def check_pixel_aspect(aspect: float, evidence: float) -> list[Finding]:
    """The finding ``poses-aspect`` where pixels are not square (`pixel_aspect`)."""
    departure = abs(aspect - 1.0)
    if evidence <= EVIDENCE_NEEDED or departure <= ASPECT_AMBER:
        return []
    level: Level = "red" if departure > ASPECT_RED else "amber"
    sentence = (
        f"The pixels are {100.0 * departure:.1f} % {'higher' if aspect > 1.0 else 'lower'} than wide by the markers: "
        "match the scanner's speed to its frame rate, or resample the cubes to square pixels."
    )
    return [Finding("poses-aspect", level, sentence, {"height_over_width": aspect, "evidence": evidence})]
