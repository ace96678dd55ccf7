"""Which machine the images call for: a perfect turntable and lens, or one whose lens distorts or whose table wobbles.

A richer model always leaves smaller residuals. It is taken where it lowers them by more than chance would: an F-test
on the weighted sums of squares, whose unit is what the smaller residuals themselves say the corners' variance is (at
least that of their fit). The level is strict, for errors of neighbouring corners are not quite independent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import f as f_distribution

from hsi_sc_nerf.poses.adjust import Problem, Unknowns, adjust
from hsi_sc_nerf.poses.initialise import Observations, Turntable

_LEVEL = 1e-6
# Weighted residuals beyond this many standard deviations count by their size, not its square.
LOSS_SIGMAS = 3.0
# A wobbling table's tilts (rad) and shifts (of the camera's distance) before their spread has been seen.
_FIRST_SPREAD = (0.02, 0.01)
_LEAST_SPREAD = (1e-5, 1e-6)


@dataclass(frozen=True)
class Adjusted:
    """An adjusted machine and what was free in it."""

    turntable: Turntable
    unknowns: Unknowns
    problem: Problem
    cost: float

    @property
    def degrees_of_freedom(self) -> int:
        """Residuals less unknowns, at least 1."""
        return max(1, self.problem.observed.size - self.problem.columns.size)

    @property
    def variance(self) -> float:
        """Of the weighted residuals: 1 if the corners' covariances are right; at least that."""
        return max(1.0, self.cost / self.degrees_of_freedom)

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Of the unknowns, in the order of ``adjust.Columns``."""
        normal, _ = self.problem.normal_equations(self.turntable, LOSS_SIGMAS)
        return self.variance * np.linalg.pinv(normal, hermitian=True)

    def angle_sigmas_deg(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "f"]:
        """Standard deviations of the frames' angles relative to the mean of all (no frame is exact), degrees.

        Args:
            covariance: of the unknowns.
        """
        at = self.problem.columns.angle[1:]
        angles = np.pad(covariance[np.ix_(at, at)], ((1, 0), (1, 0)))
        variance = angles.diagonal() - 2.0 * angles.mean(axis=0) + angles.mean()
        return np.rad2deg(np.sqrt(np.maximum(variance, 0.0)))


def choose(
    start: Turntable,
    observations: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    weights: Float[np.ndarray, "n 8 8"],
) -> Adjusted:
    """The simplest of the machines that explains the corners, adjusted.

    The lens comes first, on a still table. Then the table: if it wobbles, the lens is judged again beside it.
    """

    def solve(turntable: Turntable, unknowns: Unknowns) -> Adjusted:
        found = adjust(turntable, observations, centre_px, side_m, weights, LOSS_SIGMAS, unknowns)
        problem = Problem(found, observations, centre_px, side_m, weights, unknowns)
        return Adjusted(found, unknowns, problem, problem.cost(found, LOSS_SIGMAS))

    still = solve(replace(start, radial=(0.0, 0.0), tilts_rad=None, shifts_m=None), Unknowns())
    still = _with_lens(still, solve)
    spread = (_FIRST_SPREAD[0], _FIRST_SPREAD[1] * still.turntable.distance_m)
    free = solve(still.turntable, replace(still.unknowns, motion_spread=spread))
    if not _is_better(free, still):
        return still
    for _ in range(2):
        free = solve(replace(free.turntable, radial=(0.0, 0.0)), Unknowns(0, _spread(free)))
    return _with_lens(free, solve)


def _spread(free: Adjusted) -> tuple[float, float]:
    """Root mean squares of the motions that were found, tilts in rad and shifts in m."""
    motions = free.problem.motions(free.turntable) * free.problem.motion_scale
    tilt, shift = (float(np.sqrt(np.mean(part**2))) for part in np.split(motions, [2], axis=1))
    return max(tilt, _LEAST_SPREAD[0]), max(shift, _LEAST_SPREAD[1])


def _with_lens(plain, solve):
    """With as many terms of radial distortion as are called for, one after the other."""
    for terms in (1, 2):
        more = solve(plain.turntable, replace(plain.unknowns, radial_terms=terms))
        if not _is_better(more, plain):
            break
        plain = more
    return plain


def _is_better(more: Adjusted, less: Adjusted) -> bool:
    """F-test of nested models."""
    extra = more.problem.columns.size - less.problem.columns.size
    if more.problem.observed.size <= more.problem.columns.size:
        return False
    ratio = (less.cost - more.cost) / extra / more.variance
    return bool(f_distribution.sf(ratio, extra, more.degrees_of_freedom) < _LEVEL)
