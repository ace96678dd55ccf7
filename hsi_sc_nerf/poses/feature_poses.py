"""Poses of a turntable session without markers: from features of the object, known angles and a known camera.

Features give free poses by COLMAP, to which one turntable is fitted. Known are, before any image is looked at, the
camera of an earlier session and the turntable's angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, FreeParameters
from hsi_sc_nerf.poses.container_outline import container_outline
from hsi_sc_nerf.poses.known_angles import known_angles_deg
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_observations import observe_markers
from hsi_sc_nerf.poses.model_selection import usable
from hsi_sc_nerf.poses.object_frame import lie_on_disc, scale_of
from hsi_sc_nerf.poses.posed_session import in_object_frame, pose_uncertainty
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.session_pictures import GRAY, SessionPictures
from hsi_sc_nerf.poses.structure_from_motion import FreePoses, structure_from_motion
from hsi_sc_nerf.poses.track_adjustment import (
    AdjustedTracks,
    adjust_either_depth,
    adjust_together,
    adjust_tracks,
    with_lost_frames,
)
from hsi_sc_nerf.poses.turntable import Turntable
from hsi_sc_nerf.poses.turntable_from_poses import looks_up_deg, turntable_from_poses, upright

_FOCAL_SIGMA = 0.002
"""Standard deviation of an earlier session's focal length, as a fraction."""
_LEAST_ANGLE_SIGMA_RAD = 1e-3
"""Least standard deviation of a turntable's known angles."""
_SIGMAS, _LEAST_TILT_DEG, _LEAST_ZOOM = 3.0, 0.3, 0.02
"""The features contradict an earlier camera from this many standard deviations, and this tilt of the axis or this
fraction of the focal length."""
_LEAST_LOOKS_UP_DEG = 3.0
"""A camera at the object's height seems to look up by less than this."""
MOST_CONTRADICTING = 1 / 3
"""Largest fraction of COLMAP's poses that may contradict one turntable: with more, the right ones are not known."""

Images = Sequence[UInt8[np.ndarray, "h w"]]
"""One image per frame, or ``SessionPictures``."""


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera before its turntable, calibrated by an earlier session."""

    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    camera_to_world: Float[np.ndarray, "4 4"]
    """Pose at the angle 0, object frame."""
    direction: Literal["ccw", "cw"] | None = None
    """The turntable's turn seen from above; None if the earlier session does not show it."""
    metric: bool = True
    """Whether lengths are metres; otherwise the earlier session had no scale."""
    on_disc: bool = True
    """Whether the origin is on the disc."""
    image_rotation_deg: int | None = None
    """Rotation of the earlier session's raw images from upright, counter-clockwise; None if it is not known."""

    @property
    def distance_m(self) -> float | None:
        """The camera's distance from the turntable's axis; None where it is not known in metres."""
        return float(np.hypot(*self.camera_to_world[:2, 3])) if self.metric else None

    def in_metres(self, distance_m: float | None) -> KnownCamera:
        """The camera at this distance from the axis, if it is given and the earlier session had no scale."""
        if self.metric or distance_m is None:
            return self
        camera_to_world = self.camera_to_world.copy()
        camera_to_world[:3, 3] *= distance_m / np.hypot(*camera_to_world[:2, 3])
        return replace(self, camera_to_world=camera_to_world, metric=True)

    def check_images(self, size_px: tuple[int, int], info: SessionInfo) -> None:
        """Refuse images of another width and height, or that were turned otherwise.

        Raises:
            InputError: they differ.
        """
        turned_deg, earlier_deg = info.image_rotation_deg, self.image_rotation_deg
        if turned_deg != earlier_deg and None not in (turned_deg, earlier_deg):
            raise InputError(
                f"the raw images are turned by {turned_deg} degrees from upright, those of the earlier session by "
                f"{earlier_deg}; correct image_rotation_deg in session.json, or give a session of the camera as it "
                "stands now"
            )
        if size_px != (self.intrinsics.w, self.intrinsics.h):
            raise InputError(
                f"the images have {size_px[0]} x {size_px[1]} pixels, but the camera of the earlier session had "
                f"{self.intrinsics.w} x {self.intrinsics.h}; give a session of the same camera"
            )


def poses_from_known_camera(
    names: Sequence[str],
    size_px: tuple[int, int],
    info: SessionInfo,
    camera: KnownCamera,
    places: Sequence[int] | None = None,
) -> TurntablePoses:
    """Poses of a camera that has not moved since an earlier session, from known angles alone, without measurement.

    Args:
        size_px: width and height of the images.
        info: the angles and the direction.
        camera: camera of the earlier session; its direction counts where ``info`` has none.
        places: each frame's place in the turn (`Session.places`); one after the other if not given.

    Raises:
        InputError: images that are not the camera's (`KnownCamera.check_images`), unknown angles, or an unknown
            direction: the poses might be mirrored.
    """
    camera.check_images(size_px, info)
    camera = camera.in_metres(info.camera_distance_m)
    direction, n = info.direction or camera.direction, len(names)
    angles_deg = known_angles_deg(info, range(n) if places is None else places, required=True)
    assert angles_deg is not None
    if direction is None:
        raise InputError(
            "which way the turntable turns is not known, neither from session.json nor from the angles of the "
            "earlier session; give direction (ccw or cw) in session.json"
        )
    if info.direction is None and direction == "cw":
        angles_deg = -angles_deg
    return TurntablePoses(
        names=tuple(names),
        intrinsics=camera.intrinsics,
        distortion=camera.distortion,
        camera_to_world=np.stack([turntable_camera_to_world(camera.camera_to_world, float(a)) for a in angles_deg]),
        angles_deg=angles_deg,
        reprojection_error_px=np.full(n, np.nan),
        used=np.ones(n, bool),
        markers_per_frame=(0,) * n,
        overall_error_px=float("nan"),
        findings=(
            Finding("poses-given", "amber", "Poses are as given; nothing was measured."),
            *(() if camera.metric else (_no_scale("give camera_distance_m"),)),
        ),
        method="angles",
        disc_by_container=camera.on_disc,
        metric=camera.metric,
    )


def poses_from_sfm(
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    *,
    camera: KnownCamera | None = None,
    hold_angles: bool = False,
    places: Sequence[int] | None = None,
    free: FreePoses | None = None,
) -> TurntablePoses:
    """Poses from features: free poses by COLMAP, a turntable fitted to them, and its bundle adjustment.

    Markers that are seen, known angles and a known camera enter the adjustment.

    Args:
        info: what gives the scale, the markers' dictionary, and the angles.
        camera: camera of an earlier session, whose lens and distance from the axis still hold.
        hold_angles: take the known angles for exact; their direction is that of the images.
        places: each frame's place in the turn (`Session.places`); one after the other if not given.
        free: what ``structure_from_motion`` finds with the camera's focal length, where it is known already.

    Raises:
        InputError: too little texture, poses that do not turn about one axis, unknown angles that should be held, or
            images that are not the earlier camera's.
    """
    height, width = images[0].shape
    if camera is not None:
        camera.check_images((width, height), info)
    places = range(len(names)) if places is None else places
    angles_deg = known_angles_deg(info, places, required=hold_angles)
    grays = SessionPictures.of(images).named(GRAY)
    if free is None:
        free = structure_from_motion(grays, names, focal_px=None if camera is None else camera.intrinsics.fl_x)
    start, contradicts = turntable_from_poses(free.world_to_camera, free.points_3d, free.focal_px, free.centre_px)
    if contradicts.sum() > MOST_CONTRADICTING * free.used.sum():
        raise InputError(
            f"{int(contradicts.sum())} of the {int(free.used.sum())} poses that COLMAP found contradict one "
            "turntable; take images of more pixels, show markers, or give the angles"
        )
    if camera is not None:
        start = replace(start, radial=camera.distortion[:2])
    found = adjust_either_depth(start, free.tracks)
    found = adjust_tracks(with_lost_frames(upright(found.turntable), free.tracks), free.tracks)
    known_angles = None if angles_deg is None else prior_of_angles(found.turntable, np.deg2rad(angles_deg))
    parameters = FreeParameters(
        angles=not hold_angles,
        known_focal=None if camera is None else (camera.intrinsics.fl_x, _FOCAL_SIGMA),
        known_angles=None if hold_angles else known_angles,
    )
    if hold_angles and known_angles is not None:
        held = replace(found.turntable, angles_rad=known_angles[0])
        found = adjust_tracks(held, free.tracks, free_angles=False)
    if camera is not None and info.camera_distance_m is None:  # of a camera without a scale, None
        info = replace(info, camera_distance_m=camera.distance_m)
    return _posed(found, images, names, info, parameters, camera)


def prior_of_angles(turntable: Turntable, known_rad: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "f"], float]:
    """Known angles of the turntable's frames, from its first angle on and in its direction, and their uncertainty.

    Steps that are found to be uneven count for little, even ones for much.
    """
    known, found = known_rad[turntable.frames], turntable.angles_rad
    known = np.copysign(1.0, np.dot(np.diff(known), np.diff(found))) * known
    deviation_rad = found - found.mean() - known + known.mean()
    return known - known[0] + found[0], max(float(np.sqrt((deviation_rad**2).mean())), _LEAST_ANGLE_SIGMA_RAD)


def _posed(
    found: AdjustedTracks,
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    parameters: FreeParameters,
    camera: KnownCamera | None,
) -> TurntablePoses:
    """Adjust once more with the markers that are seen, if any, and go over to the object frame."""
    turntable, n = found.turntable, len(names)
    dictionary = info.marker_dictionary or find_dictionary(images)
    markers, per_frame = None, (0,) * n
    if dictionary is not None:
        markers, _, _ = usable(observe_markers(images, dictionary).observations)
        markers = markers.select(np.isin(markers.frame, turntable.frames))
        per_frame = tuple(np.bincount(markers.frame, minlength=n).tolist())
    adjusted, markers = adjust_together(found, markers, parameters)
    findings: list[Finding] = []
    if camera is not None:
        findings = check_camera(adjusted, found, camera)
    errors_px, overall_px = adjusted.turntable.frame_errors_px(found.tracks, n)
    height, width = images[0].shape
    outline, diameter_m, height_m = None, info.container_diameter_m, info.container_height_m
    scale_is_poor = scale_of(adjusted.turntable, info)[0] in (None, "distance")
    if scale_is_poor and diameter_m is not None and height_m is not None:
        grays = SessionPictures.of(images).named(GRAY)
        outline = container_outline(grays, adjusted.turntable, height_m / diameter_m)
    source, _ = scale_of(adjusted.turntable, info, outline)
    if source == "distance" and camera is not None and info.camera_distance_m == camera.distance_m:
        sentence = (
            "The camera's distance from the axis in the earlier session gives the scale; if the camera was moved "
            "since then, give camera_distance_m in session.json."
        )
        findings.append(Finding("poses-given", "amber", sentence))
    if source is None:
        show = "show markers and give" if markers is None else "give"
        size = "" if diameter_m is not None else " or the container's size"
        findings.append(_no_scale(f"{show} marker_side_m, or give camera_distance_m{size}"))
    if outline is None and not lie_on_disc(adjusted.turntable.corners()).any():
        sentence = "No marker lies on the disc: the origin is at the height of the lowest marker or feature."
        findings.append(Finding("poses-origin", "amber", sentence))
    if (up_deg := looks_up_deg(adjusted.turntable)) > _LEAST_LOOKS_UP_DEG:
        sentence = (
            f"The camera seems to look up at the object by {up_deg:.0f} degrees; if the pictures are upside down, "
            "set image_rotation_deg."
        )
        findings.append(Finding("poses-upright", "amber", sentence, {"looks_up_deg": up_deg}))
    return in_object_frame(
        adjusted,
        markers,
        names,
        (width, height),
        info,
        outline,
        reprojection_error_px=errors_px,
        dropped={
            names[i]: "it shares too few features with other frames"
            for i in np.setdiff1d(np.arange(n), turntable.frames).tolist()
        },
        dictionary=None if markers is None else dictionary,
        markers_per_frame=per_frame,
        overall_error_px=overall_px,
        loop_closure_deg=found.loop_closure_deg(),
        findings=tuple(findings),
        method="colmap" if parameters.angles else "angles",
        camera_given=camera is not None,
    )


def _no_scale(advice: str) -> Finding:
    unit = "lengths are in units of the camera's distance from the axis"
    sentence = f"Nothing gives the scale: {unit}; {advice} in session.json."
    return Finding("poses-no-scale", "amber", sentence)


def check_camera(adjusted: Adjusted, found: AdjustedTracks, camera: KnownCamera) -> list[Finding]:
    """Whether the features contradict the camera of the earlier session."""
    alone, _ = adjust_together(found, None, replace(adjusted.problem.free, known_focal=None))
    focal = float(np.log(alone.turntable.focal_px / camera.intrinsics.fl_x))
    focal_sigma = float(np.hypot(np.sqrt(alone.covariance()[0, 0]), _FOCAL_SIGMA))
    stated = pose_uncertainty(adjusted, adjusted.covariance())
    axis, earlier = adjusted.turntable.camera_rotation[:, 2], camera.camera_to_world[2, :3] * [1.0, -1.0, -1.0]
    tilt_deg = float(np.rad2deg(np.arccos(np.clip(axis @ earlier, -1.0, 1.0))))
    moved = tilt_deg > _SIGMAS * stated.rotation_deg + _LEAST_TILT_DEG
    if not moved and abs(focal) <= max(_SIGMAS * focal_sigma, _LEAST_ZOOM):
        return []
    sentence = (
        f"The camera is not as in the earlier session: its focal length differs by {100.0 * focal:+.1f} % and the "
        f"axis leans by {tilt_deg:.1f} degrees; leave out --camera, or give a session of the camera as it stands now."
    )
    return [Finding("poses-camera", "red", sentence, {"focal_percent": 100.0 * focal, "tilt_deg": tilt_deg})]
