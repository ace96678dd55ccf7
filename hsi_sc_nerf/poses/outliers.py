"""Which observations of markers the poses rest on, and why the others do not count."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.adjust import adjust, reproject, whitening
from hsi_sc_nerf.poses.choose import Adjusted, choose
from hsi_sc_nerf.poses.initialise import Observations, Rejected, Turntable, linked_rows

FEWEST_FRAMES = 3
KNOCKED = "object, table or camera was knocked in this frame"
# An observation is thrown out if its error is above this many pixels, this many times the median error, and this many
# times what the covariance of its corners explains.
_OUTLIER_PX = 0.2
_OUTLIER_MEDIANS = 5.0
_OUTLIER_SIGMAS = 5.0
# A marker whose centre moves by less than this share of its size over three frames or more is not on the turntable.
_STANDS_STILL_SIDES = 0.1
_ROUNDS = 4
# A frame whose angle is known worse than this is left out.
_LARGEST_ANGLE_SIGMA_DEG = 0.5


def usable(seen: Observations) -> tuple[Observations, list[Rejected], list[int]]:
    """Observations of markers that turn, are seen twice or more, and link their frames.

    Also the others with the reason, and the markers that stand still in the image.
    """
    count = Counter(seen.marker.tolist())
    size = np.sqrt(np.median([np.ptp(c, axis=0).prod() for c in seen.corners_px]))
    still = []
    for marker, n in count.items():
        centres = seen.corners_px[seen.marker == marker].mean(1)
        if n >= FEWEST_FRAMES and np.ptp(centres, axis=0).max() < _STANDS_STILL_SIDES * size:
            still.append(marker)
    stands = np.isin(seen.marker, still)
    once = np.array([count[m] < 2 for m in seen.marker.tolist()], bool)
    rejected = _rejected(seen.select(stands), "it stands still in the image")
    rejected += _rejected(seen.select(once), "it is seen in no other frame")
    kept = seen.select(~stands & ~once)
    if len(kept):
        linked = linked_rows(kept.frame, kept.marker)
        rejected += _rejected(kept.select(~linked), "it links its frame with too few others")
        kept = kept.select(linked)
    return kept, rejected, sorted(still)


def first_adjustment(
    start: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> Turntable:
    """The start adjusted in plain pixels, so that a wrong covariance cannot do harm."""
    pixels = np.tile(np.eye(8), (len(observations), 1, 1))
    return adjust(start, observations, centre_px, side_m, pixels, loss_scale=1.0)


def adjust_without_outliers(
    start: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> tuple[Adjusted, Observations, list[Rejected]]:
    """Choose a model and adjust it, throw out what does not fit, adjust again, until nothing changes.

    What was thrown out comes back where a better model explains it; a frame that was knocked does not. Frames and
    markers that the start lacks are thrown out.

    Raises:
        InputError: too few frames are left.
    """
    # A frame or a marker that the start lost has no place to begin at.
    good = np.isin(observations.frame, start.frames) & np.isin(observations.marker, start.markers)
    turntable, errors = start, np.full(len(observations), np.nan)
    knocked: dict[int, float] = {}
    for _ in range(_ROUNDS):
        best, kept = _chosen(turntable, observations.select(good), centre_px, side_m)
        turntable = best.turntable
        knocked |= best.knocked
        good &= ~np.isin(observations.frame, list(knocked))
        known = np.isin(observations.frame, kept.frame) & np.isin(observations.marker, kept.marker)
        errors = np.full(len(observations), np.nan)
        fits = np.zeros(len(observations), bool)
        errors[known], fits[known] = _fits(best, observations.select(known), good[known], centre_px, side_m)
        fits[fits] = _enough(observations.select(fits))
        if len(np.unique(observations.frame[fits])) < FEWEST_FRAMES:
            raise InputError(
                "the markers do not move as on one turntable; check that camera and markers were not touched during "
                "the session and that all markers have the same side"
            )
        if (fits == good).all():
            break
        good = fits
    else:
        best, kept = _chosen(turntable, observations.select(good), centre_px, side_m)
        knocked |= best.knocked
        good &= ~np.isin(observations.frame, list(knocked))
    bumped = np.isin(observations.frame, list(knocked))
    left = ~good & ~bumped
    rejected = [
        Rejected(r.frame, r.marker, float(e) if np.isfinite(e) else None, r.why)
        for r, e in zip(_rejected(observations.select(left), "it does not fit the others"), errors[left], strict=True)
    ]
    return best, kept, rejected + _knocked(observations.select(bumped), knocked)


def well_known(
    adjusted: Adjusted, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> tuple[Adjusted, Observations, list[Rejected]]:
    """Without frames whose markers hardly tell an angle: too small, too slanted, too noisy.

    Raises:
        InputError: too few frames are left.
    """
    sigmas = adjusted.angle_sigmas_deg(adjusted.covariance())
    vague = sigmas > _LARGEST_ANGLE_SIGMA_DEG
    if not vague.any():
        return adjusted, observations, []
    keep = ~np.isin(observations.frame, adjusted.turntable.frames[vague])
    keep[keep] = _enough(observations.select(keep))
    if len(np.unique(observations.frame[keep])) < FEWEST_FRAMES:
        raise InputError(
            f"the markers tell the turntable's angle to {float(np.median(sigmas)):.1f} degrees only; show more of "
            "them, larger or sharper"
        )
    kept = observations.select(keep)
    better, certain = _chosen(adjusted.turntable, kept, centre_px, side_m)
    rejected = _rejected(
        observations.select(~keep), f"it tells the angle worse than to {_LARGEST_ANGLE_SIGMA_DEG} degrees"
    )
    bumped = np.isin(kept.frame, list(better.knocked))
    return better, certain, rejected + _knocked(kept.select(bumped), better.knocked)


def _chosen(start, observations, centre_px, side_m) -> tuple[Adjusted, Observations]:
    """The machine that the observations call for, and those that it rests on."""
    weights = whitening(observations.covariance_px2)
    best = choose(start.restricted(observations), observations, centre_px, side_m, weights)
    return best, observations.select(~np.isin(observations.frame, list(best.knocked)))


def _knocked(observations, away_px: dict[int, float]) -> list[Rejected]:
    return [replace(r, error_px=away_px[r.frame]) for r in _rejected(observations, KNOCKED)]


def _fits(best, observations, good, centre_px, side_m) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Error of each observation in pixels, and whether it belongs to the rest, judged by the good ones."""
    residual = reproject(best.turntable, observations, centre_px, side_m) - observations.corners_px
    error = np.sqrt((residual**2).sum(-1).mean(-1))
    weighted = np.einsum("nij,nj->ni", whitening(observations.covariance_px2), residual.reshape(-1, 8))
    sigmas = np.sqrt((weighted**2).mean(-1) / best.variance)
    limit = max(_OUTLIER_PX, _OUTLIER_MEDIANS * float(np.median(error[good])))
    return error, (error < limit) | (sigmas < _OUTLIER_SIGMAS)


def _enough(observations):
    """Rows of markers in two frames or more, in the largest linked set of frames."""
    keep = np.ones(len(observations), bool)
    count = Counter(observations.marker.tolist())
    keep[[count[m] < 2 for m in observations.marker.tolist()]] = False
    if keep.any():
        keep[keep] = linked_rows(observations.frame[keep], observations.marker[keep])
    return keep


def _rejected(observations, why):
    return [
        Rejected(f, m, None, why)
        for f, m in zip(observations.frame.tolist(), observations.marker.tolist(), strict=True)
    ]
