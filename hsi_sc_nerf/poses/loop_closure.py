"""Whether the steps of a full turn add up to 360 degrees, each measured by what its two frames share alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.poses.track_adjust import AdjustedTracks
from hsi_sc_nerf.poses.tracks import reproject

# Difference of angles that measures how pixels move, rad.
_SMALL_TURN_RAD = 1e-5


def track_loop_closure_deg(adjusted: AdjustedTracks) -> float | None:
    """What is left of a full turn after adding up the steps between neighbouring frames, the last to the first too.

    The adjusted angles close by construction; a chain of steps does not. None where two neighbours share no point.
    """
    machine, tracks = adjusted.turntable, adjusted.tracks
    there, here = (
        reproject(replace(machine, angles_rad=machine.angles_rad + turn), tracks)
        for turn in (_SMALL_TURN_RAD, -_SMALL_TURN_RAD)
    )
    slopes = (there - here) / (2.0 * _SMALL_TURN_RAD)
    return chained_turn_deg(machine.frames, tracks.frame, tracks.point, slopes, adjusted.residual_px)


def chained_turn_deg(
    frames: Int[np.ndarray, "f"],
    frame: Int[np.ndarray, "n"],
    seen: Int[np.ndarray, "n"],
    slopes: Float[np.ndarray, "n k"],
    residual: Float[np.ndarray, "n k"],
) -> float | None:
    """Sum of the steps from each frame to the next and from the last to the first, beyond those of the machine.

    None where two neighbours share nothing.

    Args:
        frames: in the order of the turn.
        frame: of each row.
        seen: what each row shows: a point or a marker.
        slopes: how the row's residual changes with its frame's angle, a rad.
        residual: in any unit, each number with the same variance.
    """
    # By how much the row alone would turn its frame on, and the inverse of that angle's variance.
    stiffness = (slopes**2).sum(-1)
    own_rad = -(slopes * residual).sum(-1) / np.maximum(stiffness, 1e-12)
    total = 0.0
    rows = [np.flatnonzero(frame == f) for f in frames]
    for here, there in zip(rows, [*rows[1:], rows[0]], strict=True):
        _, i, j = np.intersect1d(seen[here], seen[there], return_indices=True)
        before, after = here[i], there[j]
        # Variances of the two ends add.
        weight = stiffness[before] * stiffness[after] / np.maximum(stiffness[before] + stiffness[after], 1e-12)
        if weight.sum() <= 0.0:
            return None
        total += float((weight * (own_rad[after] - own_rad[before])).sum() / weight.sum())
    return float(np.rad2deg(total))
