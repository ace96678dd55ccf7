"""Which machine the images call for: a perfect turntable and lens, or one whose lens distorts or whose table wobbles.

A richer model always leaves smaller residuals. It is taken where it lowers them by more than chance would: an F-test
on the weighted sums of squares, whose unit is what the smaller residuals themselves say the corners' variance is (at
least that of their fit). The level is strict, for errors of neighbouring corners are not quite independent.

A table that wobbles does so in many frames. Where a few frames alone call for motions, and the others are content
with one axis, it does not wobble: those frames were knocked, and are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import f as f_distribution

from hsi_sc_nerf.poses.adjust import Problem, Unknowns, adjust
from hsi_sc_nerf.poses.initialise import Observations, Turntable, linked_rows
from hsi_sc_nerf.poses.knocked import frame_motions

_LEVEL = 1e-6
# Weighted residuals beyond this many standard deviations count by their size, not its square.
LOSS_SIGMAS = 3.0
# A wobbling table's tilts (rad) and shifts (of the camera's distance) before their spread has been seen.
_FIRST_SPREAD = (0.02, 0.01)
_LEAST_SPREAD = (1e-5, 1e-6)
# At most this share of the frames, but at least one, was knocked; if more call for a motion, the table wobbles.
_MOST_KNOCKED = 0.1


@dataclass(frozen=True)
class Adjusted:
    """An adjusted machine and what was free in it."""

    turntable: Turntable
    unknowns: Unknowns
    problem: Problem
    cost: float
    knocked: dict[int, float] = field(default_factory=dict)
    """Frames that were left out, for they fit the turntable only with a motion of their own, and how far they are
    from it at their best angle, px (root mean square)."""

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

    The lens comes first, on a still table. If then the table should move, it is asked whether a few knocked frames
    are all that calls for it. If it wobbles, the lens is judged again beside it.
    """

    def solver(rows: Bool[np.ndarray, "n"]) -> _Solve:
        seen, weight = observations.select(rows), weights[rows]

        def solve(turntable: Turntable, unknowns: Unknowns) -> Adjusted:
            found = adjust(turntable, seen, centre_px, side_m, weight, LOSS_SIGMAS, unknowns)
            problem = Problem(found, seen, centre_px, side_m, weight, unknowns)
            return Adjusted(found, unknowns, problem, problem.cost(found, LOSS_SIGMAS))

        return solve

    solve = solver(np.ones(len(observations), bool))
    still, free = _still(start, solve)
    if free is None:
        return still
    knocked = _without_knocked(still.turntable, observations, centre_px, side_m, weights, solver)
    if knocked is not None:
        return knocked
    for _ in range(2):
        free = solve(replace(free.turntable, radial=(0.0, 0.0)), Unknowns(0, _spread(free)))
    return _with_lens(free, solve)


_Solve = Callable[[Turntable, Unknowns], Adjusted]


def _still(start: Turntable, solve: _Solve) -> tuple[Adjusted, Adjusted | None]:
    """The machine with a still table; and one whose table moves, if the corners call for it."""
    still = solve(replace(start, radial=(0.0, 0.0), tilts_rad=None, shifts_m=None), Unknowns())
    still = _with_lens(still, solve)
    spread = (_FIRST_SPREAD[0], _FIRST_SPREAD[1] * still.turntable.distance_m)
    free = solve(still.turntable, replace(still.unknowns, motion_spread=spread))
    return still, free if _is_better(free, still) else None


def _without_knocked(start, observations, centre_px, side_m, weights, solver) -> Adjusted | None:
    """The still machine of all but a few knocked frames; None where these are not all that calls for motions."""
    most = max(1, round(_MOST_KNOCKED * len(start.frames)))

    def motions(machine):
        return frame_motions(machine, observations, centre_px, side_m, weights, LOSS_SIGMAS)

    def still_without(frames):
        rows = ~np.isin(observations.frame, frames)
        rest = observations.select(rows)
        if not linked_rows(rest.frame, rest.marker).all():
            return None, None
        return _still(start.restricted(rest), solver(rows))

    # Knocked frames bend the machine that is fitted through them: judge by a machine without the likeliest.
    of_all = motions(start)
    likeliest = start.frames[np.sort(np.argsort(of_all.chance, kind="stable")[:most])]
    still, free = still_without(likeliest)
    if still is None:
        return None
    judged = motions(_with_angles(still.turntable, start))
    knocked = judged.chance < _LEVEL
    if not 0 < knocked.sum() <= most:
        return None
    if not np.array_equal(start.frames[knocked], likeliest):
        still, free = still_without(start.frames[knocked])
    if still is None or free is not None:
        return None
    away = zip(start.frames[knocked].tolist(), judged.away_px[knocked].tolist(), strict=True)
    return replace(still, knocked=dict(away))


def _with_angles(machine: Turntable, of_all: Turntable) -> Turntable:
    """A machine with the further frames of another, at the other's angles."""
    known = np.isin(of_all.frames, machine.frames)
    # The machine's angles begin at its own first frame.
    angles = of_all.angles_rad - of_all.angles_rad[known][0]
    angles[known] = machine.angles_rad
    return replace(machine, frames=of_all.frames, angles_rad=angles)


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
