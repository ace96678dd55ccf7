"""The pose report: checks of the poses against what is known, results and goodness of fit as JSON, and a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib import rc_context

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.files import nan_to_none
from hsi_sc_nerf.findings import Finding, Level, names_in_short
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.poses.known_angles import check_angles, step_deviation_deg
from hsi_sc_nerf.poses.result import LARGEST_PLAQUE, TurntablePoses, is_full_turn

# The paper's target for the reprojection error (section "Pose Estimation").
REPROJECTION_TARGET_PX = 1.0
# Contradictions count from this many standard deviations.
_SIGMAS = 3.0
# A distance measured by tape, from a lens whose centre is inside, is good to this.
_DISTANCE_PERCENT = 5.0
# A marker's side is odd if it differs by this and by this many standard deviations.
_ODD_SIDE, _ODD_SIDE_SIGMAS = 0.01, 4.0
# Standard deviations, degrees, millimetres and percent of the scale: the goal, and what spoils a reconstruction.
_GOAL, _UNUSABLE = (0.3, 1.5, 0.5), (1.0, 10.0, 5.0)
# So many frames that are left out for one reason are named in the finding; poses.json has all.
_MOST_NAMES = 8
# Length of an arrow over the camera's distance, and of the error axis over the largest error.
_ARROW_FRACTION = 0.15
_AXIS_OVER_LARGEST = 1.4
# What fits into a line of the figure's title.
_TITLE_CHARACTERS = 150


def check_poses(poses: TurntablePoses, info: SessionInfo, places: Sequence[int] | None = None) -> list[Finding]:
    """Check the poses against each other and against what is known of the session.

    Args:
        poses: poses of the session.
        info: what is known of the session: the container's size, the nominal step and the direction.
        places: each frame's place in the turn (`Session.places`); one after the other if not given.

    Example:
        >>> refuse_red(check_poses(poses, info), accepted=["poses-scale"])
    """
    found = [*poses.findings]
    if poses.overall_error_px > REPROJECTION_TARGET_PX:
        sentence = f"The reprojection error of {poses.overall_error_px:.2f} px is above {REPROJECTION_TARGET_PX} px."
        found.append(Finding("poses-error", "amber", sentence))
    if poses.dropped:
        found.append(Finding("poses-frames", "amber", _left_out(poses)))
    if poses.wobble_deg is not None:
        sentence = f"The table wobbles by {poses.wobble_deg:.2f} degrees (RMS), so each frame has its own pose."
        found.append(Finding("poses-wobble", "amber", sentence))
    return [
        *found,
        *_check_uncertainty(poses),
        *check_angles(poses, info, range(len(poses.names)) if places is None else places),
        *_check_scale(poses),
        *_check_distance(poses, info),
    ]


def _check_uncertainty(poses: TurntablePoses) -> list[Finding]:
    if poses.uncertainty is None:
        return []
    percent = None if poses.scale is None else 100.0 * poses.scale.uncertainty
    known = np.array([poses.uncertainty.rotation_deg, 1e3 * poses.uncertainty.position_m, percent or 0.0])
    level: Level = "red" if (known > _UNUSABLE).any() else "amber" if (known > _GOAL).any() else "green"
    place = f"{known[1]:.2g} mm" if poses.metric else f"{0.1 * known[1]:.2g} % of the camera's distance"
    scale = "the scale is not known" if percent is None else f"the scale to {percent:.2g} %"
    advice = []
    if poses.scale is not None and poses.scale.source == "container":
        advice.append("give marker_side_m, for markers may stand off the container")
    if (known[:2] > _GOAL[:2]).any() or not advice:
        advice.append("show " + ("larger or more markers" if poses.dictionary else "markers on the turntable"))
        if poses.method != "markers" and not poses.camera_given:
            advice.append("give --camera, an earlier dataset of the same camera")
    sentence = f"The poses are known to {known[0]:.2g} degrees and {place}, {scale}"
    sentence += "." if level == "green" else f"; {', or '.join(advice)}."
    position_mm = known[1] if poses.metric else None
    values = {"rotation_deg": known[0], "position_mm": position_mm, "scale_percent": percent}
    return [Finding("poses-uncertain", level, sentence, values)]


def _check_scale(poses: TurntablePoses) -> list[Finding]:
    scale = poses.scale
    found: list[Finding] = []
    if scale is None:
        return found
    percent = scale.disagreement_percent
    if percent is not None and scale.source != "container":
        excess = abs(percent - np.clip(percent, 0.0, 100.0 * LARGEST_PLAQUE))
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
                "the others; all must have the same side."
            )
            found.append(Finding("poses-markers", "amber", sentence, {"marker": marker, "relative_side": side}))
    return found


def _check_distance(poses: TurntablePoses, info: SessionInfo) -> list[Finding]:
    """Whether the camera stands as far from the axis as is given, where something else gives the scale."""
    by_distance = poses.scale is not None and poses.scale.source == "distance"
    if info.camera_distance_m is None or not poses.metric or by_distance:
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


def pose_report(
    poses: TurntablePoses,
    info: SessionInfo,
    findings: Sequence[Finding] = (),
    places: Sequence[int] | None = None,
) -> dict:
    """Figures and findings of an estimate; unknown numbers are None.

    Args:
        places: as for `check_poses`.
    """
    places = range(len(poses.names)) if places is None else places
    steps = np.diff(poses.angles_deg[poses.used])
    full_turn = is_full_turn(poses.angles_deg[poses.used])
    # The mean axis in the camera's axes: right, up, backwards.
    axis = poses.camera_to_world[poses.used, 2, :3].mean(axis=0)
    return {
        "method": poses.method,
        "chosen": poses.chosen,
        "metric": poses.metric,
        "model": poses.model,
        "wobble_deg": poses.wobble_deg,
        "intrinsics": asdict(poses.intrinsics),
        "distortion": list(poses.distortion),
        "blur_px": poses.blur_px,
        "reprojection_error_px": nan_to_none(
            {
                "overall": poses.overall_error_px,
                "target": REPROJECTION_TARGET_PX,
                "above_target": poses.overall_error_px > REPROJECTION_TARGET_PX,
                "frames": _by_name(poses, poses.reprojection_error_px),
            }
        ),
        "angles_deg": _by_name(poses, poses.angles_deg),
        "steps_deg": {
            "nominal": info.nominal_step_deg,
            "median": float(np.median(steps)),
            "smallest": float(steps.min()),
            "largest": float(steps.max()),
            "largest_deviation_from_nominal": step_deviation_deg(poses, info, places),
        },
        "direction": {"nominal": info.direction, "found": "ccw" if np.median(steps) > 0 else "cw"},
        "full_turn": full_turn,
        "loop_closure_deg": poses.loop_closure_deg if full_turn else None,
        # How far the axis leans from the image's upright, and how far the camera looks down.
        "axis_tilt_in_image_deg": float(np.rad2deg(np.arctan2(axis[0], axis[1]))),
        "camera_looks_down_deg": float(np.rad2deg(np.arctan2(axis[2], np.hypot(axis[0], axis[1])))),
        "axis_tilt_to_disc_deg": poses.disc_tilt_deg,
        "scale": _scale(poses),
        "uncertainty": _uncertainty(poses),
        "frames": {
            "total": len(poses.names),
            "used": int(poses.used.sum()),
            "dropped": dict(sorted(poses.dropped.items())),
            "markers": dict(zip(poses.names, poses.markers_per_frame, strict=True)),
        },
        "marker_dictionary": poses.dictionary,
        "disc_markers": list(poses.disc_markers),
        "marker_corners_m": {str(m): c.tolist() for m, c in sorted(poses.marker_corners_m.items())},
        "outliers": [asdict(o) | {"frame": poses.names[o.frame]} for o in poses.outliers],
        "findings": [asdict(finding) for finding in findings],
        "warnings": [finding.sentence for finding in findings if finding.level != "green"],
    }


def describe_poses(poses: TurntablePoses, report: dict) -> list[str]:
    """What was found and how good it is, in a few words each; ``report`` is ``pose_report`` of the poses."""
    frames, error_px = report["frames"], report["reprojection_error_px"]["overall"]
    parts = [f"{frames['used']} of {frames['total']} frames"]
    if error_px is not None:
        parts.append(f"reprojection error {error_px:.2f} px")
    parts += [
        "free poses of a wobbling table" if poses.model == "free poses" else "one axis",
        f"axis leans {angle_words(report['axis_tilt_in_image_deg'])} in the image",
        f"camera looks down {angle_words(report['camera_looks_down_deg'])}",
    ]
    if report["axis_tilt_to_disc_deg"] is not None:
        parts.append(f"axis tilts {angle_words(report['axis_tilt_to_disc_deg'])} to the disc")
    if report["loop_closure_deg"] is not None:
        parts.append(f"loop closes to {abs(report['loop_closure_deg']):.3f}°")
    scale = poses.scale
    if scale is None:
        parts.append("scale as given" if poses.metric else "no scale")
    else:
        parts.append(f"scale by the {scale.source} ± {100.0 * scale.uncertainty:.2f} %")
    if poses.uncertainty is not None:
        parts.append(f"poses ± {poses.uncertainty.rotation_deg:.2g}°")
    if poses.outliers:
        parts.append(f"{len(poses.outliers)} observations of markers left out")
    return parts


def angle_words(angle_deg: float) -> str:
    """The angle with two decimals; what rounds to zero has no sign."""
    return f"{round(angle_deg, 2) + 0.0:.2f}°"


@rc_context(STYLE)
def draw_poses(poses: TurntablePoses, report: dict, path: Path) -> None:
    """Draw cameras and markers from above, and errors and steps by frame, into a picture file.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = new_figure(11.0, 5.0)
    grid = figure.add_gridspec(2, 2)
    words = textwrap.fill(f"By {poses.method}: {', '.join(describe_poses(poses, report))}", _TITLE_CHARACTERS)
    figure.suptitle(f"{words}\n{len(report['warnings'])} warnings (see poses.json)", fontsize=9)
    eyes = poses.camera_to_world[poses.used, :3, 3]
    arrows = -poses.camera_to_world[poses.used, :3, 2] * _ARROW_FRACTION * np.linalg.norm(eyes[0])

    top = figure.add_subplot(grid[:, 0])
    top.scatter(eyes[:, 0], eyes[:, 1], c=np.arange(len(eyes)), cmap="viridis", s=12)
    top.quiver(
        eyes[:, 0], eyes[:, 1], arrows[:, 0], arrows[:, 1],
        angles="xy", scale_units="xy", scale=1, color=COLOURS[1], width=0.003,
    )  # fmt: skip
    for corners in poses.marker_corners_m.values():
        top.plot(*np.vstack([corners, corners[:1]])[:, :2].T, color="black", linewidth=0.8)
    top.annotate(poses.names[int(np.flatnonzero(poses.used)[0])], (eyes[0, 0], eyes[0, 1]), fontsize=8)
    unit = "m" if poses.metric else "distances of the camera"
    top.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title="Cameras in the object frame, from above")
    top.set_aspect("equal")

    error = figure.add_subplot(grid[0, 1])
    index = np.arange(len(poses.names))
    error.bar(index[poses.used], poses.reprojection_error_px[poses.used], color=COLOURS[0])
    left_out = index[~poses.used]
    if left_out.size:  # an unclipped line without points would lie in the figure's corner, and shrink all axes
        error.plot(left_out, np.zeros(len(left_out)), "x", color=COLOURS[1], label="left out", clip_on=False)
    error.axhline(
        REPROJECTION_TARGET_PX, color="black", linestyle="--", label=f"target, {REPROJECTION_TARGET_PX:g} px"
    )
    if np.isfinite(poses.overall_error_px):
        # Far below the target, the frames are compared with each other.
        error.set_ylim(0.0, _AXIS_OVER_LARGEST * float(np.nanmax(poses.reprojection_error_px)))
    error.set(ylabel="reprojection error (px)")
    error.legend(loc="upper right", fontsize=8)

    turn = figure.add_subplot(grid[1, 1], sharex=error)
    used = index[poses.used]
    turn.plot(used[1:], np.diff(poses.angles_deg[used]), ".", color=COLOURS[0])
    turn.ticklabel_format(axis="y", useOffset=False)
    turn.set(xlabel="frame", ylabel="step since the last (degrees)")
    save_figure(figure, path)


def _scale(poses: TurntablePoses) -> dict | None:
    scale = poses.scale
    if scale is None:
        return None
    return {
        "source": scale.source,
        "marker_side_m": scale.marker_side_m,
        "uncertainty_percent": 100.0 * scale.uncertainty,
        "marker_sides": {
            str(m): {"relative": side, "sigma": scale.marker_side_sigmas[m]} for m, side in scale.marker_sides.items()
        },
        "container_diameter_m": {
            "given": scale.container_diameter_m,
            "by_markers": scale.measured_container_diameter_m,
            "disagreement_percent": scale.disagreement_percent,
        },
    }


def _uncertainty(poses: TurntablePoses) -> dict | None:
    sigma = poses.uncertainty
    if sigma is None:
        return None
    return {
        "focal_percent": 100.0 * sigma.focal,
        "distance_percent": 100.0 * sigma.distance,
        "rotation_deg": sigma.rotation_deg,
        "position_mm": 1e3 * sigma.position_m if poses.metric else None,
        "angles_deg": _by_name(poses, sigma.angle_deg),
    }


def _by_name(poses: TurntablePoses, values: np.ndarray) -> dict[str, float | None]:
    return nan_to_none(dict(zip(poses.names, values.tolist(), strict=True)))
