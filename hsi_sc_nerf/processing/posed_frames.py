"""Poses of a session's frames: found, checked and reported, and the frames of the dataset that have one."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from rich.console import Console

from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.findings import Finding, refuse_red
from hsi_sc_nerf.geometry.camera import turntable_camera_to_world
from hsi_sc_nerf.packed.dataset import Container, PackedDataset, PackedFrame
from hsi_sc_nerf.poses.feature_poses import KnownCamera
from hsi_sc_nerf.poses.pose_methods import PoseMethod
from hsi_sc_nerf.poses.report import check_poses, describe_poses, draw_poses, pose_report
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.session_pictures import GRAY, read_pictures
from hsi_sc_nerf.processing.frames import FramePaths

_log = logging.getLogger(__name__)

POSES_NAME = "poses.json"
"""File of a dataset that says how its poses were found."""

PoseFunction = Callable[..., TurntablePoses]
"""Called like ``poses.pose_methods.find_poses``."""


def pose_frames(
    session: Session,
    images: Sequence[UInt8[np.ndarray, "h w"]],
    info: SessionInfo,
    camera: KnownCamera | None,
    method: PoseMethod,
    output_dir: Path,
    console: Console,
    find_poses: PoseFunction,
    check: Callable[[Sequence[Finding]], None] = refuse_red,
) -> TurntablePoses:
    """Find and check the poses, write ``poses.json`` and its figure, and print what was found.

    Args:
        session: its frames are packed under ``output_dir``.
        images: the mean over ``GRAY_NM`` of each frame.
        check: called with the findings on the poses; raises where one is red.

    Raises:
        InputError: no method finds poses, a check of them is red, or the operating system refused to write.
    """
    names = [capture.name for capture in session.frames]
    # Known angles with a known camera need no images.
    pictures = None
    if method != "angles" or camera is None:
        paths = [FramePaths.of(output_dir, name) for name in names]
        pictures = read_pictures([p.cube for p in paths], [p.flags for p in paths], images)
    try:
        with console.status("finding poses"):
            poses = find_poses(
                pictures or images, names, info=info, method=method, camera=camera, places=session.places
            )
    except InputError as error:
        raise InputError(f"{session.path}: {error}") from error
    findings = check_poses(poses, info, session.places)
    report = pose_report(poses, info, findings, session.places)
    if pictures is not None:
        of_frames = dict(zip(names, pictures.frames, strict=True))
        report["pictures"] = {
            "best": {name: frame.ranking[0] for name, frame in of_frames.items()},
            "edge_precision_per_px": {
                name: {picture: round(score, 1) for picture, score in frame.scores.items()}
                for name, frame in of_frames.items()
            },
        }
    write_json(output_dir / POSES_NAME, report)
    draw_poses(poses, report, output_dir / "report" / "poses.png")
    console.print(f"Poses {poses.chosen}: {', '.join(describe_poses(poses, report))}.", highlight=False)
    if pictures is not None and poses.method == "markers":
        best = Counter(frame.ranking[0] for frame in pictures.frames)
        if best.keys() != {GRAY}:
            seen_in = ", ".join(f"{name} ({count} frames)" for name, count in best.most_common())
            console.print(f"Markers stand out best in {seen_in}.", highlight=False)
    # The tilt counts clockwise from the picture's upright.
    if quarter_turns := round(-report["axis_tilt_in_image_deg"] / 90.0):
        rotation_deg = (session.image_rotation_deg + 90 * quarter_turns) % 360
        console.print(
            "Warning: The turntable lies on its side in the pictures; set image_rotation_deg to "
            f"{rotation_deg} in {session.info_path} to have them upright.",
            highlight=False,
        )
    for name in np.array(names)[~poses.used]:
        _log.warning("%s: this frame could not be posed and is left out (see poses.json)", name)
    check(findings)
    return poses


def posed_frames(output_dir: Path, poses: TurntablePoses) -> list[PackedFrame]:
    """The frames that have a pose."""
    frames = []
    for i in np.flatnonzero(poses.used):
        paths = FramePaths.of(output_dir, poses.names[i])
        error_px = float(poses.reprojection_error_px[i])
        frames.append(
            PackedFrame(
                capture=poses.names[i],
                image_path=paths.image,
                mask_path=paths.mask,
                cube_path=paths.cube,
                flags_path=paths.flags,
                angle_deg=float(poses.angles_deg[i]),
                reprojection_error_px=error_px if np.isfinite(error_px) else None,
                camera_to_world=poses.camera_to_world[i],
            )
        )
    return frames


def container_under(session: Session, poses: TurntablePoses) -> Container | None:
    """The container, if its size is known and the object frame is in metres with the container on z = 0."""
    diameter_m, height_m = session.info.container_diameter_m, session.info.container_height_m
    if diameter_m is None or height_m is None or not poses.metric or not poses.on_disc:
        return None
    return Container(diameter_m, height_m)


def known_camera(earlier: PackedDataset) -> KnownCamera:
    """The camera of a dataset that was made before with the same camera and turntable, at the angle 0."""
    first = earlier.frames[0]
    k1, k2, p1, p2 = (float(c) for c in earlier.distortion)
    # The sign of the angles gives the direction, unless both signs occur.
    forward = {frame.angle_deg > 0.0 for frame in earlier.frames if frame.angle_deg != 0.0}
    on_disc = earlier.origin_on_disc
    if on_disc is None:
        on_disc = earlier.container is not None or earlier.pose_method == "markers"
    return KnownCamera(
        intrinsics=earlier.intrinsics,
        distortion=(k1, k2, p1, p2),
        camera_to_world=turntable_camera_to_world(first.camera_to_world, -first.angle_deg),
        direction=None if len(forward) != 1 else "ccw" if True in forward else "cw",
        metric=earlier.metric,
        on_disc=on_disc,
        image_rotation_deg=earlier.image_rotation_deg,
    )
