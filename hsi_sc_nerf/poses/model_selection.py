"""Selection of the marker observations that poses are computed from, and of the simplest model that explains them.

Rejected observations are returned with the reason. The lens has no distortion or some, the table no wobble or some.

A model with more parameters is selected if an F-test on the weighted sums of squares rejects the simpler one. The
variance is that of the richer model's residuals, and at least that of the corners' fit. If only a few frames need
motions of their own, the object, the table or the camera was displaced in them, and they are left out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import f as f_distribution

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, FreeParameters, Problem
from hsi_sc_nerf.poses.marker_initialisation import linked_rows
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.result import RejectedMarker
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, MarkerObservations, Turntable

DISPLACED = "object, table or camera was displaced in this frame"
# An observation is an outlier if its error is above this many pixels, this many times the median error, and this many
# times what the covariance of its corners explains.
_OUTLIER_PX = 0.2
_OUTLIER_MEDIANS = 5.0
_OUTLIER_SIGMAS = 5.0
# A marker whose centre moves by less than this fraction of its size over three frames or more does not turn.
_STATIC_FRACTION = 0.1
_ROUNDS = 4
# A frame whose angle is known worse than this is left out.
_LARGEST_ANGLE_SIGMA_DEG = 0.5
LOSS_SIGMAS = 3.0
"""Whitened residuals beyond this many standard deviations count by their size, not its square."""
EVIDENCE_NEEDED = 6.0
"""Least -log10 of the p-value of the simpler model. It is strict, because errors of neighbouring corners are not
quite independent."""
SYSTEMATIC_SIGMAS = 0.12
"""Systematic errors of the corners, as by shade, resemble a distortion that explains this many standard deviations
of each corner (docs/validation/poses.md)."""
# A wobbling table's tilts (rad) and shifts (of the camera's distance) before their spread is known.
_FIRST_SPREAD = (0.02, 0.01)
_LEAST_SPREAD = (1e-5, 1e-6)
# At most this fraction of the frames, but at least one, is displaced; if more need a motion, the table wobbles.
_MOST_DISPLACED = 0.1
_SMALLEST_P = 1e-99
# Numbers that describe a frame's own motion: angle, tilts (2), shifts (3).
_FRAME_PARAMETERS = 6
# A marker is ignored if its corners stay this many standard deviations (RMS) away from the freely moved frame.
_MISFIT_SIGMAS = 5.0
# One marker that is read wrongly looks like a displaced frame; several do not agree by chance.
_FEWEST_MARKERS = 2
_LEAST_FRACTION = 0.5


def usable(seen: MarkerObservations) -> tuple[MarkerObservations, list[RejectedMarker], list[int]]:
    """Observations of markers that turn, are seen in two frames or more, and link their frames.

    Returns:
        These observations, the others with the reason, and the markers that stand still in the image.
    """
    if len(seen) == 0:
        return seen, [], []
    count = Counter(seen.marker.tolist())
    size_px, static = np.sqrt(np.median([np.ptp(c, axis=0).prod() for c in seen.corners_px])), []
    for marker, n in count.items():
        centres = seen.corners_px[seen.marker == marker].mean(1)
        if n >= FEWEST_FRAMES and np.ptp(centres, axis=0).max() < _STATIC_FRACTION * size_px:
            static.append(marker)
    stands = np.isin(seen.marker, static)
    once = np.array([count[m] < 2 for m in seen.marker.tolist()], bool)
    rejected = _rejected(seen.select(stands), "still in the image while the table turns")
    rejected += _rejected(seen.select(once), "seen in no other frame")
    kept = seen.select(~stands & ~once)
    if len(kept):
        linked = linked_rows(kept.frame, kept.marker)
        rejected += _rejected(kept.select(~linked), "linking the frame with too few others")
        kept = kept.select(linked)
    return kept, rejected, sorted(static)


def adjust_without_outliers(
    start: Turntable, observations: MarkerObservations
) -> tuple[Adjusted, MarkerObservations, list[RejectedMarker]]:
    """Select a model, adjust it, reject outliers, and repeat until nothing changes.

    A rejected observation comes back where a better model explains it; a displaced frame does not. Frames and markers
    that the start lacks are rejected.

    Raises:
        InputError: too few frames are left.
    """
    good = start.knows(observations)
    turntable, errors_px = start, np.full(len(observations), np.nan)
    displaced: dict[int, float] = {}
    for last in [False] * _ROUNDS + [True]:
        best, kept = _select_model(turntable, observations.select(good))
        turntable = best.turntable
        displaced |= best.displaced_frames
        good &= ~np.isin(observations.frame, list(displaced))
        if last:
            break
        known = np.isin(observations.frame, kept.frame) & np.isin(observations.marker, kept.marker)
        errors_px = np.full(len(observations), np.nan)
        fits = np.zeros(len(observations), bool)
        errors_px[known], fits[known] = _fits(best, observations.select(known), good[known])
        fits[fits] = _linked(observations.select(fits))
        if len(np.unique(observations.frame[fits])) < FEWEST_FRAMES:
            raise InputError(
                "the markers do not move as on one turntable; check that camera and markers were not touched during "
                "the session and that all markers have the same side"
            )
        if (fits == good).all():
            break
        good = fits
    of_displaced = np.isin(observations.frame, list(displaced))
    outliers = ~good & ~of_displaced
    rejected = _rejected(observations.select(outliers), "contradicting the others", errors_px[outliers])
    return best, kept, rejected + _rejected_frames(observations.select(of_displaced), displaced)


def without_uncertain_frames(
    adjusted: Adjusted, observations: MarkerObservations
) -> tuple[Adjusted, MarkerObservations, list[RejectedMarker]]:
    """Leave out frames whose markers hardly determine an angle: too small, too slanted or too noisy.

    Raises:
        InputError: too few frames are left.
    """
    sigmas = adjusted.angle_sigmas_deg(adjusted.covariance())
    uncertain = sigmas > _LARGEST_ANGLE_SIGMA_DEG
    if not uncertain.any():
        return adjusted, observations, []
    keep = ~np.isin(observations.frame, adjusted.turntable.frames[uncertain])
    keep[keep] = _linked(observations.select(keep))
    if len(np.unique(observations.frame[keep])) < FEWEST_FRAMES:
        raise InputError(
            f"the markers determine the turntable's angle to {float(np.median(sigmas)):.1f} degrees only; show more "
            "of them, larger or sharper"
        )
    kept = observations.select(keep)
    better, certain = _select_model(adjusted.turntable, kept)
    why = f"giving the angle with an error above {_LARGEST_ANGLE_SIGMA_DEG} degrees"
    displaced = kept.select(np.isin(kept.frame, list(better.displaced_frames)))
    rejected = _rejected(observations.select(~keep), why)
    return better, certain, rejected + _rejected_frames(displaced, better.displaced_frames)


def _select_model(start: Turntable, observations: MarkerObservations) -> tuple[Adjusted, MarkerObservations]:
    """The selected model, and the observations that it was adjusted to."""
    best = select_model(start.restricted(observations), observations)
    return best, observations.without_frames(list(best.displaced_frames))


def _fits(
    best: Adjusted, observations: MarkerObservations, good: Bool[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Error of each observation in pixels, and whether it is no outlier, judged by the good ones."""
    error_px = best.turntable.errors_px(observations)
    whitened = MarkerResiduals(best.turntable, observations, LOSS_SIGMAS).values(best.turntable)
    sigmas = np.sqrt((whitened**2).mean(axis=(1, 2)) / best.variance)
    limit_px = max(_OUTLIER_PX, _OUTLIER_MEDIANS * float(np.median(error_px[good])))
    return error_px, (error_px < limit_px) | (sigmas < _OUTLIER_SIGMAS)


def _linked(observations: MarkerObservations) -> Bool[np.ndarray, "n"]:
    """Mask of markers in two frames or more, in the largest linked set of frames."""
    count = Counter(observations.marker.tolist())
    keep = np.array([count[m] >= 2 for m in observations.marker.tolist()], bool)
    if keep.any():
        keep[keep] = linked_rows(observations.frame[keep], observations.marker[keep])
    return keep


def _rejected(
    observations: MarkerObservations, why: str, errors_px: Float[np.ndarray, "n"] | None = None
) -> list[RejectedMarker]:
    errors_px = np.full(len(observations), np.nan) if errors_px is None else errors_px
    rows = zip(observations.frame.tolist(), observations.marker.tolist(), errors_px.tolist(), strict=True)
    return [RejectedMarker(f, m, e if np.isfinite(e) else None, why) for f, m, e in rows]


def _rejected_frames(observations: MarkerObservations, errors_px: Mapping[int, float]) -> list[RejectedMarker]:
    return _rejected(observations, DISPLACED, np.array([errors_px[f] for f in observations.frame.tolist()]))


_Solve = Callable[[Turntable, FreeParameters], Adjusted]


def select_model(start: Turntable, observations: MarkerObservations) -> Adjusted:
    """The simplest model that explains the corners, adjusted.

    The lens is selected first, with a table that does not wobble. If the corners then need motions of the table, a
    few displaced frames are tried as the explanation. If the table wobbles, the lens is selected again with it.
    """
    solve = partial(_solve, observations)
    steady, wobbling = _steady(start, solve)
    if wobbling is None:
        return steady
    without_displaced = _without_displaced_frames(steady.turntable, observations)
    if without_displaced is not None:
        return without_displaced
    for _ in range(2):
        free = FreeParameters(motion_sigmas=_motion_spread(wobbling.turntable))
        again = solve(replace(wobbling.turntable, radial=(0.0, 0.0)), free)
        wobbling = replace(again, evidence=wobbling.evidence)
    return _with_lens(wobbling, solve)


def frame_motions(
    turntable: Turntable, observations: MarkerObservations
) -> tuple[Float[np.ndarray, "f"], Float[np.ndarray, "f"]]:
    """Test whether each frame fits the turntable by its angle, or needs tilts and shifts of its own.

    Camera, lens and markers are held. Frames of fewer than two markers, or of which fewer than half agree on one
    motion, get a p-value of 1: single markers are left to the outlier test.

    Args:
        turntable: without wobble; observations of markers that it lacks are ignored.

    Returns:
        The p-value of each frame without a motion of its own (F-test), and the root mean square distance of its
        corners from the turntable's at its best angle, px.
    """
    seen = observations.select(turntable.knows(observations))
    n, frame = len(turntable.frames), np.searchsorted(turntable.frames, seen.frame)
    turning = FreeParameters(camera=False)
    moving = replace(turning, motion_sigmas=(np.inf, np.inf))

    def fitted(start: Turntable, rows: np.ndarray, free: FreeParameters) -> Turntable:
        residuals = MarkerResiduals(start, seen.select(rows), LOSS_SIGMAS, free=False)
        return Problem(residuals, free=free).minimise(start)

    everything = MarkerResiduals(turntable, seen, LOSS_SIGMAS, free=False)
    moved = fitted(turntable, np.ones(len(seen), bool), moving)
    sigmas = np.sqrt((everything.values(moved) ** 2).mean(axis=(1, 2)))
    agrees = sigmas < _MISFIT_SIGMAS * max(1.0, float(np.median(sigmas)))
    turned, moved = fitted(turntable, agrees, turning), fitted(moved, agrees, moving)
    by_motion, by_angle = (np.bincount(frame[agrees], everything.losses(t)[agrees], n) for t in (moved, turned))
    markers, all_markers = np.bincount(frame[agrees], minlength=n), np.bincount(frame, minlength=n)
    enough = (markers >= _FEWEST_MARKERS) & (markers >= _LEAST_FRACTION * all_markers)
    freedom = int((8 * markers - _FRAME_PARAMETERS)[enough].sum())
    variance = max(1.0, float(by_motion[enough].sum()) / max(freedom, 1))
    ratio = np.maximum(by_angle - by_motion, 0.0) / (_FRAME_PARAMETERS - 1) / variance
    p_value = np.where(enough, f_distribution.sf(ratio, _FRAME_PARAMETERS - 1, max(freedom, 1)), 1.0)
    errors_px, _ = turned.frame_errors_px(seen.select(agrees), int(turntable.frames.max()) + 1)
    return p_value, np.nan_to_num(errors_px[turntable.frames])


def _solve(observations: MarkerObservations, turntable: Turntable, free: FreeParameters) -> Adjusted:
    problem = Problem(MarkerResiduals(turntable, observations, LOSS_SIGMAS), free=free)
    return Adjusted(problem.minimise(turntable), problem)


def _steady(start: Turntable, solve: _Solve) -> tuple[Adjusted, Adjusted | None]:
    """The model without wobble; and the one with it, if the evidence suffices."""
    steady = solve(replace(start, radial=(0.0, 0.0), motion=None), FreeParameters())
    steady = _with_lens(steady, solve)
    sigmas = (_FIRST_SPREAD[0], _FIRST_SPREAD[1] * steady.turntable.distance)
    wobbling = solve(steady.turntable, replace(steady.problem.free, motion_sigmas=sigmas))
    found = _evidence(wobbling, steady)
    both = {**steady.evidence, "wobble": found}
    return replace(steady, evidence=both), replace(wobbling, evidence=both) if found > EVIDENCE_NEEDED else None


def _without_displaced_frames(start: Turntable, observations: MarkerObservations) -> Adjusted | None:
    """The model without wobble of all but a few displaced frames; None where these do not explain the motions."""
    most = max(1, round(_MOST_DISPLACED * len(start.frames)))

    def steady_without(frames: Int[np.ndarray, "k"]) -> tuple[Adjusted | None, Adjusted | None]:
        rest = observations.without_frames(frames)
        if not linked_rows(rest.frame, rest.marker).all():
            return None, None
        return _steady(start.restricted(rest), partial(_solve, rest))

    # Displaced frames distort a turntable that is fitted to them, so the test uses one without the likeliest.
    p_value, _ = frame_motions(start, observations)
    likeliest = start.frames[np.sort(np.argsort(p_value, kind="stable")[:most])]
    steady, wobbling = steady_without(likeliest)
    if steady is None:
        return None
    angles = start.angles_rad.copy()
    angles[np.isin(start.frames, steady.turntable.frames)] = steady.turntable.angles_rad
    p_value, rms_error_px = frame_motions(
        replace(steady.turntable, frames=start.frames, angles_rad=angles), observations
    )
    displaced = p_value < 10.0**-EVIDENCE_NEEDED
    if not 0 < displaced.sum() <= most:
        return None
    if not np.array_equal(start.frames[displaced], likeliest):
        steady, wobbling = steady_without(start.frames[displaced])
    if steady is None or wobbling is not None:
        return None
    errors = zip(start.frames[displaced].tolist(), rms_error_px[displaced].tolist(), strict=True)
    return replace(steady, displaced_frames=dict(errors))


def _motion_spread(turntable: Turntable) -> tuple[float, float]:
    """Root mean squares of the tilts (rad) and the shifts (m)."""
    assert turntable.motion is not None
    tilt, shift = (float(np.sqrt(np.mean(part**2))) for part in np.split(turntable.motion, [2], axis=1))
    return max(tilt, _LEAST_SPREAD[0]), max(shift, _LEAST_SPREAD[1])


def _with_lens(plain: Adjusted, solve: _Solve) -> Adjusted:
    """The model with terms of radial distortion, which are added one by one while the evidence suffices."""
    evidence = {**plain.evidence, "lens_distortion": 0.0}
    for terms in (1, 2):
        distorted = solve(plain.turntable, replace(plain.problem.free, radial_terms=terms))
        found = _evidence(distorted, plain, SYSTEMATIC_SIGMAS)
        evidence["lens_distortion"] = max(found, evidence["lens_distortion"])
        if found <= EVIDENCE_NEEDED:
            break
        plain = distorted
    return replace(plain, evidence=evidence)


def _evidence(more: Adjusted, less: Adjusted, systematic: float = 0.0) -> float:
    """F-test of nested models: -log10 of the probability under the simpler one.

    Args:
        systematic: of each number, the richer model may explain this many standard deviations without evidence.
    """
    extra, numbers = more.problem.layout.size - less.problem.layout.size, more.problem.numbers
    if numbers <= more.problem.layout.size:
        return 0.0
    explained = math.sqrt(max(less.cost - more.cost, 0.0) / more.variance) - systematic * math.sqrt(numbers)
    return f_test_evidence(max(explained, 0.0) ** 2 / extra, extra, more.degrees_of_freedom)


def f_test_evidence(ratio: float, extra: int, degrees_of_freedom: int) -> float:
    """-log10 of the probability of at least this ratio of variances by chance (F-test).

    Args:
        ratio: sum of squares that ``extra`` parameters explain, over their number and the residuals' variance.
        extra: number of these parameters.
        degrees_of_freedom: degrees of freedom of the residuals' variance.
    """
    return -math.log10(max(f_distribution.sf(ratio, extra, degrees_of_freedom), _SMALLEST_P)) + 0.0  # not -0.0
