"""The pose report: results, goodness of fit and findings, ready for JSON; and a figure of the poses."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.plotting import save_figure
from hsi_sc_nerf.poses.pose_checks import REPROJECTION_TARGET_PX, step_deviation_deg
from hsi_sc_nerf.poses.result import TurntablePoses

# A session is a full turn if no more than this many of its steps are missing from 360 degrees.
_STEPS_SHORT_OF_A_TURN = 1.5
# Length of an arrow over the camera's distance, and of the error axis over the largest error.
_ARROW_FRACTION = 0.15
_AXIS_OVER_LARGEST = 1.4
# What fits into a line of the figure's title.
_TITLE_CHARACTERS = 190


def pose_report(poses: TurntablePoses, info: SessionInfo, findings: Sequence[Finding] = ()) -> dict:
    """Figures of an estimate and what was found in it; numbers that are unknown are None."""
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
        "reprojection_error_px": {
            "overall": _number(poses.overall_error_px),
            "target": REPROJECTION_TARGET_PX,
            "above_target": poses.overall_error_px > REPROJECTION_TARGET_PX,
            "frames": _by_name(poses, poses.reprojection_error_px),
        },
        "angles_deg": _by_name(poses, poses.angles_deg),
        "steps_deg": {
            "nominal": info.nominal_step_deg,
            "median": float(np.median(steps)),
            "smallest": float(steps.min()),
            "largest": float(steps.max()),
            "largest_deviation_from_nominal": step_deviation_deg(poses, info),
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
        f"axis leans {report['axis_tilt_in_image_deg']:.2f}° in the image",
        f"camera looks down {report['camera_looks_down_deg']:.2f}°",
    ]
    if report["axis_tilt_to_disc_deg"] is not None:
        parts.append(f"axis tilts {report['axis_tilt_to_disc_deg']:.2f}° to the disc")
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
        parts.append(f"{len(poses.outliers)} sightings of markers thrown out")
    return parts


def draw_poses(poses: TurntablePoses, report: dict, path: Path) -> None:
    """Draw cameras and markers from above, and errors and steps by frame, into a picture file.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = Figure(figsize=(13, 6), dpi=110)
    figure.subplots_adjust(left=0.06, right=0.98, bottom=0.1, top=0.82, wspace=0.2, hspace=0.35)
    words = textwrap.fill(f"By {poses.method}: {', '.join(describe_poses(poses, report))}", _TITLE_CHARACTERS)
    figure.suptitle(f"{words}\n{len(report['warnings'])} warnings (see poses.json)", fontsize=9)
    eyes = poses.camera_to_world[poses.used, :3, 3]
    arrows = -poses.camera_to_world[poses.used, :3, 2] * _ARROW_FRACTION * np.linalg.norm(eyes[0])

    top = figure.add_subplot(1, 2, 1)
    top.scatter(eyes[:, 0], eyes[:, 1], c=np.arange(len(eyes)), cmap="viridis", s=12)
    top.quiver(
        eyes[:, 0], eyes[:, 1], arrows[:, 0], arrows[:, 1],
        angles="xy", scale_units="xy", scale=1, color="tab:red", width=0.003,
    )  # fmt: skip
    for corners in poses.marker_corners_m.values():
        top.plot(*np.vstack([corners, corners[:1]])[:, :2].T, color="black", linewidth=0.8)
    top.annotate(poses.names[int(np.flatnonzero(poses.used)[0])], (eyes[0, 0], eyes[0, 1]), fontsize=8)
    top.set(xlabel="x (m)", ylabel="y (m)", title="Cameras in the object frame, from above")
    top.set_aspect("equal")

    error = figure.add_subplot(2, 2, 2)
    index = np.arange(len(poses.names))
    error.bar(index[poses.used], poses.reprojection_error_px[poses.used], color="tab:blue")
    left_out = index[~poses.used]
    error.plot(left_out, np.zeros(len(left_out)), "x", color="tab:red", label="left out", clip_on=False)
    error.axhline(REPROJECTION_TARGET_PX, color="black", linestyle="--", label="target")
    if np.isfinite(poses.overall_error_px):
        # Far below the target, the frames are compared with each other.
        error.set_ylim(0.0, _AXIS_OVER_LARGEST * float(np.nanmax(poses.reprojection_error_px)))
    error.set(ylabel="reprojection error (px)")
    error.legend(loc="upper right", fontsize=8)

    turn = figure.add_subplot(2, 2, 4, sharex=error)
    used = index[poses.used]
    turn.plot(used[1:], np.diff(poses.angles_deg[used]), ".", color="tab:blue")
    turn.ticklabel_format(axis="y", useOffset=False)
    turn.set(xlabel="frame", ylabel="step since the last (degrees)")
    save_figure(figure, path)


def is_full_turn(angles_deg: np.ndarray) -> bool:
    """Whether unwrapped angles go round once, with the last frame a neighbour of the first."""
    widest_step = np.abs(np.diff(angles_deg)).max()
    return bool(abs(angles_deg[-1] - angles_deg[0]) >= 360.0 - _STEPS_SHORT_OF_A_TURN * widest_step)


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
        "position_mm": 1e3 * sigma.position_m,
        "angles_deg": _by_name(poses, sigma.angle_deg),
    }


def _by_name(poses: TurntablePoses, values: np.ndarray) -> dict[str, float | None]:
    return {name: _number(value) for name, value in zip(poses.names, values, strict=True)}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
