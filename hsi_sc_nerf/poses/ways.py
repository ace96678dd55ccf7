"""The ways to poses, and which of them a session supports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.estimate import estimate_turntable_poses
from hsi_sc_nerf.poses.freed_angles import poses_by_freed_angles
from hsi_sc_nerf.poses.from_features import FeatureConfig, Images, Known, poses_by_angles, poses_by_colmap
from hsi_sc_nerf.poses.known_camera import KnownCamera, poses_by_known_camera
from hsi_sc_nerf.poses.result import TurntablePoses

PoseWay = Literal["auto", "markers", "colmap", "angles"]


@dataclass(frozen=True)
class SessionFacts(Known):
    """What is known of a session beside its images."""

    frame_angles_deg: tuple[float, ...] | None = None
    """One angle a frame, instead of even steps."""
    camera: KnownCamera | None = None
    """Of an earlier session."""

    def angles_deg(self, frames: int) -> Float[np.ndarray, "n"] | None:
        """The frames' known angles, relative to the first; positive where the direction is not known; or None.

        Raises:
            InputError: as many angles as frames are not given.
        """
        sign = -1.0 if self.direction == "cw" else 1.0
        if self.frame_angles_deg is not None:
            if len(self.frame_angles_deg) != frames:
                raise InputError(
                    f"{len(self.frame_angles_deg)} frame angles are given for {frames} frames; give one a frame"
                )
            return sign * (np.array(self.frame_angles_deg) - self.frame_angles_deg[0])
        return None if self.nominal_step_deg is None else sign * self.nominal_step_deg * np.arange(frames)


def find_poses(
    images: Images,
    names: Sequence[str],
    facts: SessionFacts,
    way: PoseWay,
    config: FeatureConfig,
    progress: bool = True,
) -> TurntablePoses:
    """Poses by one way, or by the first that works; they tell which was taken and why.

    Raises:
        InputError: the way, or every way, fails; says why.
    """
    # Its many small systems of equations are solved side by side: BLAS's own threads would only get in their way.
    with threadpool_limits(limits=1, user_api="blas"):
        return _find(images, names, facts, way, config, progress)


def _find(
    images: Images, names: Sequence[str], facts: SessionFacts, way: PoseWay, config: FeatureConfig, progress: bool
) -> TurntablePoses:
    if way == "colmap":
        return _by_colmap_or_freed_angles(images, names, facts, config)
    if way != "auto":
        poses = _by(way, images, names, facts, config, progress)
        return replace(poses, chosen=f"by {_NAMES[way]}, {_AS_SET}")
    failed = []
    for attempt in _ORDER:
        try:
            poses = _by(attempt, images, names, facts, config, progress)
        except InputError as error:
            failed.append(f"{_NAMES[attempt]}: {str(error).rstrip('.')}")
            continue
        why_not = f" (not by {'; nor by '.join(failed)})" if failed else ""
        return replace(poses, chosen=f"by {_NAMES[attempt]}{why_not}")
    raise InputError(f"no way to poses works: {'; '.join(failed)}.")


def _by_colmap_or_freed_angles(
    images: Images, names: Sequence[str], facts: SessionFacts, config: FeatureConfig
) -> TurntablePoses:
    """By COLMAP; where that fails, as it may at low resolution, from the known angles, adjusted on features."""
    try:
        poses = _checked(poses_by_colmap(images, names, facts, config))
        return replace(poses, chosen=f"by {_NAMES['colmap']}, {_AS_SET}")
    except InputError as error:
        angles_deg, failed = facts.angles_deg(len(names)), str(error).rstrip(".")
        if angles_deg is None:
            raise
    try:
        poses = _checked(poses_by_freed_angles(images, names, angles_deg, facts, config))
    except InputError as error:
        raise InputError(f"{failed}; nor do features suit the known angles: {error}") from error
    warning = (
        f"features gave no poses by themselves ({failed}), so the known angles were taken to start from and "
        "adjusted; compare them with the nominal steps"
    )
    return replace(
        poses,
        chosen=f"by features, from known angles that were adjusted (not by {_NAMES['colmap']}: {failed})",
        warnings=(warning, *poses.warnings),
    )


def _checked(poses: TurntablePoses) -> TurntablePoses:
    """Poses from features, whose focal length may run away with the distance where they are few.

    Raises:
        InputError: no camera has such a field of view.
    """
    field_deg = float(np.rad2deg(2.0 * np.arctan(poses.intrinsics.w / 2.0 / poses.intrinsics.fl_x)))
    low, high = FIELD_OF_VIEW_DEG
    if not low <= field_deg <= high:
        raise InputError(
            f"the features are too few to tell the camera (a field of view of {field_deg:.1f} degrees suits "
            "them best); take images of more pixels, an object with more texture, or markers"
        )
    return poses


FIELD_OF_VIEW_DEG = (4.0, 100.0)
"""Cameras beyond these are not believed: from a long tele lens to a very wide one, over the image's width."""
_AS_SET = "as the settings say"
_ORDER: tuple[Literal["markers", "colmap", "angles"], ...] = ("markers", "colmap", "angles")
_NAMES: dict[str, str] = {"markers": "markers", "colmap": "features (COLMAP)", "angles": "known angles"}


def _by(
    way: Literal["markers", "colmap", "angles"],
    images: Images,
    names: Sequence[str],
    facts: SessionFacts,
    config: FeatureConfig,
    progress: bool,
) -> TurntablePoses:
    if way == "markers":
        return estimate_turntable_poses(
            images,
            names,
            dictionary=facts.marker_dictionary,
            marker_side_m=facts.marker_side_m,
            nominal_step_deg=facts.nominal_step_deg,
            direction=facts.direction,
            container_diameter_m=facts.container_diameter_m,
            container_height_m=facts.container_height_m,
            progress=progress,
        )
    if way == "colmap":
        return _checked(poses_by_colmap(images, names, facts, config))
    facts = _turning_as_before(facts)
    angles_deg = facts.angles_deg(len(names))
    if angles_deg is None:
        raise InputError("the angles are not known; give nominal_step_deg or frame_angles_deg in session.json")
    if facts.camera is None:
        return _checked(poses_by_angles(images, names, angles_deg, facts, config))
    height, width = images[0].shape
    return poses_by_known_camera(
        names,
        (width, height),
        angles_deg,
        facts.camera,
        nominal_step_deg=facts.nominal_step_deg,
        direction=facts.direction,
    )


def _turning_as_before(facts: SessionFacts) -> SessionFacts:
    """With a camera of an earlier session, the table turns as it did then where nothing else is told.

    Raises:
        InputError: nothing tells how it turns; the poses would be mirrored as likely as not.
    """
    if facts.camera is None or facts.direction is not None:
        return facts
    if facts.camera.direction is None:
        raise InputError(
            "which way the turntable turns is not known, nor do the angles of the earlier session tell; give "
            "direction (ccw or cw) in session.json"
        )
    return replace(facts, direction=facts.camera.direction)
