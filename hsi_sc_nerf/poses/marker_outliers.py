"""Selection of the marker observations that the poses rest on, with the reason for every other one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted
from hsi_sc_nerf.poses.model_selection import linked_rows, select_model
from hsi_sc_nerf.poses.residuals import whitening
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


def usable(seen: MarkerObservations) -> tuple[MarkerObservations, list[RejectedMarker], list[int]]:
    """Observations of markers that turn, are seen in two frames or more, and link their frames.

    Returns:
        These observations, the others with the reason, and the markers that stand still in the image.
    """
    if len(seen) == 0:
        return seen, [], []
    count = Counter(seen.marker.tolist())
    size_px = np.sqrt(np.median([np.ptp(c, axis=0).prod() for c in seen.corners_px]))
    static = []
    for marker, n in count.items():
        centres = seen.corners_px[seen.marker == marker].mean(1)
        if n >= FEWEST_FRAMES and np.ptp(centres, axis=0).max() < _STATIC_FRACTION * size_px:
            static.append(marker)
    stands = np.isin(seen.marker, static)
    once = np.array([count[m] < 2 for m in seen.marker.tolist()], bool)
    rejected = _rejected(seen.select(stands), "it stands still in the image")
    rejected += _rejected(seen.select(once), "it is seen in no other frame")
    kept = seen.select(~stands & ~once)
    if len(kept):
        linked = linked_rows(kept.frame, kept.marker)
        rejected += _rejected(kept.select(~linked), "it links its frame with too few others")
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
    rejected = _rejected(observations.select(outliers), "it does not fit the others", errors_px[outliers])
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
    why = f"it determines the angle worse than to {_LARGEST_ANGLE_SIGMA_DEG} degrees"
    displaced = kept.select(np.isin(kept.frame, list(better.displaced_frames)))
    rejected = _rejected(observations.select(~keep), why)
    return better, certain, rejected + _rejected_frames(displaced, better.displaced_frames)


def _select_model(start: Turntable, observations: MarkerObservations) -> tuple[Adjusted, MarkerObservations]:
    """The selected model, and the observations that it rests on."""
    best = select_model(start.restricted(observations), observations)
    return best, observations.without_frames(list(best.displaced_frames))


def _fits(
    best: Adjusted, observations: MarkerObservations, good: Bool[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Error of each observation in pixels, and whether it is no outlier, judged by the good ones."""
    residual = best.turntable.reproject(observations) - observations.corners_px
    error_px = np.sqrt((residual**2).sum(-1).mean(-1))
    weighted = np.einsum("nij,nj->ni", whitening(observations.covariance_px2), residual.reshape(-1, 8))
    sigmas = np.sqrt((weighted**2).mean(-1) / best.variance)
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
