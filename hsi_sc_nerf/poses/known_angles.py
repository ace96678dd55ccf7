"""The turntable's angles by ``session.json``, and whether poses contradict them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding, Level
from hsi_sc_nerf.poses.result import TurntablePoses

# A turntable's step differs from its nominal one by up to this fraction; a single angle by up to this one.
_STEP_TOLERANCE, _ANGLE_TOLERANCE = 0.05, 0.25
# Given angles differ from found ones by up to this.
_ANGLE_DEG = 1.0


def known_angles_deg(
    info: SessionInfo, places: Sequence[int], required: bool = False
) -> Float[np.ndarray, "n"] | None:
    """The frames' angles by ``session.json``, relative to the first; positive where the direction is not known.

    Args:
        places: each frame's place in the turn (`Session.places`), which counts captures that are left out.
        required: whether they must be known.

    Raises:
        InputError: not one angle per frame, or none where they are required.
    """
    sign = -1.0 if info.direction == "cw" else 1.0
    if info.frame_angles_deg is not None:
        if len(info.frame_angles_deg) != len(places):
            raise InputError(
                f"{len(info.frame_angles_deg)} frame angles are given for {len(places)} frames; give one per frame"
            )
        return sign * _turned_deg(np.array(info.frame_angles_deg))
    if info.nominal_step_deg is not None:
        return sign * info.nominal_step_deg * (np.array(places) - places[0])
    if required:
        raise InputError("the angles are not known; give nominal_step_deg or frame_angles_deg in session.json")
    return None


def are_assumed(info: SessionInfo, places: Sequence[int]) -> bool:
    """Whether the known angles rest on the assumption that the table turned for captures that are left out."""
    has_gaps = places[-1] - places[0] >= len(places)
    return has_gaps and info.nominal_step_deg is not None and info.frame_angles_deg is None


def _turned_deg(scale_deg: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """By how much the table has turned since the first frame, positive, by the readings of a scale of 360 degrees.

    Which way the scale counts is not known, so falling readings count as rising ones.
    """
    steps = np.diff(scale_deg)
    short_ways = (steps + 180.0) % 360.0 - 180.0
    # Frames may be out of order; most steps fall, and not only because the scale starts again.
    falls = np.sign(short_ways).sum() < 0 and np.sign(steps).sum() <= 0
    turned = np.unwrap(scale_deg, period=360.0) if (steps < 0.0).any() else scale_deg
    return (-1.0 if falls else 1.0) * (turned - turned[0])


def step_deviation_deg(poses: TurntablePoses, info: SessionInfo, places: Sequence[int]) -> float | None:
    """Largest departure of a used frame's angle from its place times the nominal step; None where that is unknown."""
    if info.nominal_step_deg is None:
        return None
    place = np.array(places)[poses.used]
    angles = poses.angles_deg[poses.used]
    step = np.copysign(info.nominal_step_deg, np.median(np.diff(angles)))
    deviation_deg = angles - step * (place - place[0])
    return float(np.abs((deviation_deg + 180.0) % 360.0 - 180.0).max())


def check_angles(poses: TurntablePoses, info: SessionInfo, places: Sequence[int]) -> list[Finding]:
    """Whether the poses contradict the direction, the angles or the nominal step of ``session.json``, or are held at
    angles that nothing measured."""
    found = []
    steps = np.diff(poses.angles_deg[poses.used]) / np.diff(np.array(places)[poses.used])
    median = float(np.median(steps))
    direction = "ccw" if median > 0.0 else "cw"
    if info.direction and info.direction != direction:
        sentence = (
            f"session.json says that the turntable turns {info.direction}, the images show {direction}; correct it."
        )
        found.append(Finding("poses-direction", "red", sentence, {"given": info.direction, "found": direction}))
    if info.frame_angles_deg is not None and len(info.frame_angles_deg) == len(poses.used):
        given = np.copysign(1.0, median) * _turned_deg(np.array(info.frame_angles_deg))
        difference_deg = (poses.angles_deg - given)[poses.used]
        difference_deg = np.abs((difference_deg - np.median(difference_deg) + 180.0) % 360.0 - 180.0)
        typical, largest = float(np.median(difference_deg)), float(difference_deg.max())
        if largest > _ANGLE_DEG:
            level: Level = "red" if typical > _ANGLE_DEG else "amber"
            sentence = (
                f"Angles depart from frame_angles_deg by {typical:.1f} to {largest:.1f} degrees; correct it in "
                "session.json, or leave it out."
            )
            found.append(Finding("poses-angles", level, sentence, {"largest_deviation_deg": largest}))
        return found
    nominal, deviation = info.nominal_step_deg, step_deviation_deg(poses, info, places)
    if nominal is None or deviation is None:
        return found
    if are_assumed(info, places):
        if poses.method == "angles":
            sentence = (
                "The poses are held at angles that count a nominal step for each capture that is left out; give "
                "frame_angles_deg, of the frames."
            )
            return [*found, Finding("angles", "red", sentence, {"nominal_step_deg": nominal})]
        without_gaps = step_deviation_deg(poses, info, range(len(places)))
        if without_gaps is not None and without_gaps <= _ANGLE_TOLERANCE * nominal < deviation:
            sentence = (
                "The angles show that the table did not turn for the captures that are left out; for poses without "
                "markers, give frame_angles_deg of the frames."
            )
            return [*found, Finding("poses-angles", "amber", sentence, {"largest_deviation_deg": deviation})]
    values = {"nominal_step_deg": nominal, "median_step_deg": abs(median), "largest_deviation_deg": deviation}
    if abs(abs(median) - nominal) > _STEP_TOLERANCE * nominal:
        sentence = (
            f"The frames are {abs(median):.2f} degrees apart, but nominal_step_deg is {nominal:g}; correct it, or "
            "show markers."
        )
        found.append(Finding("poses-angles", "red", sentence, values))
    elif deviation > _ANGLE_TOLERANCE * nominal:
        sentence = f"An angle departs from the nominal steps by {deviation:.1f} degrees; compare with your notes."
        found.append(Finding("poses-angles", "amber", sentence, values))
    return found
