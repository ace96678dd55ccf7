"""The methods that find a session's poses, and the choice of one that the session supports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world
from hsi_sc_nerf.poses.feature_poses import Images, poses_from_features
from hsi_sc_nerf.poses.marker_poses import poses_from_markers
from hsi_sc_nerf.poses.result import TurntablePoses

PoseMethod: TypeAlias = Literal["auto", "markers", "colmap", "angles"]

FIELD_OF_VIEW_DEG = (4.0, 100.0)
"""Over the image's width, from a long tele lens to a very wide one. Features that give another camera are too few."""
# In the order in which they are tried.
_NAMES: dict[str, str] = {"markers": "markers", "colmap": "features (COLMAP)", "angles": "known angles"}


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera before its turntable, calibrated by an earlier session."""

    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    camera_to_world: Float[np.ndarray, "4 4"]
    """Pose at the angle 0, object frame, metres."""
    direction: Literal["ccw", "cw"] | None = None
    """The turntable's turn seen from above; None where the earlier session does not tell."""


def find_poses(
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    method: PoseMethod = "auto",
    *,
    camera: KnownCamera | None = None,
    progress: bool = True,
    from_markers: Callable[..., TurntablePoses] = poses_from_markers,
    from_features: Callable[..., TurntablePoses] = poses_from_features,
) -> TurntablePoses:
    """Poses by one method, or by the first that works; the result tells which was taken and why.

    Args:
        images: one gray image per frame, all of one size, or ``SessionPictures``.
        names: the frames' names.
        info: what is known of the session: markers, container, nominal step or angles, direction, distance.
        method: ``auto`` takes the first of ``markers``, ``colmap`` and ``angles`` that works.
        camera: of an earlier session; with known angles, poses then need neither markers nor texture.
        progress: show progress bars.
        from_markers: the function behind the method.
        from_features: likewise.

    Raises:
        InputError: the method, or every method, fails; says why.

    Example:
        >>> poses = find_poses(images, names, SessionInfo(marker_side_m=0.03))
        >>> poses.chosen
        'by markers'
    """

    def by(method: str) -> TurntablePoses:
        if method == "markers":
            return from_markers(images, names, info, progress=progress)
        if method == "colmap":
            return _checked(from_features(images, names, info))
        told = info if camera is None else _with_direction(info, camera)
        angles_deg = known_angles_deg(told, len(names))
        if angles_deg is None:
            raise InputError("the angles are not known; give nominal_step_deg or frame_angles_deg in session.json")
        if camera is None:
            return _checked(from_features(images, names, info, angles_deg=angles_deg))
        height, width = images[0].shape
        return poses_from_known_camera(names, (width, height), angles_deg, camera)

    # Many small systems of equations are solved side by side, which BLAS's own threads would slow down.
    with threadpool_limits(limits=1, user_api="blas"):
        if method != "auto":
            return replace(by(method), chosen=f"by {_NAMES[method]}, as the settings say")
        failed = []
        for name, words in _NAMES.items():
            try:
                poses = by(name)
            except InputError as error:
                failed.append(f"{words}: {str(error).rstrip('.')}")
                continue
            why_not = f" (not by {'; nor by '.join(failed)})" if failed else ""
            return replace(poses, chosen=f"by {words}{why_not}")
    raise InputError(f"no method finds poses: {'; '.join(failed)}.")


def known_angles_deg(info: SessionInfo, frames: int) -> Float[np.ndarray, "n"] | None:
    """The frames' angles by ``session.json``, relative to the first; positive where the direction is not known.

    Raises:
        InputError: not one angle per frame.
    """
    sign = -1.0 if info.direction == "cw" else 1.0
    if info.frame_angles_deg is not None:
        if len(info.frame_angles_deg) != frames:
            raise InputError(
                f"{len(info.frame_angles_deg)} frame angles are given for {frames} frames; give one per frame"
            )
        return sign * (np.array(info.frame_angles_deg) - info.frame_angles_deg[0])
    return None if info.nominal_step_deg is None else sign * info.nominal_step_deg * np.arange(frames)


def poses_from_known_camera(
    names: Sequence[str],
    size_px: tuple[int, int],
    angles_deg: Float[np.ndarray, "n"],
    camera: KnownCamera,
) -> TurntablePoses:
    """Poses of a camera that has not moved since an earlier session, from angles alone: nothing is measured.

    Args:
        names: of the frames.
        size_px: width and height of the images.
        angles_deg: relative to the first frame, counter-clockwise seen from above.
        camera: of the earlier session.

    Raises:
        InputError: images of another size than the camera's.
    """
    if size_px != (camera.intrinsics.w, camera.intrinsics.h):
        raise InputError(
            f"the images have {size_px[0]} x {size_px[1]} pixels, but the camera of the earlier session had "
            f"{camera.intrinsics.w} x {camera.intrinsics.h}; give a session of the same camera"
        )
    n = len(names)
    return TurntablePoses(
        names=tuple(names),
        intrinsics=camera.intrinsics,
        distortion=camera.distortion,
        camera_to_world=np.stack([turntable_camera_to_world(camera.camera_to_world, float(a)) for a in angles_deg]),
        angles_deg=np.asarray(angles_deg, dtype=float),
        reprojection_error_px=np.full(n, np.nan),
        used=np.ones(n, bool),
        markers_per_frame=(0,) * n,
        overall_error_px=float("nan"),
        findings=(
            Finding("poses-given", "amber", "Poses are as given, by an earlier camera; nothing was measured."),
        ),
        method="angles",
    )


def _checked(poses: TurntablePoses) -> TurntablePoses:
    """Refuse poses from features that are too few: focal length and distance grow or shrink together.

    Raises:
        InputError: no camera has such a field of view.
    """
    field_deg = float(np.rad2deg(2.0 * np.arctan(poses.intrinsics.w / 2.0 / poses.intrinsics.fl_x)))
    low, high = FIELD_OF_VIEW_DEG
    if not low <= field_deg <= high:
        raise InputError(
            f"the features are too few to determine the camera (they give a field of view of {field_deg:.1f} "
            "degrees); take images of more pixels, an object with more texture, or markers"
        )
    return poses


def _with_direction(info: SessionInfo, camera: KnownCamera) -> SessionInfo:
    """The direction of the earlier session, where ``session.json`` gives none.

    Raises:
        InputError: neither gives a direction; the poses would be mirrored as likely as not.
    """
    if info.direction is not None:
        return info
    if camera.direction is None:
        raise InputError(
            "which way the turntable turns is not known, nor do the angles of the earlier session tell; give "
            "direction (ccw or cw) in session.json"
        )
    return replace(info, direction=camera.direction)
