"""Checks of poses against what is known of the session, and of their stated uncertainty."""

from __future__ import annotations

import numpy as np

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.findings import Finding, Level, names_in_short
from hsi_sc_nerf.poses.result import TurntablePoses

# The paper's target for the reprojection error (section "Pose Estimation").
REPROJECTION_TARGET_PX = 1.0
# Contradictions count beyond so many standard deviations.
_SIGMAS = 3.0
# A plaque that carries a marker stands off the container's wall: the container is found wider by up to this.
_LARGEST_PLAQUE_PERCENT = 2.5
# A distance measured by tape, from a lens whose centre is inside, is good to this.
_DISTANCE_PERCENT = 5.0
# A marker's side is odd if it differs by this and by so many standard deviations.
_ODD_SIDE, _ODD_SIDE_SIGMAS = 0.01, 4.0
# A turntable's step differs from its nominal one by up to this fraction; a single angle by up to this one.
_STEP_TOLERANCE, _ANGLE_TOLERANCE = 0.05, 0.25
# Given angles differ from found ones by up to this.
_ANGLE_DEG = 1.0
# Standard deviations, degrees, millimetres and percent of the scale: the goal, and what spoils a reconstruction.
_GOAL, _UNUSABLE = (0.3, 1.5, 0.5), (1.0, 10.0, 5.0)
# So many frames that are left out for one reason are named in the finding; poses.json has all.
_MOST_NAMES = 8


def check_poses(poses: TurntablePoses, info: SessionInfo) -> list[Finding]:
    """What speaks for and against the poses.

    Args:
        poses: of the session.
        info: what is known of the session: the container's size, the nominal step and the direction.

    Example:
        >>> refuse_red(check_poses(poses, info), accepted=["poses-scale"])
    """
    found = [*poses.findings]
    if poses.overall_error_px > REPROJECTION_TARGET_PX:
        found.append(
            Finding(
                "poses-error",
                "amber",
                f"The reprojection error of {poses.overall_error_px:.2f} px is above {REPROJECTION_TARGET_PX} px.",
            )
        )
    if poses.dropped:
        found.append(Finding("poses-frames", "amber", _left_out(poses)))
    if poses.wobble_deg is not None:
        sentence = f"The table wobbles by {poses.wobble_deg:.2f} degrees (RMS), so each frame has its own pose."
        found.append(Finding("poses-wobble", "amber", sentence))
    return [*found, *_uncertainty(poses), *_angles(poses, info), *_scale(poses), *_distance(poses, info)]


def step_deviation_deg(poses: TurntablePoses, info: SessionInfo) -> float | None:
    """Largest departure of a used frame's angle from its index times the nominal step; None where that is unknown."""
    if info.nominal_step_deg is None:
        return None
    index = np.flatnonzero(poses.used)
    angles = poses.angles_deg[poses.used]
    step = np.copysign(info.nominal_step_deg, np.median(np.diff(angles)))
    away = angles - step * (index - index[0])
    return float(np.abs((away + 180.0) % 360.0 - 180.0).max())


def _uncertainty(poses: TurntablePoses) -> list[Finding]:
    if poses.uncertainty is None:
        return []
    scale = 0.0 if poses.scale is None else poses.scale.uncertainty
    known = np.array([poses.uncertainty.rotation_deg, 1e3 * poses.uncertainty.position_m, 100.0 * scale])
    level: Level = "red" if (known > _UNUSABLE).any() else "amber" if (known > _GOAL).any() else "green"
    place = f"{known[1]:.2g} mm" if poses.metric else f"{0.1 * known[1]:.2g} % of the camera's distance"
    sentence = f"The poses are known to {known[0]:.2g} degrees and {place}, the scale to {known[2]:.2g} %"
    show = "larger markers" if poses.method == "markers" else "markers on the turntable"
    advice = f"; show {show}, or give --camera, an earlier dataset of the same camera."
    values = {"rotation_deg": known[0], "position_mm": known[1], "scale_percent": known[2]}
    return [Finding("poses-uncertain", level, sentence + ("." if level == "green" else advice), values)]


def _angles(poses: TurntablePoses, info: SessionInfo) -> list[Finding]:
    found = []
    steps = np.diff(poses.angles_deg[poses.used]) / np.diff(np.flatnonzero(poses.used))
    median = float(np.median(steps))
    direction = "ccw" if median > 0.0 else "cw"
    if info.direction and info.direction != direction:
        sentence = (
            f"session.json says that the turntable turns {info.direction}, the images show {direction}; correct it."
        )
        found.append(Finding("poses-direction", "red", sentence, {"given": info.direction, "found": direction}))
    if info.frame_angles_deg is not None and len(info.frame_angles_deg) == len(poses.used):
        given = np.copysign(1.0, median) * np.abs(np.array(info.frame_angles_deg) - info.frame_angles_deg[0])
        away = (poses.angles_deg - given)[poses.used]
        away = np.abs((away - np.median(away) + 180.0) % 360.0 - 180.0)
        if away.max() > _ANGLE_DEG:
            level: Level = "red" if np.median(away) > _ANGLE_DEG else "amber"
            sentence = f"Angles depart from frame_angles_deg by {np.median(away):.1f} to {away.max():.1f} degrees."
            found.append(Finding("poses-angles", level, sentence, {"largest_deviation_deg": float(away.max())}))
        return found
    nominal, deviation = info.nominal_step_deg, step_deviation_deg(poses, info)
    if nominal is None or deviation is None:
        return found
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


def _scale(poses: TurntablePoses) -> list[Finding]:
    scale = poses.scale
    found: list[Finding] = []
    if scale is None:
        return found
    percent = scale.disagreement_percent
    if percent is not None and scale.source != "container":
        excess = abs(percent - np.clip(percent, 0.0, _LARGEST_PLAQUE_PERCENT))
        level: Level = "red" if excess > max(_SIGMAS * 100.0 * scale.uncertainty, 1.0) else "green"
        sentence = (
            f"The container is {abs(percent):.1f} % {'wider' if percent > 0.0 else 'narrower'} by the scale of the "
            "poses than given"
        )
        sentence += "; measure the markers' black square and the container again." if level == "red" else "."
        values = {"difference_percent": percent, "uncertainty_percent": 100.0 * scale.uncertainty}
        found.append(Finding("poses-scale", level, sentence, values))
    for marker, side in sorted(scale.marker_sides.items()):
        if abs(side - 1.0) > max(_ODD_SIDE, _ODD_SIDE_SIGMAS * scale.marker_side_sigmas[marker]):
            sentence = (
                f"Marker {marker} seems {100.0 * abs(side - 1.0):.1f} % {'larger' if side > 1.0 else 'smaller'} than "
                "the others; all must have one side."
            )
            found.append(Finding("poses-markers", "amber", sentence, {"marker": marker, "relative_side": side}))
    return found


def _distance(poses: TurntablePoses, info: SessionInfo) -> list[Finding]:
    """Whether the camera stands as far from the axis as is given, where something else gives the scale."""
    if info.camera_distance_m is None or poses.scale is None or poses.scale.source == "distance":
        return []
    found_m = float(np.linalg.norm(poses.camera_to_world[poses.used][0, :2, 3]))
    sigma = 0.0 if poses.uncertainty is None else poses.uncertainty.distance
    percent = 100.0 * (found_m / info.camera_distance_m - 1.0)
    values = {"difference_percent": percent, "uncertainty_percent": 100.0 * sigma}
    if abs(percent) <= max(100.0 * _SIGMAS * sigma, _DISTANCE_PERCENT):
        return []
    sentence = (
        f"The camera is {1e3 * found_m:.0f} mm from the axis by the poses, but camera_distance_m is "
        f"{info.camera_distance_m:g}; measure it, the markers and the container again."
    )
    return [Finding("poses-scale", "red", sentence, values)]


def _left_out(poses: TurntablePoses) -> str:
    """Which frames are left out and why, those of one reason together."""
    by_reason: dict[str, list[str]] = {}
    for name, why in sorted(poses.dropped.items()):
        by_reason.setdefault(why, []).append(name)
    groups = [f"{names_in_short(names, _MOST_NAMES)} ({why})" for why, names in by_reason.items()]
    return f"{len(poses.dropped)} of {len(poses.names)} frames are left out: {'; '.join(groups)}."
