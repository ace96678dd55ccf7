"""The pose report: results, goodness of fit and warnings, ready for JSON; and a figure of the poses."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hsi_sc_nerf.plotting.figures import save_figure
from hsi_sc_nerf.poses.result import TurntablePoses

# The paper's target for the reprojection error (section "Pose Estimation").
REPROJECTION_TARGET_PX = 1.0
# A session is a full turn if no more than this many of its steps are missing from 360 degrees.
_STEPS_SHORT_OF_A_TURN = 1.5
# Warn where the container's diameter by the markers is off by more than this.
_LARGEST_DISAGREEMENT_PERCENT = 2.0
# Warn of a marker that is this much larger or smaller than the others, if by so many standard deviations.
_ODD_SIDE, _ODD_SIDE_SIGMAS = 0.01, 4.0
# Warn where the focal length, or the camera's distance, is known worse than this fraction.
_LARGEST_SIGMA = 0.005
# So many frames that are left out for one reason are named in the warning; the report has all.
_MOST_NAMES = 8
# Length of an arrow over the camera's distance, and of the error axis over the largest error.
_ARROW_FRACTION = 0.15
_AXIS_OVER_LARGEST = 1.4


def pose_report(poses: TurntablePoses) -> dict:
    """Figures and warnings of an estimate; numbers that are unknown are None."""
    angles = poses.angles_deg[poses.used]
    steps = np.diff(angles)
    full_turn = is_full_turn(angles)
    found_direction = "ccw" if np.median(steps) > 0 else "cw"
    warnings = list(poses.warnings)
    if poses.overall_error_px > REPROJECTION_TARGET_PX:
        warnings.append(
            f"the reprojection error of {poses.overall_error_px:.2f} px is above {REPROJECTION_TARGET_PX} px"
        )
    if poses.nominal_direction and poses.nominal_direction != found_direction:
        warnings.append(
            f"the session says that the turntable turns {poses.nominal_direction}, the images show {found_direction}"
        )
    deviation = _step_deviation(poses)
    if deviation is not None and deviation > 0.25 * abs(poses.nominal_step_deg or np.inf):
        warnings.append(f"an angle departs from the nominal steps by {deviation:.1f} degrees")
    if poses.dropped:
        warnings.append(_left_out(poses))
    warnings += [*_model_warnings(poses), *_scale_warnings(poses)]
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
        "reprojection_error_px": {
            "overall": _number(poses.overall_error_px),
            "target": REPROJECTION_TARGET_PX,
            "above_target": poses.overall_error_px > REPROJECTION_TARGET_PX,
            "frames": {n: _number(e) for n, e in zip(poses.names, poses.reprojection_error_px, strict=True)},
        },
        "angles_deg": {n: _number(a) for n, a in zip(poses.names, poses.angles_deg, strict=True)},
        "steps_deg": {
            "nominal": poses.nominal_step_deg,
            "median": float(np.median(steps)),
            "smallest": float(steps.min()),
            "largest": float(steps.max()),
            "largest_deviation_from_nominal": deviation,
        },
        "direction": {"nominal": poses.nominal_direction, "found": found_direction},
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
        "warnings": warnings,
    }


def describe_poses(poses: TurntablePoses, report: dict) -> list[str]:
    """What was found and how good it is, in a few words each; ``report`` is ``pose_report`` of the poses."""
    frames, error_px = report["frames"], report["reprojection_error_px"]["overall"]
    parts = [f"{frames['used']} of {frames['total']} frames"]
    if error_px is not None:
        parts.append(f"reprojection error {error_px:.2f} px")
    parts += [
        "free poses of a wobbling table" if poses.model == "free poses" else "one axis",
        f"axis leans {report['axis_tilt_in_image_deg']:.2f}° in the image",
        f"camera looks down {report['camera_looks_down_deg']:.2f}°",
    ]
    if report["axis_tilt_to_disc_deg"] is not None:
        parts.append(f"axis tilts {report['axis_tilt_to_disc_deg']:.2f}° to the disc")
    if report["loop_closure_deg"] is not None:
        parts.append(f"loop closes to {abs(report['loop_closure_deg']):.3f}°")
    parts.append(_describe_scale(poses))
    if poses.outliers:
        parts.append(f"{len(poses.outliers)} sightings of markers thrown out")
    return parts


def draw_poses(poses: TurntablePoses, path: Path) -> None:
    """Draw cameras and markers in space and from above, and errors and steps by frame, into a picture file.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = Figure(figsize=(16, 6), dpi=110)
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.1, top=0.86, wspace=0.2, hspace=0.35)
    report = pose_report(poses)
    # The figures that are not drawn.
    words = ", ".join(describe_poses(poses, report))
    figure.suptitle(f"By {poses.method}: {words}\n{len(report['warnings'])} warnings (see poses.json)", fontsize=10)
    eyes = poses.camera_to_world[poses.used, :3, 3]
    arrows = -poses.camera_to_world[poses.used, :3, 2] * _ARROW_FRACTION * np.linalg.norm(eyes[0])
    squares = [np.vstack([corners, corners[:1]]) for corners in poses.marker_corners_m.values()]

    space = figure.add_subplot(1, 3, 1, projection="3d")
    space.scatter(*eyes.T, c=np.arange(len(eyes)), cmap="viridis", s=12)
    space.quiver(*eyes.T, *arrows.T, color="tab:red", linewidth=0.8)
    for square in squares:
        space.plot(*square.T, color="black", linewidth=0.8)
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="Cameras in the object frame")
    space.set_aspect("equal")

    top = figure.add_subplot(1, 3, 2)
    top.scatter(eyes[:, 0], eyes[:, 1], c=np.arange(len(eyes)), cmap="viridis", s=12)
    top.quiver(
        eyes[:, 0], eyes[:, 1], arrows[:, 0], arrows[:, 1],
        angles="xy", scale_units="xy", scale=1, color="tab:red", width=0.003,
    )  # fmt: skip
    for square in squares:
        top.plot(square[:, 0], square[:, 1], color="black", linewidth=0.8)
    top.annotate(poses.names[int(np.flatnonzero(poses.used)[0])], (eyes[0, 0], eyes[0, 1]), fontsize=8)
    top.set(xlabel="x (m)", ylabel="y (m)", title="From above")
    top.set_aspect("equal")

    error = figure.add_subplot(2, 3, 3)
    index = np.arange(len(poses.names))
    error.bar(index[poses.used], poses.reprojection_error_px[poses.used], color="tab:blue")
    left_out = index[~poses.used]
    error.plot(left_out, np.zeros(len(left_out)), "x", color="tab:red", label="left out", clip_on=False)
    error.axhline(REPROJECTION_TARGET_PX, color="black", linestyle="--", label="target")
    if np.isfinite(poses.overall_error_px):
        # Far below the target, the frames are compared with each other.
        error.set_ylim(0.0, _AXIS_OVER_LARGEST * float(np.nanmax(poses.reprojection_error_px)))
        title = f"Overall {poses.overall_error_px:.3f} px (target {REPROJECTION_TARGET_PX:g} px)"
    else:
        title = "Poses as given: nothing was measured"
    error.set(ylabel="reprojection error (px)", title=title)
    error.legend(loc="upper right", fontsize=8)

    turn = figure.add_subplot(2, 3, 6, sharex=error)
    used = index[poses.used]
    steps = np.diff(poses.angles_deg[used])
    turn.plot(used[1:], steps, ".", color="tab:blue", label="found")
    if poses.nominal_step_deg is not None:
        nominal = np.copysign(poses.nominal_step_deg, np.median(steps))
        turn.axhline(nominal, color="black", linestyle="--", label="nominal")
        # Steps that agree to a thousandth of a degree would fill the axis with noise.
        turn.set_ylim(*(np.array([-1.0, 1.0]) * max(0.05, 1.2 * np.abs(steps - nominal).max()) + nominal))
    turn.ticklabel_format(axis="y", useOffset=False)
    turn.set(xlabel="frame", ylabel="step since the last (degrees)")
    turn.legend(loc="upper right", fontsize=8)

    save_figure(figure, path)


def is_full_turn(angles_deg: np.ndarray) -> bool:
    """Whether unwrapped angles go round once, with the last frame a neighbour of the first."""
    widest_step = np.abs(np.diff(angles_deg)).max()
    return bool(abs(angles_deg[-1] - angles_deg[0]) >= 360.0 - _STEPS_SHORT_OF_A_TURN * widest_step)


def _left_out(poses: TurntablePoses) -> str:
    """Which frames are left out and why, those of one reason together."""
    by_reason: dict[str, list[str]] = {}
    for name, why in sorted(poses.dropped.items()):
        by_reason.setdefault(why, []).append(name)
    groups = []
    for why, names in by_reason.items():
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        groups.append(f"{', '.join(names[:_MOST_NAMES])}{more} ({why})")
    return f"{len(poses.dropped)} of {len(poses.names)} frames are left out: {'; '.join(groups)}"


def _model_warnings(poses: TurntablePoses) -> list[str]:
    warnings = []
    if poses.model == "free poses":
        warnings.append(
            f"the table wobbles by {poses.wobble_deg or 0.0:.2f} degrees (root mean square), so each frame has a "
            "pose of its own"
        )
    if poses.uncertainty is not None:
        known = {"focal length": poses.uncertainty.focal, "camera's distance": poses.uncertainty.distance}
        for what, sigma in known.items():
            if sigma > _LARGEST_SIGMA:
                warnings.append(f"the {what} is known to {100.0 * sigma:.1f} % only; show more or larger markers")
    return warnings


def _scale_warnings(poses: TurntablePoses) -> list[str]:
    if poses.scale is None:
        return []
    warnings = []
    percent = poses.scale.disagreement_percent
    if percent is not None and abs(percent) > _LARGEST_DISAGREEMENT_PERCENT:
        comparison = "wider" if percent > 0 else "narrower"
        warnings.append(
            f"by the markers' side the container is {abs(percent):.1f} % {comparison} than given; measure the "
            "markers' black square and the container again"
        )
    for marker, side in sorted(poses.scale.marker_sides.items()):
        if abs(side - 1.0) > max(_ODD_SIDE, _ODD_SIDE_SIGMAS * poses.scale.marker_side_sigmas[marker]):
            warnings.append(
                f"marker {marker} seems {100.0 * abs(side - 1.0):.1f} % {'larger' if side > 1.0 else 'smaller'} than "
                "the others; all must have one side"
            )
    return warnings


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
        "angles_deg": {n: _number(a) for n, a in zip(poses.names, sigma.angle_deg, strict=True)},
    }


def _step_deviation(poses: TurntablePoses) -> float | None:
    """Largest departure of a used frame's angle from its index times the nominal step, degrees."""
    if poses.nominal_step_deg is None:
        return None
    index = np.flatnonzero(poses.used)
    angles = poses.angles_deg[poses.used]
    step = np.copysign(poses.nominal_step_deg, np.median(np.diff(angles)))
    away = angles - step * (index - index[0])
    return float(np.abs((away + 180.0) % 360.0 - 180.0).max())


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _describe_scale(poses: TurntablePoses) -> str:
    scale = poses.scale
    if scale is None:
        return "scale as given" if poses.metric else "no scale"
    words = f"scale by the {scale.source} ± {100.0 * scale.uncertainty:.2f} %"
    if scale.source == "markers" and scale.disagreement_percent is not None:
        words += f" (by it the container is {scale.disagreement_percent:+.1f} % off its given diameter)"
    return words
