"""A picture of the estimated poses: is this what stood on the table?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.poses.report import REPROJECTION_TARGET_PX, describe_poses
from hsi_sc_nerf.poses.result import TurntablePoses

_ARROW_SHARE = 0.15
_ABOVE_THE_BARS = 1.4


def draw_poses(poses: TurntablePoses, path: Path) -> None:
    """Draw cameras and markers in space and from above, and errors and steps by frame, into a picture file.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = Figure(figsize=(16, 6))
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.1, top=0.86, wspace=0.2, hspace=0.35)
    figure.suptitle(_summary(poses), fontsize=10)
    FigureCanvasAgg(figure)
    eyes = poses.camera_to_world[poses.used, :3, 3]
    arrows = -poses.camera_to_world[poses.used, :3, 2] * _ARROW_SHARE * np.linalg.norm(eyes[0])
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
        error.set_ylim(0.0, _ABOVE_THE_BARS * float(np.nanmax(poses.reprojection_error_px)))
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

    with atomic_write(path) as (temporary,):
        figure.savefig(temporary, dpi=110)


def _summary(poses: TurntablePoses) -> str:
    """The figures that are not drawn, in two lines."""
    report = poses.report()
    words = ", ".join(describe_poses(poses, report))
    return f"By {poses.method}: {words}\n{len(report['warnings'])} warnings (see poses.json)"
