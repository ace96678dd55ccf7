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
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world
from hsi_sc_nerf.poses.feature_poses import Images, poses_from_angles, poses_from_colmap
from hsi_sc_nerf.poses.marker_poses import poses_from_markers
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.structure_from_motion import FeatureConfig

PoseMethod: TypeAlias = Literal["auto", "markers", "colmap", "angles"]

FIELD_OF_VIEW_DEG = (4.0, 100.0)
"""Over the image's width, from a long tele lens to a very wide one. Features that give another camera are too few."""
_ORDER: tuple[Literal["markers", "colmap", "angles"], ...] = ("markers", "colmap", "angles")
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


@dataclass(frozen=True)
class PoseEstimators:
    """The functions behind the methods."""

    markers: Callable[..., TurntablePoses] = poses_from_markers
    colmap: Callable[..., TurntablePoses] = poses_from_colmap
    angles: Callable[..., TurntablePoses] = poses_from_angles


def find_poses(
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    method: PoseMethod = "auto",
    config: FeatureConfig | None = None,
    *,
    camera: KnownCamera | None = None,
    progress: bool = True,
    estimators: PoseEstimators | None = None,
) -> TurntablePoses:
    """Poses by one method, or by the first that works; the result tells which was taken and why.

    Args:
        images: one gray image per frame, all of one size, or ``SessionPictures``.
        names: the frames' names.
        info: what is known of the session: markers, container, nominal step or angles, direction, distance.
        method: ``auto`` takes the first of ``markers``, ``colmap`` and ``angles`` that works.
        config: settings of poses from features.
        camera: of an earlier session; with known angles, poses then need neither markers nor texture.
        progress: show progress bars.
        estimators: the functions behind the methods.

    Raises:
        InputError: the method, or every method, fails; says why.

    Example:
        >>> poses = find_poses(images, names, SessionInfo(marker_side_m=0.03))
        >>> poses.chosen
        'by markers'
    """
    find = _Finder(images, names, info, config or FeatureConfig(), camera, progress, estimators or PoseEstimators())
    # Many small systems of equations are solved side by side, which BLAS's own threads would slow down.
    with threadpool_limits(limits=1, user_api="blas"):
        if method == "auto":
            return find.first_that_works()
        if method == "colmap":
            return find.by_colmap_or_adjusted_angles()
        return replace(find.by(method), chosen=_as_set(method))


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
    info: SessionInfo,
) -> TurntablePoses:
    """Poses of a camera that has not moved since an earlier session, from angles alone: nothing is measured.

    Args:
        names: of the frames.
        size_px: width and height of the images.
        angles_deg: relative to the first frame, counter-clockwise seen from above.
        camera: of the earlier session.
        info: its nominal step and direction go into the report.

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
        nominal_step_deg=info.nominal_step_deg,
        nominal_direction=info.direction,
        warnings=("poses are as given, by the camera of an earlier session and the angles; nothing was measured",),
        method="angles",
    )


@dataclass(frozen=True)
class _Finder:
    """The arguments of ``find_poses``."""

    images: Images
    names: Sequence[str]
    info: SessionInfo
    config: FeatureConfig
    camera: KnownCamera | None
    progress: bool
    estimators: PoseEstimators

    def first_that_works(self) -> TurntablePoses:
        failed = []
        for method in _ORDER:
            try:
                poses = self.by(method)
            except InputError as error:
                failed.append(f"{_NAMES[method]}: {str(error).rstrip('.')}")
                continue
            why_not = f" (not by {'; nor by '.join(failed)})" if failed else ""
            return replace(poses, chosen=f"by {_NAMES[method]}{why_not}")
        raise InputError(f"no method finds poses: {'; '.join(failed)}.")

    def by_colmap_or_adjusted_angles(self) -> TurntablePoses:
        """By COLMAP; where that fails, as it may at low resolution, from the known angles, adjusted to features."""
        try:
            return replace(self.by("colmap"), chosen=_as_set("colmap"))
        except InputError as error:
            angles_deg, failed = known_angles_deg(self.info, len(self.names)), str(error).rstrip(".")
            if angles_deg is None:
                raise
        try:
            poses = self._from_angles(self.info, angles_deg, free_angles=True)
        except InputError as error:
            raise InputError(f"{failed}; nor do features fit the known angles: {error}") from error
        warning = (
            f"features gave no poses by themselves ({failed}), so the known angles were taken to start from and "
            "adjusted; compare them with the nominal steps"
        )
        return replace(
            poses,
            chosen=f"by features, from known angles that were adjusted (not by {_NAMES['colmap']}: {failed})",
            warnings=(warning, *poses.warnings),
        )

    def by(self, method: Literal["markers", "colmap", "angles"]) -> TurntablePoses:
        if method == "markers":
            return self.estimators.markers(self.images, self.names, self.info, progress=self.progress)
        if method == "colmap":
            return _checked(self.estimators.colmap(self.images, self.names, self.info, self.config))
        info = self.info if self.camera is None else _with_direction(self.info, self.camera)
        angles_deg = known_angles_deg(info, len(self.names))
        if angles_deg is None:
            raise InputError("the angles are not known; give nominal_step_deg or frame_angles_deg in session.json")
        if self.camera is None:
            return self._from_angles(info, angles_deg, free_angles=False)
        height, width = self.images[0].shape
        return poses_from_known_camera(self.names, (width, height), angles_deg, self.camera, info)

    def _from_angles(
        self, info: SessionInfo, angles_deg: Float[np.ndarray, "n"], *, free_angles: bool
    ) -> TurntablePoses:
        return _checked(
            self.estimators.angles(self.images, self.names, angles_deg, info, self.config, free_angles=free_angles)
        )


def _as_set(method: str) -> str:
    return f"by {_NAMES[method]}, as the settings say"


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
